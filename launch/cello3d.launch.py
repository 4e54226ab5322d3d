"""The node beside an existing stack: ros2 launch cello3d_ros cello3d.launch.py points:=/lidar."""

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "points": ("/points", "topic of the clouds (sensor_msgs/PointCloud2)"),
    "odom": ("/odom", "topic of the odometry (nav_msgs/Odometry)"),
    "model": ("", "model file; empty is the shipped one"),
    "name": ("covariance_node", "name of the node"),
    "use_sim_time": ("false", "true when a simulator or a bag publishes /clock"),
    "rviz": ("false", "true to open RViz"),
}


def generate_launch_description() -> LaunchDescription:
    """Start covariance_node and, when asked for, RViz; both with DDS fit for large clouds."""
    share = FindPackageShare("cello3d_ros")
    profile = PathJoinSubstitution([share, "config", "fastdds_large_clouds.xml"])
    view = PathJoinSubstitution([share, "rviz", "cello3d.rviz"])
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    model = ParameterValue(LaunchConfiguration("model"), value_type=str)
    node = Node(
        package="cello3d_ros",
        executable="covariance_node",
        name=LaunchConfiguration("name"),
        output="screen",
        parameters=[{"node.model": model, "use_sim_time": use_sim_time}],
        remappings=[
            ("points", LaunchConfiguration("points")),
            ("odom", LaunchConfiguration("odom")),
        ],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", view],
        parameters=[{"use_sim_time": use_sim_time}],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", profile),
            node,
            rviz,
        ]
    )
