"""Arrays to and from nav_msgs and geometry_msgs."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Pose, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2, PointField

from cello3d_ros.errors import ConfigError, CovarianceError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import is_positive_definite, to_fixed_axes
from cello3d_ros.geometry.pose_track import checked_pose
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.tracking.covariances import ros_covariance as ros_covariance


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message with a header, in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def time_of(stamp_ns: int) -> Time:
    """Return a stamp as a builtin_interfaces/Time."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def duration_of(seconds: float) -> Duration:
    """Return a builtin_interfaces/Duration, rounded to nanoseconds."""
    sec, nanosec = divmod(round(seconds * 1e9), 1_000_000_000)
    return Duration(sec=sec, nanosec=nanosec)


def pose_from(pose: Pose) -> Array:
    """Return a geometry_msgs/Pose as a (4, 4) matrix.  Raises PoseError when damaged."""
    return checked_pose(pose.position, pose.orientation)


def covariance_from(message: Any) -> Array | None:
    """Return the right covariance (6, 6) of a message with a pose, or None where it has none.

    It has none where it is not positive definite: drivers leave it at zero, or mark it with -1.
    """
    C = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    if not is_positive_definite(C):
        return None
    return reading_covariance(C, pose_from(message.pose.pose)[:3, :3])


def pose_to(T: Array) -> Pose:
    """Return a (4, 4) pose as a geometry_msgs/Pose."""
    pose = Pose()
    p, q = pose.position, pose.orientation
    p.x, p.y, p.z = (float(value) for value in T[:3, 3])
    q.x, q.y, q.z, q.w = (float(value) for value in se3.quaternion(T))
    return pose


def odometry_to(stamp_ns: int, frame_id: str, child_frame_id: str, T: Array) -> Odometry:
    """Return nav_msgs/Odometry with the pose of ``child_frame_id`` in ``frame_id``."""
    message = Odometry()
    message.header.stamp = time_of(stamp_ns)
    message.header.frame_id = frame_id
    message.child_frame_id = child_frame_id
    message.pose.pose = pose_to(T)
    return message


def cloud_to(stamp_ns: int, frame_id: str, points: Array) -> PointCloud2:
    """Return a sensor_msgs/PointCloud2 of float32 x, y, z.  points: (N, 3)."""
    cells = np.ascontiguousarray(points, dtype="<f4").reshape(-1, 3)
    message = PointCloud2(height=1, width=len(cells), point_step=12, row_step=12 * len(cells))
    message.header.stamp = time_of(stamp_ns)
    message.header.frame_id = frame_id
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    message.is_dense = True
    data = array.array("B")  # assigned as it is, a thousand times faster than an ndarray
    data.frombytes(cells.tobytes())
    message.data = data
    return message


def reading_covariance(C: Array, R_header_read: Array) -> Array:
    """Return the reading-side covariance of a PoseWithCovariance's: ``Y = B^T C B``.  (6, 6)."""
    return to_fixed_axes(np.transpose(R_header_read), np.reshape(C, (6, 6)))


def pose_with_covariance(
    stamp_ns: int, frame_id: str, T: Array, covariance: Array
) -> PoseWithCovarianceStamped:
    """Return the message of a pose and its covariance in the ROS convention (ros_covariance)."""
    if not se3.is_rigid(T):
        raise CovarianceError("the pose is not finite")
    message = PoseWithCovarianceStamped()
    message.header.stamp = time_of(stamp_ns)
    message.header.frame_id = frame_id
    message.pose.pose = pose_to(T)
    message.pose.covariance = _cells(covariance)
    return message


def full_odometry(
    pose: PoseWithCovarianceStamped, child_frame_id: str, twist: Array, covariance: Array
) -> Odometry:
    """Return nav_msgs/Odometry with a pose, a twist and both covariances.

    pose: of ``child_frame_id`` in its header's frame.  twist: (6,), (v, omega) of the child along
    its own axes; covariance: (6, 6), along the same axes (twist_covariance).
    """
    twist = np.asarray(twist, dtype=np.float64)
    if not np.isfinite(twist).all():
        raise CovarianceError("the twist is not finite")
    message = Odometry(header=pose.header, child_frame_id=child_frame_id, pose=pose.pose)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z = (float(value) for value in twist[:3])
    angular.x, angular.y, angular.z = (float(value) for value in twist[3:])
    message.twist.covariance = _cells(covariance)
    return message


def transform_to(stamp_ns: int, frame_id: str, child_frame_id: str, T: Array) -> TransformStamped:
    """Return the pose of ``child_frame_id`` in ``frame_id`` as TF has it."""
    message = TransformStamped(child_frame_id=child_frame_id)
    message.header.stamp = time_of(stamp_ns)
    message.header.frame_id = frame_id
    pose = pose_to(T)
    p, t = pose.position, message.transform.translation
    t.x, t.y, t.z = p.x, p.y, p.z
    message.transform.rotation = pose.orientation
    return message


def tf_message(parameter: str) -> Any:
    """Return tf2_msgs/TFMessage, which only some parameters need.  Raises ConfigError."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        raise ConfigError(
            f"parameter {parameter} needs the package tf2_msgs: apt install ros-jazzy-tf2-msgs, "
            "or leave it false"
        ) from None
    return TFMessage


def livox_message() -> Any:
    """Return livox_ros_driver2/CustomMsg, which Livox's driver brings.  Raises ConfigError."""
    try:
        from livox_ros_driver2.msg import CustomMsg
    except ImportError:
        raise ConfigError(
            "parameter node.points_type CustomMsg needs the package livox_ros_driver2: build "
            "Livox's driver and source its workspace, or let it publish PointCloud2"
        ) from None
    return CustomMsg


def _cells(covariance: Array) -> Array:
    """Return 36 finite doubles, row by row."""
    cells = np.ascontiguousarray(covariance, dtype=np.float64).reshape(36)
    if not np.isfinite(cells).all():
        raise CovarianceError("the covariance is not finite")
    return cells
