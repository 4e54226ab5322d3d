"""The node beside an existing stack: ros2 launch cello3d_ros cello3d.launch.py points:=/lidar."""

from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "points": ("/points", "topic of the clouds (sensor_msgs/PointCloud2)"),
    "odom": ("/odom", "topic of the odometry (nav_msgs/Odometry)"),
    "reference_points": ("/reference_points", "topic of a map, when node.pairing is topics"),
    "external_odometry": ("/kiss/odometry", "poses to judge, when node.registration is external"),
    "external_pose": ("/external_pose", "the same as PoseWithCovarianceStamped"),
    "model": ("", "model file; empty is the shipped one"),
    "params": ("", "parameter file of the node; empty is the model's settings and the defaults"),
    "covariance_mode": ("", "cello3d, fused, ...; empty is that of the parameter file"),
    "name": ("covariance_node", "name of the node"),
    "namespace": ("", "namespace of the node"),
    "autostart": ("true", "false leaves configuring and activating to a life cycle manager"),
    "use_sim_time": ("false", "true when a simulator publishes /clock; a bag does"),
    "rviz": ("false", "true to open RViz"),
    "bag": ("", "rosbag2 folder to play; empty plays none"),
    "bag_delay_s": ("8.0", "wait before the bag, so that the node is ready"),
}
TOPICS = ("points", "odom", "reference_points", "external_odometry", "external_pose")


def actions(context):
    """Return what is started for the values of the arguments."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    use_sim_time = _is_true(given["use_sim_time"]) or bool(given["bag"])
    parameters = [given["params"]] if given["params"] else []
    parameters.append({"node.autostart": _is_true(given["autostart"])})
    parameters.append({"use_sim_time": use_sim_time})
    for name in ("model", "covariance_mode"):
        if given[name]:
            parameters.append({f"node.{name}": given[name]})
    started = [
        Node(
            package="cello3d_ros",
            executable="covariance_node",
            name=given["name"],
            namespace=given["namespace"] or None,
            output="screen",
            parameters=parameters,
            remappings=[(name, given[name]) for name in TOPICS],
        )
    ]
    if _is_true(given["rviz"]):
        view = PathJoinSubstitution([FindPackageShare("cello3d_ros"), "rviz", "cello3d.rviz"])
        started.append(
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", view],
                parameters=[{"use_sim_time": use_sim_time}],
            )
        )
    if given["bag"]:
        play = ["ros2", "bag", "play", given["bag"], "--clock", "--delay", given["bag_delay_s"]]
        started.append(ExecuteProcess(cmd=play, output="screen"))
    return started


def generate_launch_description() -> LaunchDescription:
    """Start covariance_node and, when asked for, RViz and a bag; with DDS fit for large clouds."""
    profile = PathJoinSubstitution(
        [FindPackageShare("cello3d_ros"), "config", "fastdds_large_clouds.xml"]
    )
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", profile),
            OpaqueFunction(function=actions),
        ]
    )


def _is_true(text: str) -> bool:
    return text.strip().lower() in ("true", "1", "yes", "on")
