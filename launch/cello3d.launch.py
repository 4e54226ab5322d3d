"""The node beside an existing stack: ros2 launch cello3d_ros cello3d.launch.py points:=/lidar."""

import os
from pathlib import Path

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
    "points": ("points", "topic of the clouds (sensor_msgs/PointCloud2)"),
    "odom": ("odom", "topic of the odometry (nav_msgs/Odometry)"),
    "reference_points": ("reference_points", "topic of a map, when node.pairing is topics"),
    "external_odometry": ("kiss/odometry", "poses to judge, when node.registration is external"),
    "external_pose": ("external_pose", "the same as PoseWithCovarianceStamped"),
    "model": ("", "model file; empty is that of the parameter file or the shipped one"),
    "params": ("", "parameter file of the node; empty is the model's settings and the defaults"),
    "covariance_mode": ("", "cello3d, fused, ...; empty is that of the parameter file"),
    "name": ("covariance_node", "name of the node"),
    "namespace": ("", "namespace of the node; topics that do not begin with / are in it"),
    "autostart": ("", "false leaves configuring and activating to a life cycle manager"),
    "use_sim_time": ("", "true when a simulator publishes /clock; a bag of this file does"),
    "rviz": ("false", "true to open RViz (package rviz2)"),
    "bag": ("", "rosbag2 folder to play; empty plays none"),
    "bag_delay_s": ("8.0", "wait before the bag, so that the node is ready"),
}
TOPICS = ("points", "odom", "reference_points", "external_odometry", "external_pose")
OUTPUTS = ("pose", "odometry", "markers")  # that RViz shows
PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"


def actions(context):
    """Return what is started for the values of the arguments; what is not given is not set."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if given["params"] and not Path(given["params"]).is_file():
        raise FileNotFoundError(f"params: there is no file {given['params']}")
    use_sim_time = given["use_sim_time"] or ("true" if given["bag"] else "")
    parameters = [given["params"]] if given["params"] else []
    if given["autostart"]:
        parameters.append({"node.autostart": _is_true(given["autostart"])})
    clock = [{"use_sim_time": _is_true(use_sim_time)}] if use_sim_time else []
    for name in ("model", "covariance_mode"):
        if given[name]:
            parameters.append({f"node.{name}": given[name]})
    started = [_profile()] if PROFILE not in os.environ else []
    started.append(
        Node(
            package="cello3d_ros",
            executable="covariance_node",
            name=given["name"],
            namespace=given["namespace"] or None,
            output="screen",
            parameters=parameters + clock,
            remappings=[(name, given[name]) for name in TOPICS],
        )
    )
    if _is_true(given["rviz"]):
        view = PathJoinSubstitution([FindPackageShare("cello3d_ros"), "rviz", "cello3d.rviz"])
        seen = [(f"/{name}", _absolute(given[name], given)) for name in ("points", "odom")]
        for output in OUTPUTS:
            here = _absolute(f"{given['name']}/{output}", given)
            seen.append((f"/covariance_node/{output}", here))
        started.append(
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", view],
                parameters=clock,
                remappings=seen,
            )
        )
    if given["bag"]:
        play = ["ros2", "bag", "play", given["bag"], "--clock", "--delay", given["bag_delay_s"]]
        started.append(ExecuteProcess(cmd=play, output="screen"))
    return started


def generate_launch_description() -> LaunchDescription:
    """Start covariance_node and, when asked for, RViz and a bag."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=actions),
        ]
    )


def _profile() -> SetEnvironmentVariable:
    """Return a DDS profile fit for large clouds, for those who have none of their own."""
    share = FindPackageShare("cello3d_ros")
    path = PathJoinSubstitution([share, "config", "fastdds_large_clouds.xml"])
    return SetEnvironmentVariable(PROFILE, path)


def _absolute(topic: str, given: dict[str, str]) -> str:
    if topic.startswith("/"):
        return topic
    return "/" + "/".join(part for part in (given["namespace"].strip("/"), topic) if part)


def _is_true(text: str) -> bool:
    return text.strip().lower() in ("true", "1", "yes", "on")
