"""The node and a bag: ros2 launch cello3d_ros demo.launch.py bag:=bags/demo."""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "bag": ("bags/demo", "rosbag2 folder with /points and /odom"),
    "model": ("", "model file; empty is the shipped one"),
    "covariance_mode": ("", "cello3d, fused, ...; empty is cello3d"),
    "rviz": ("false", "true to open RViz (package rviz2)"),
}


def generate_launch_description() -> LaunchDescription:
    """Include cello3d.launch.py with a bag that starts when the node is ready."""
    node = PathJoinSubstitution([FindPackageShare("cello3d_ros"), "launch", "cello3d.launch.py"])
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(node),
                launch_arguments={name: LaunchConfiguration(name) for name in ARGUMENTS}.items(),
            ),
        ]
    )
