"""Importing needs neither ROS nor Open3D, does nothing else, and all that it needs is declared."""

import ast
import re
import subprocess
import sys
import xml.etree.ElementTree
from pathlib import Path

ROOT = Path(__file__).parents[1]
OF_PIP = {"yaml": "PyYAML", "open3d": "open3d-cpu"}  # distributions not called as their module
#: Modules without a rosdep key of their name: it, or that of a package that brings them.
OF_ROSDEP = {
    "open3d": "python3-open3d-pip",
    "rosbags": "python3-rosbags-pip",
    "threadpoolctl": "python3-sklearn",
    "llvmlite": "python3-numba",
}
#: Needed by few verbs and inputs only; built from source or of pip.
NO_KEY = {"pyarrow", "plotly", "small_gicp", "distributed", "embreex", "livox_ros_driver2"}

SCRIPT = """
import importlib, pkgutil, sys
for name in ("rclpy", "open3d", "embreex", "sensor_msgs", "geometry_msgs", "nav_msgs"):
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


def imported(folder: str) -> set[str]:
    """Modules of others that are imported in a folder, at the top of a file or late."""
    names: set[str] = set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(str(node.module))
    tops = {name.split(".")[0] for name in names}
    return tops - sys.stdlib_module_names - {"cello3d_ros"}


def is_of_ros(name: str) -> bool:
    return name in ("rclpy", "std_srvs", "livox_ros_driver2") or name.endswith(
        ("_msgs", "_interfaces")
    )


def keys_of_package_xml() -> set[str]:
    tree = xml.etree.ElementTree.parse(ROOT / "package.xml")
    return {str(e.text) for e in tree.iter() if e.tag == "exec_depend"}


def test_what_is_imported_has_its_key_in_package_xml():
    keys = keys_of_package_xml()
    for name in imported("cello3d_ros") | imported("launch"):
        known = {name, f"python3-{name}", OF_ROSDEP.get(name)}
        assert known & keys or name in NO_KEY, f"{name} is not in package.xml"


def test_what_is_imported_has_its_requirement_in_setup_py():
    text = (ROOT / "setup.py").read_text()
    for name in imported("cello3d_ros"):
        if not is_of_ros(name):  # of the extra ros, as a whole
            assert re.search(rf'"{OF_PIP.get(name, name)}\b', text), f"{name} is not in setup.py"


def test_package_xml_names_nothing_that_is_not_imported():
    used = imported("cello3d_ros") | imported("launch")
    names = {"python3-yaml": "yaml"} | {key: name for name, key in OF_ROSDEP.items()}
    # rclpy.lifecycle imports the first, the launch files run the others
    unseen = {"lifecycle_msgs", "ros2bag", "rosbag2_storage_mcap"}
    for key in keys_of_package_xml() - unseen:
        name = names.get(key, key.removeprefix("python3-"))
        assert name in used, f"{key} is in package.xml but not imported"


def test_every_requirement_of_setup_py_has_a_key_or_is_optional():
    tree = ast.parse((ROOT / "setup.py").read_text())
    words = {k.arg: k.value for n in ast.walk(tree) if isinstance(n, ast.Call) for k in n.keywords}
    required = {
        re.match(r"[\w-]+", str(r))[0] for r in ast.literal_eval(words["install_requires"])
    }
    assert "numpy" in required
    modules = {pip: module for module, pip in OF_PIP.items()}
    for name in required:
        module = modules.get(name, name)
        known = {f"python3-{module}", OF_ROSDEP.get(module)}
        assert known & keys_of_package_xml(), f"{name} is required but has no key in package.xml"
    assert not required & NO_KEY
