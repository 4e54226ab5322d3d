"""The node, RViz and a bag: ros2 launch cello3d_ros demo.launch.py bag:=bags/demo."""

from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Include cello3d.launch.py and play a bag after a while, so that the node is ready."""
    node = PathJoinSubstitution([FindPackageShare("cello3d_ros"), "launch", "cello3d.launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="rosbag2 folder with /points and /odom"),
            DeclareLaunchArgument("model", default_value="", description="empty: the shipped one"),
            DeclareLaunchArgument("rviz", default_value="true", description="true to open RViz"),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(node),
                launch_arguments={
                    "model": LaunchConfiguration("model"),
                    "rviz": LaunchConfiguration("rviz"),
                }.items(),
            ),
            ExecuteProcess(
                cmd=["ros2", "bag", "play", LaunchConfiguration("bag"), "--delay", "8"],
                output="screen",
            ),
        ]
    )
