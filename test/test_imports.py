"""Importing needs neither ROS nor Open3D, and does nothing else."""

import subprocess
import sys

SCRIPT = """
import importlib, pkgutil, sys
for name in ("rclpy", "open3d", "sensor_msgs", "geometry_msgs", "nav_msgs", "diagnostic_msgs"):
    sys.modules[name] = None  # importing it now raises ImportError
import cello3d_ros
for module in pkgutil.walk_packages(cello3d_ros.__path__, "cello3d_ros."):
    if not module.name.startswith("cello3d_ros.ros."):
        importlib.import_module(module.name)
"""


def test_all_but_the_node_imports_without_ros_and_open3d(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []
