"""Arrays to and from nav_msgs and geometry_msgs."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2, PointField

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import to_fixed_axes
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros.covariances import CovarianceError as CovarianceError
from cello3d_ros.ros.covariances import ros_covariance as ros_covariance
from cello3d_ros.ros.odometry import checked_pose


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message with a header, in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def time_of(stamp_ns: int) -> Time:
    """Return a stamp as a builtin_interfaces/Time."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def pose_from(pose: Pose) -> Array:
    """Return a geometry_msgs/Pose as a (4, 4) matrix.  Raises OdometryError when damaged."""
    p, q = pose.position, pose.orientation
    return checked_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


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
    cells = np.ascontiguousarray(covariance, dtype=np.float64).reshape(36)
    if not np.isfinite(cells).all() or not se3.is_rigid(T):
        raise CovarianceError("the pose or its covariance is not finite")
    message = PoseWithCovarianceStamped()
    message.header.stamp = time_of(stamp_ns)
    message.header.frame_id = frame_id
    message.pose.pose = pose_to(T)
    message.pose.covariance = cells
    return message
