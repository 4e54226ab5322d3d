import sys
from glob import glob
from pathlib import Path

if sys.version_info < (3, 11):  # noqa: UP036 - before pip searches for old requirements
    sys.exit("cello3d_ros needs Python 3.11 or newer, not {}.{}".format(*sys.version_info))

from setuptools import find_packages, setup

NAME = "cello3d_ros"

ROS = ["ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp"]
OPEN3D = [
    "open3d-cpu>=0.19; platform_machine == 'x86_64'",
    "open3d>=0.19; platform_machine != 'x86_64'",
]
CSV = ["pyarrow>=15"]  # reads clouds and poses in CSV files; has no rosdep key
SIMULATION = ["embreex>=4.4; platform_machine == 'x86_64'"]  # ray tracing; needs numpy only
CLUSTER = ["distributed>=2024.1"]
SMALL_GICP = ["small_gicp>=1.0"]
REPORT = ["plotly>=6"]  # maintained; its 3-D views work in one file without a network
TOOLS = ["ruff", "mypy", "import-linter", "types-PyYAML", "playwright"]
FUSION = ["gtsam>=4.3"]  # pose graphs; its wheels take the numpy of today
INTEGRATION = ["g2opy>=2.3", "evo>=1.31", "pandas>=2.2"]  # what docs/integration.md shows
NOTEBOOK = ["nbclient>=0.10", "ipykernel>=6.29"]  # run docs/tutorial.ipynb; no Jupyter around it
DOCS = ["pdoc>=15"]  # reads docstrings as they are, needs no configuration and no theme
BENCH = ["kiss-icp>=1.2"]  # what benchmarks/online.py compares with
TEST = [
    "pytest",
    "scikit-learn>=1.3",
    "mcap>=1.1",
    "mcap-ros2-support>=0.5",
    *CSV,
    *SIMULATION,
    *CLUSTER,
    *SMALL_GICP,
    *REPORT,
]

setup(
    name=NAME,
    version="0.1.0",
    description="The covariance of ICP registrations, sampled, learned and predicted (CELLO-3D)",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="cello3d_ros maintainers",
    maintainer="cello3d_ros maintainers",
    maintainer_email="maintainers@cello3d.org",
    license="BSD-3-Clause",
    python_requires=">=3.11",
    classifiers=[f"Programming Language :: Python :: 3.{minor}" for minor in (11, 12, 13)],
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["models/*.npz", "py.typed", "reporting/assets/*"]},
    zip_safe=False,
    install_requires=[
        "numpy>=1.26,<2.5",
        "scipy>=1.11",
        "numba>=0.59",
        "llvmlite",  # numba says which
        "threadpoolctl>=3.1",
        "PyYAML>=6",
        "tqdm>=4.60",
        "matplotlib>=3.6",
        "rosbags>=0.11,<0.12",
    ],
    extras_require={
        "ros": ROS,
        "open3d": OPEN3D,
        "csv": CSV,
        "simulation": SIMULATION,
        "cluster": CLUSTER,
        "small_gicp": SMALL_GICP,
        "report": REPORT,
        "test": TEST,
        "fusion": FUSION,
        "docs": DOCS,
        "bench": BENCH,
        "dev": [
            *TEST,
            *FUSION,
            *INTEGRATION,
            *NOTEBOOK,
            *DOCS,
            "ruff",
            "mypy",
            "import-linter",
            "types-PyYAML",
            "playwright",
        ],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*.*")),
        (f"share/{NAME}/config/examples", glob("config/examples/*")),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/rviz", glob("rviz/*.rviz")),
        (f"share/{NAME}/bags/demo", glob("bags/demo/*")),
    ],
    entry_points={
        "console_scripts": [
            "covariance_node = cello3d_ros.ros.main:main",
            "cello3d = cello3d_ros.cli.main:main",
        ]
    },
)
