"""Launch, RViz and DDS files: as much as can be checked without those programs."""

import ast
import dataclasses
import json
import py_compile
import re
import sys
import xml.etree.ElementTree
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from cello3d_ros.config import Config, NodeConfig, config_from
from cello3d_ros.ros.process import PROFILE, shared_file

ROOT = Path(__file__).parents[1]
LAUNCH = ROOT / "launch"
EXAMPLES = sorted(ROOT.glob("config/examples/*.yaml"))
OURS = "/covariance_node/"


@pytest.mark.parametrize("path", sorted(ROOT.glob("launch/*.launch.py")), ids=lambda p: p.name)
def test_launch_files_compile(path, tmp_path) -> None:
    py_compile.compile(str(path), cfile=str(tmp_path / "compiled"), doraise=True)


@pytest.mark.parametrize("path", sorted(ROOT.glob("launch/*.launch.py")), ids=lambda p: p.name)
def test_launch_files_describe_something(path) -> None:
    launch = pytest.importorskip("launch_ros", reason="launch_ros is not on PyPI")
    assert launch
    names: dict[str, object] = {}
    exec(compile(path.read_text(), str(path), "exec"), names)
    assert names["generate_launch_description"]().entities


def calls(path: Path, function: str) -> list[dict[str, ast.expr]]:
    """Keyword arguments of each call of a function in a file."""
    return [
        {word.arg: word.value for word in node.keywords if word.arg}
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        if node.func.id == function
    ]


def constant(path: Path, name: str):
    """Value of a literal at the top of a file."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            return ast.literal_eval(node.value)
    raise AssertionError(f"{path} has no {name}")


def test_launch_starts_what_is_installed_and_sets_parameters_that_are_there() -> None:
    path = LAUNCH / "cello3d.launch.py"
    ours = [c for c in calls(path, "Node") if ast.literal_eval(c["package"]) == "cello3d_ros"]
    assert len(ours) == 1
    executable = ast.literal_eval(ours[0]["executable"])
    assert f'"{executable} = cello3d_ros' in (ROOT / "setup.py").read_text()
    settings = set(re.findall(r'"node\.(\w+)"', path.read_text()))
    named = re.search(r"for name in \(([^)]*)\):\n\s+if given", path.read_text())
    settings |= set(re.findall(r"\w+", named[1]))
    assert settings >= {"autostart", "model", "covariance_mode"}
    known = {field.name for field in dataclasses.fields(NodeConfig)}
    assert settings <= known


def test_launch_uses_every_argument_and_no_other() -> None:
    path = LAUNCH / "cello3d.launch.py"
    used = set(re.findall(r'given\["(\w+)"\]', path.read_text())) | {"model", "covariance_mode"}
    remapped = constant(path, "TOPICS")
    assert used | set(remapped) == set(constant(path, "ARGUMENTS"))
    heard = (ROOT / "cello3d_ros" / "ros" / "inputs.py").read_text()
    assert [name for name in remapped if f'"{name}"' not in heard] == []


class Recorded:
    """Stands for every class of launch: it keeps what it was made of."""

    def __init__(self, *values, **words) -> None:
        self.values, self.words = values, words
        self.__dict__.update(words)


def started(monkeypatch, **given: str) -> list[Recorded]:
    """What the launch file starts for some arguments; launch itself is not on PyPI."""
    path = LAUNCH / "cello3d.launch.py"
    values = {name: default for name, (default, _) in constant(path, "ARGUMENTS").items()}
    values |= given

    class Configuration:
        def __init__(self, name: str) -> None:
            self.name = name

        def perform(self, context: object) -> str:
            return values[self.name]

    names = (
        *("DeclareLaunchArgument", "ExecuteProcess", "OpaqueFunction", "SetEnvironmentVariable"),
        *("PathJoinSubstitution", "Node", "FindPackageShare", "LaunchDescription"),
    )
    whole = SimpleNamespace(
        LaunchConfiguration=Configuration,
        **{name: type(name, (Recorded,), {}) for name in names},
    )
    for module in ("launch", "launch_ros"):
        for part in ("", ".actions", ".substitutions"):
            monkeypatch.setitem(sys.modules, module + part, whole)
    found: dict[str, Any] = {}
    exec(compile(path.read_text(), str(path), "exec"), found)
    return found["actions"](None)


def kinds(actions: list[Recorded]) -> list[str]:
    return [type(action).__name__ for action in actions]


def test_launch_sets_only_what_was_given(monkeypatch, tmp_path) -> None:
    """Otherwise it would win over the parameter file."""
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    params = tmp_path / "mine.yaml"
    params.write_text("/**: {}")
    profile, node = started(monkeypatch, params=str(params))
    assert (type(profile).__name__, type(node).__name__) == ("SetEnvironmentVariable", "Node")
    assert node.parameters == [str(params)]
    *_, node = started(monkeypatch, use_sim_time="true", autostart="false", model="m.npz")
    assert node.parameters == [
        *({"node.autostart": False}, {"node.model": "m.npz"}, {"use_sim_time": True})
    ]
    *_, node, player = started(monkeypatch, bag="bags/demo")
    assert node.parameters == [{"use_sim_time": True}]
    assert player.cmd[:4] == ["ros2", "bag", "play", "bags/demo"]


def test_launch_leaves_the_dds_profile_of_the_user_alone(monkeypatch) -> None:
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/mine.xml")
    assert kinds(started(monkeypatch)) == ["Node"]


def test_launch_keeps_topics_in_the_namespace_and_rviz_follows(monkeypatch) -> None:
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/mine.xml")
    node, view = started(monkeypatch, namespace="left", name="judge", points="/lidar", rviz="true")
    assert dict(node.remappings)["points"] == "/lidar"
    assert dict(node.remappings)["odom"] == "odom"
    assert dict(view.remappings) == {
        "/points": "/lidar",
        "/odom": "/left/odom",
        "/covariance_node/pose": "/left/judge/pose",
        "/covariance_node/odometry": "/left/judge/odometry",
        "/covariance_node/markers": "/left/judge/markers",
    }


def test_launch_refuses_a_parameter_file_that_is_not_there(monkeypatch) -> None:
    with pytest.raises(FileNotFoundError, match=r"no file /nowhere\.yaml"):
        started(monkeypatch, params="/nowhere.yaml")


def test_the_demo_passes_on_arguments_that_are_there() -> None:
    assert set(constant(LAUNCH / "demo.launch.py", "ARGUMENTS")) <= set(
        constant(LAUNCH / "cello3d.launch.py", "ARGUMENTS")
    )
    assert (ROOT / constant(LAUNCH / "demo.launch.py", "ARGUMENTS")["bag"][0]).is_dir()


def test_files_named_by_launch_are_installed() -> None:
    text = (LAUNCH / "cello3d.launch.py").read_text()
    for folder, name in re.findall(r'"(config|rviz)", "([\w.]+)"', text):
        assert (ROOT / folder / name).is_file()


def test_rviz_shows_the_topics_of_the_node() -> None:
    view = yaml.safe_load((ROOT / "rviz" / "cello3d.rviz").read_text())
    manager = view["Visualization Manager"]
    topics = {d["Topic"]["Value"] for d in manager["Displays"] if "Topic" in d}
    inputs = {"/odom", "/points"}
    assert topics == inputs | {OURS + name for name in ("pose", "odometry", "markers")}
    assert manager["Global Options"]["Fixed Frame"] == "odom"
    markers = next(d for d in manager["Displays"] if d["Class"].endswith("/MarkerArray"))
    assert set(markers["Namespaces"]) == {"translation", "rotation", "weakest", "chain"}


def test_foxglove_shows_the_topics_of_the_node() -> None:
    text = (ROOT / "config" / "foxglove_layout.json").read_text()
    layout = json.loads(text)
    panels = layout["configById"]
    leaves = re.findall(r'"([\w ]+![\w]+)"', json.dumps(layout["layout"]))
    assert sorted(leaves) == sorted(panels)
    topics = {topic.split(".")[0] for topic in re.findall(r'"(/[\w/.]+)', text)}
    outputs = ("relative_pose", "pose", "odometry", "markers")
    assert topics == {"/odom", "/points", "/diagnostics", *(OURS + name for name in outputs)}
    status = panels["DiagnosticStatusPanel!cello3d"]
    assert status["selectedName"] == "covariance_node: registration"


def test_all_files_of_config_are_installed() -> None:
    patterns = re.findall(r'glob\("(config/[^"]+)"\)', (ROOT / "setup.py").read_text())
    installed = {path for pattern in patterns for path in ROOT.glob(pattern)}
    assert installed == {path for path in (ROOT / "config").rglob("*") if path.is_file()}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.name)
def test_the_examples_configure_the_node(path) -> None:
    tree = yaml.safe_load(path.read_text())
    config = config_from(tree["/**"]["ros__parameters"], str(path))
    assert config != Config()
    for node in tree.values():
        assert list(node) == ["ros__parameters"]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.name)
def test_the_examples_hear_topics_of_the_node(path) -> None:
    text = path.read_text()
    named = set(re.findall(r"/covariance_node/(\w+)", text))
    assert named <= {"odometry", "pose", "relative_pose"}
    for program in ("robot_localization", "fuse"):
        if path.stem == program:
            assert named == {"odometry"}


def test_robot_localization_fuses_velocities_only() -> None:
    """The state is x y z, roll pitch yaw, their velocities, three accelerations."""
    tree = yaml.safe_load((ROOT / "config/examples/robot_localization.yaml").read_text())
    ekf = tree["ekf_filter_node"]["ros__parameters"]
    assert ekf["odom0_config"] == [False] * 6 + [True] * 6 + [False] * 3
    assert not ekf["odom0_differential"]


def test_remappings_of_the_examples_are_of_topics_that_the_node_hears() -> None:
    heard = (ROOT / "cello3d_ros" / "ros" / "inputs.py").read_text()
    for path in [*EXAMPLES, ROOT / "README.md", ROOT / "docs" / "integration.md"]:
        names = re.findall(r"-r (\w+):=/", path.read_text())
        assert [name for name in names if name != "__node" and f'"{name}"' not in heard] == []
        assert names


def test_fuse_takes_each_message_as_a_step() -> None:
    tree = yaml.safe_load((ROOT / "config/examples/fuse.yaml").read_text())
    lidar = tree["state_estimator"]["ros__parameters"]["lidar"]
    assert lidar["differential"] is True
    assert lidar["independent"] is False
    assert lidar["use_twist_covariance"] is True


def test_the_dds_profile_has_shared_memory_for_a_million_points() -> None:
    path = shared_file("config", PROFILE)
    assert path is not None
    sizes = [
        int(element.text or 0)
        for element in xml.etree.ElementTree.parse(path).iter()
        if element.tag.endswith("segment_size")
    ]
    assert sizes
    assert sizes[0] > 16_000_000


def test_the_tests_that_the_page_of_faults_names_are_there() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text()
    names = set(re.findall(r"`(?:[\w/]*/)?(test_\w+)(?:\.py)?`", page))
    assert len(names) > 10
    assert names <= {path.stem for path in (ROOT / "test").rglob("test_*.py")}
