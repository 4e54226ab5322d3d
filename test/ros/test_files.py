"""Launch, RViz and DDS files: as much as can be checked without those programs."""

import py_compile
import xml.etree.ElementTree
from pathlib import Path

import pytest
import yaml

from cello3d_ros.ros.process import PROFILE, shared_file

ROOT = Path(__file__).parents[2]


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


def test_rviz_shows_the_topics_of_the_node() -> None:
    view = yaml.safe_load((ROOT / "rviz" / "cello3d.rviz").read_text())
    manager = view["Visualization Manager"]
    topics = {d["Topic"]["Value"] for d in manager["Displays"] if "Topic" in d}
    assert topics == {"/covariance_node/pose", "/odom", "/points"}
    assert manager["Global Options"]["Fixed Frame"] == "odom"


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
