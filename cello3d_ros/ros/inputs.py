"""What the node listens to, by its settings."""

from __future__ import annotations

from enum import Enum, auto
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from cello3d_ros.config import NodeConfig
from cello3d_ros.ros.messages import livox_message, tf_message


class Role(Enum):
    """What the messages of a topic are to the node."""

    CLOUD = auto()
    POSE = auto()
    REFERENCE = auto()
    TRANSFORMS = auto()
    STATIC_TRANSFORMS = auto()


class Topic(NamedTuple):
    """One subscription."""

    role: Role
    kind: Any
    name: str
    qos: QoSProfile


def topics(config: NodeConfig) -> list[Topic]:
    """Return all subscriptions, clouds last: who hears clouds hears the rest as well.

    Static transforms and reference clouds are heard twice over: latched ones from before the node
    began, and those of publishers that do not latch.  Raises ConfigError when a type of message is
    not installed.
    """
    found = []
    if config.use_tf:
        kind = tf_message("node.use_tf")
        found += [
            *(
                Topic(Role.STATIC_TRANSFORMS, kind, "/tf_static", qos)
                for qos in (_latched(100), QoSProfile(depth=100))
            ),
            Topic(Role.TRANSFORMS, kind, "/tf", QoSProfile(depth=100)),
        ]
    if config.pairing == "topics":
        found += [
            Topic(Role.REFERENCE, PointCloud2, "reference_points", qos)
            for qos in (_latched(1), _best_effort(1))
        ]
    if config.registration == "external":
        found += [
            Topic(Role.POSE, Odometry, "external_odometry", _best_effort(200)),
            Topic(Role.POSE, PoseWithCovarianceStamped, "external_pose", _best_effort(200)),
        ]
    else:
        found.append(Topic(Role.POSE, Odometry, "odom", _best_effort(200)))
    kind = PointCloud2 if config.points_type == "PointCloud2" else livox_message()
    return [*found, Topic(Role.CLOUD, kind, "points", _best_effort(5))]


def _best_effort(depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT, depth=depth
    )


def _latched(depth: int) -> QoSProfile:
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)
