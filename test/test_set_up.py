"""The suite is collected with and without ROS, its pytest plugins and optional libraries."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OPTIONAL = ("rclpy", "open3d", "distributed", "kiss_icp", "small_gicp", "plotly", "playwright")

# As ROS's launch_testing does, look into each module before pytest collects it, and forgive
# nothing but a syntax error. A module that skips itself while it is imported ends the collection.
PLUGIN = """
import inspect, os, sys
from pathlib import Path
import pytest
from _pytest.pathlib import import_path

def pytest_configure():
    for library in os.environ["HIDDEN_LIBRARIES"].split():
        sys.modules[library] = None

def pytest_pycollect_makemodule({argument}, parent):
    known = inspect.signature(import_path).parameters
    words = {{"root": parent.config.rootpath}}
    if "consider_namespace_packages" in known:
        words["consider_namespace_packages"] = False
    module = import_path(Path({argument}), **words)
    assert not hasattr(module, "generate_test_description")
    return pytest.Module.from_parent(parent, path=Path({argument}))
"""

EXAMPLE = """
import numpy as np, cello3d_ros as cello
from cello3d_ros.tracking.warmup import room
rng = np.random.default_rng(0)
r = cello.Estimator()(room(rng), room(rng), np.eye(4))
assert np.linalg.eigvalsh(r.covariance)[0] > 0
print(r.trust.sentence)
"""


def collected(folder: Path, *arguments: str, hidden: str = "") -> str:
    """Return what pytest prints when it collects the suite with plugins from a folder."""
    path = os.pathsep.join([str(folder), str(ROOT), *sys.path])
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
        + [*arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path, "HIDDEN_LIBRARIES": hidden},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    return run.stdout


@pytest.mark.parametrize("name", ["launch_testing", "launch_ros"])
def test_plugins_of_ros_that_this_pytest_refuses_are_left_out(tmp_path: Path, name: str) -> None:
    """Pytest 9 knows no argument ``path``: with such a plugin it does not start."""
    (tmp_path / "stub_plugin.py").write_text(PLUGIN.format(argument="path"))
    info = tmp_path / "stub_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stub_plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[pytest11]\n{name} = stub_plugin\n")
    assert "test_se3" in collected(tmp_path, "test/geometry/test_se3.py")


@pytest.mark.parametrize("hidden", ["", " ".join(OPTIONAL)], ids=["all there", "none there"])
def test_a_plugin_that_imports_each_module_collects_the_suite(tmp_path: Path, hidden: str) -> None:
    (tmp_path / "stub_plugin.py").write_text(PLUGIN.format(argument="module_path"))
    said = collected(tmp_path, "-p", "stub_plugin", hidden=hidden)
    assert "test/learning/test_cluster.py::" in said
    assert "test/simulation/test_rescan.py::" in said
    assert ("rclpy is not installed" in said) == bool(hidden)


def ask(python: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run another Python of this machine; skip where it is not there."""
    program = shutil.which(python)
    command = [program or "", *arguments]
    if not program or subprocess.run([program, "-c", ""], capture_output=True).returncode:
        pytest.skip(f"{python} is not installed")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)


@pytest.mark.parametrize("python", ["python3.8", "python3.9", "python3.10"])
def test_a_python_that_is_too_old_is_refused_in_one_sentence(python: str) -> None:
    done = ask(python, "setup.py", "--version")
    assert done.returncode == 1
    words = f"cello3d_ros needs Python 3.11 or newer, not {python.removeprefix('python')}"
    assert done.stderr.strip() == words


@pytest.mark.parametrize("python", ["python3.11", "python3.12", "python3.13"])
def test_the_example_runs_with_every_python_that_has_what_it_needs(python: str) -> None:
    if ask(python, "-c", "import numba, rosbags, tqdm, yaml").returncode:
        pytest.skip(f"{python} lacks the requirements of setup.py")
    done = ask(python, "-c", EXAMPLE)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip()
