"""Scans and poses as ROS messages of rosbags' own types; nothing here needs ROS."""

from __future__ import annotations

from typing import Any

import numpy as np

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.recordings.topics import CLOUD_TYPE, ODOMETRY_TYPE, TF_TYPES

_DATATYPES = {"<f4": 7, "<f8": 8}


class Messages:
    """Builds messages with the types of one typestore."""

    def __init__(self, typestore: Any) -> None:
        self._types = typestore.types

    def cloud(self, scan: Scan, double: bool = False) -> Any:
        """Return the PointCloud2 of a scan in the frame ``lidar``.

        x, y, z (and intensity, where known) float32, or x, y, z float64 if ``double``; ``time``
        (where known) float64 seconds after the stamp, so that no digit is lost.
        """
        kind = "<f8" if double else "<f4"
        columns = [(axis, kind, scan.points[:, k]) for k, axis in enumerate("xyz")]
        if scan.intensity is not None:
            columns.append(("intensity", "<f4", scan.intensity))
        if scan.time_s is not None:
            columns.append(("time", "<f8", scan.time_s))
        dtype = np.dtype([(name, kind) for name, kind, _ in columns])
        records = np.empty(len(scan.points), dtype)
        for name, _, values in columns:
            records[name] = values
        field = self._types["sensor_msgs/msg/PointField"]
        assert dtype.fields is not None
        return self._types[CLOUD_TYPE](
            header=self.header(scan.stamp_ns, "lidar"),
            height=1,
            width=len(records),
            fields=[
                field(name=n, offset=int(dtype.fields[n][1]), datatype=_DATATYPES[k], count=1)
                for n, k, _ in columns
            ],
            is_bigendian=False,
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * len(records),
            data=records.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def odometry(self, T: Array, stamp_ns: int, frame: str) -> Any:
        """Return the Odometry of ``lidar`` in a frame, of unknown (0) covariance and twist."""
        types = self._types
        unknown = np.zeros(36)
        still = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        twist = types["geometry_msgs/msg/Twist"](linear=still, angular=still)
        with_covariance = types["geometry_msgs/msg/PoseWithCovariance"]
        return types[ODOMETRY_TYPE](
            header=self.header(stamp_ns, frame),
            child_frame_id="lidar",
            pose=with_covariance(pose=self._pose(T), covariance=unknown),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=unknown),
        )

    def pose_with_covariance(self, T: Array, C: Array, stamp_ns: int, frame: str) -> Any:
        """Return a PoseWithCovarianceStamped.  C: (6, 6), ROS convention."""
        types = self._types
        return types["geometry_msgs/msg/PoseWithCovarianceStamped"](
            header=self.header(stamp_ns, frame),
            pose=types["geometry_msgs/msg/PoseWithCovariance"](
                pose=self._pose(T), covariance=np.ascontiguousarray(C, dtype=np.float64).ravel()
            ),
        )

    def transform(self, T: Array, stamp_ns: int, parent: str, child: str) -> Any:
        """Return a TFMessage of one transform: the pose of ``child`` in ``parent``."""
        types = self._types
        x, y, z, qx, qy, qz, qw = (float(v) for v in (*T[:3, 3], *se3.quaternion(T)))
        transform = types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
            rotation=types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
        )
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header=self.header(stamp_ns, parent), child_frame_id=child, transform=transform
        )
        return types[TF_TYPES[0]](transforms=[stamped])

    def header(self, stamp_ns: int, frame: str) -> Any:
        """Return a Header."""
        sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
        time = self._types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def _pose(self, T: Array) -> Any:
        types = self._types
        x, y, z, qx, qy, qz, qw = (float(v) for v in (*T[:3, 3], *se3.quaternion(T)))
        return types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
            orientation=types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
        )
