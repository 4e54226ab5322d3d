"""Kernels are compiled, with one warning, where neither a cache nor a home can be written."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import cello3d_ros

POWERS = "-dac_override,-dac_read_search,-fowner"  # with which root writes everywhere


@pytest.fixture
def sealed(tmp_path: Path) -> Iterator[Path]:
    """A folder with the package and a home, in which nothing can be written."""
    package = Path(cello3d_ros.__file__).parent
    ignored = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    shutil.copytree(package, tmp_path / "install" / "cello3d_ros", ignore=ignored)
    (tmp_path / "home").mkdir()
    rng = np.random.default_rng(0)
    points = rng.uniform(-4, 4, (6000, 3))
    points[np.arange(6000), rng.integers(0, 3, 6000)] = 4 * rng.choice([-1, 1], 6000)
    np.save(tmp_path / "reference.npy", points)
    np.save(tmp_path / "reading.npy", points - [0.1, 0.0, 0.0])
    folders = [path for path in (tmp_path, *tmp_path.rglob("*")) if path.is_dir()]
    for folder in folders:
        folder.chmod(0o555)
    yield tmp_path
    for folder in folders:
        folder.chmod(0o755)


def command(*words: str) -> list[str]:
    """Return a command that permissions bind, also when root runs it."""
    if os.geteuid() != 0:
        return [sys.executable, *words]
    if shutil.which("setpriv") is None:
        pytest.skip("root needs setpriv to be bound by permissions")
    return ["setpriv", f"--bounding-set={POWERS}", sys.executable, *words]


def environment(folder: Path, **more: str) -> dict[str, str]:
    """Return an environment that names no folder that can be written, except in ``more``."""
    named = {"PATH": os.defpath, "HOME": str(folder / "home"), "PYTHONDONTWRITEBYTECODE": "1"}
    return {**named, "PYTHONPATH": str(folder / "install"), **more}


def test_estimate_answers_with_one_warning_that_names_the_variable(sealed: Path) -> None:
    words = ("-m", "cello3d_ros.cli.main", "estimate", "reading.npy", "reference.npy")
    done = subprocess.run(
        command(*words),
        env=environment(sealed),
        cwd=sealed,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("NUMBA_CACHE_DIR") == 1
    assert done.stdout.startswith("T_ref_read")
    assert not list(sealed.rglob("*.nbi"))


@pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy is not installed")
@pytest.mark.parametrize("log", ["a log folder", "none"])
def test_the_node_works_or_names_the_folder_of_its_log(
    sealed: Path, tmp_path_factory: pytest.TempPathFactory, log: str
) -> None:
    folder = tmp_path_factory.mktemp("log")
    from cello3d_ros.ros.process import environment as of_ros

    more = of_ros(101 + os.getpid() % 50)
    if log != "none":
        more["ROS_LOG_DIR"] = str(folder)
    process = subprocess.Popen(
        command("-m", "cello3d_ros.ros.main"),
        env=environment(sealed, **more),
        cwd=sealed,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        said = ""
        assert process.stdout is not None
        for line in process.stdout:
            said += line
            if "ready" in line:
                process.terminate()
        status = process.wait(60)
    finally:
        process.kill()
    assert "Traceback" not in said
    if log == "none":
        assert status == 1
        assert "ROS_LOG_DIR" in said
        assert "these ROS arguments" not in said
    else:
        assert status == 0, said
        assert said.count("NUMBA_CACHE_DIR") == 1
