"""What is installed holds all that the package needs: models, demo bag, assets of the pages."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("cello3d_ros", "bags", "config", "launch", "rviz", "resource")
FILES = ("setup.py", "setup.cfg", "package.xml", "README.md")


def test_the_installed_package_has_models_and_demo_bag(tmp_path: Path) -> None:
    for name in FOLDERS:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, tmp_path / "src" / name, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, tmp_path / "src" / name)
    build, data = (
        ["build_py", "--build-lib", tmp_path],
        ["install_data", "--install-dir", tmp_path],
    )
    command = [sys.executable, "setup.py", *build, *data]
    subprocess.run(command, cwd=tmp_path / "src", capture_output=True, check=True)
    package, share = tmp_path / "cello3d_ros", tmp_path / "share" / "cello3d_ros"
    for name in ("models/general.npz", "reporting/assets/report.css", "py.typed", "ros/node.py"):
        assert (package / name).exists()
    for name in ("bags/demo/demo.mcap", "bags/demo/metadata.yaml", "config/cello3d.yaml"):
        assert (share / name).exists()
    code = "from cello3d_ros.cli.demo import demo_bag; print(demo_bag())"
    shutil.rmtree(tmp_path / "src")
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"{share / 'bags' / 'demo'}\n"
