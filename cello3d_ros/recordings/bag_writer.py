"""Scans to a rosbag2 (mcap) that every ROS tool plays."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.recording import Scan

POINTS, ODOMETRY, GROUND_TRUTH = "/points", "/odom", "/ground_truth"
CLOUD_TYPE, ODOMETRY_TYPE = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"

_FOREVER = QosTime(9223372036, 854775807)
_RELIABLE = Qos(
    history=QosHistory.KEEP_LAST,
    depth=10,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


def write_bag(
    path: Path | str,
    scans: Iterable[Scan],
    *,
    odometry_per_scan: int = 10,
    provenance: Mapping[str, str] | None = None,
) -> None:
    """Write scans, in order of time, into a new rosbag2 folder.

    ``/points`` is PointCloud2 (float32 x, y, z; frame ``lidar``); ``/odom`` and ``/ground_truth``
    are Odometry of ``lidar`` in ``odom`` and ``map``, left out where a scan has none.  Their
    covariances are 0: unknown.  ``/odom`` has a message at each cloud's stamp, just before the
    cloud, and interpolated ones between: ``odometry_per_scan`` an interval in all.

    provenance: kept as custom data in metadata.yaml.
    The folder appears under its name when it is complete.  Raises RecordingError when there is
    something of that name, no scan, a stamp that does not follow, or no room to write.
    """
    path = Path(path)
    if path.exists():
        raise RecordingError(f"{path} exists already; give another name or remove it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        try:
            _write(partial / path.name, scans, odometry_per_scan, provenance or {})
            os.rename(partial / path.name, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror or error}") from error


def _write(
    folder: Path, scans: Iterable[Scan], odometry_per_scan: int, provenance: Mapping[str, str]
) -> None:
    typestore = get_typestore(Stores.ROS2_JAZZY)
    connections: dict[str, Any] = {}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for key, value in provenance.items():
            writer.set_custom_data(key, value)
        for topic, stamp_ns, message in _messages(scans, odometry_per_scan, typestore):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, kind, typestore=typestore, offered_qos_profiles=[_RELIABLE]
                )
            writer.write(connections[topic], stamp_ns, typestore.serialize_cdr(message, kind))
        if not connections:
            raise RecordingError(f"there is no scan to write into {folder.name}")


def _messages(
    scans: Iterable[Scan], odometry_per_scan: int, typestore: Any
) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, stamp and message in order of time."""
    before: Scan | None = None
    for scan in scans:
        if before is not None and scan.stamp_ns <= before.stamp_ns:
            raise RecordingError(
                f"scans are not in order of time: {scan.stamp_ns} follows {before.stamp_ns}"
            )
        for stamp_ns, T in _odometry(before, scan, odometry_per_scan):
            yield ODOMETRY, stamp_ns, _pose_message(T, stamp_ns, "odom", typestore)
        if (T_world := scan.T_world_sensor) is not None:
            message = _pose_message(T_world, scan.stamp_ns, "map", typestore)
            yield GROUND_TRUTH, scan.stamp_ns, message
        yield POINTS, scan.stamp_ns, _cloud_message(scan, typestore)
        before = scan


def _odometry(before: Scan | None, scan: Scan, n: int) -> Iterator[tuple[int, Array]]:
    """Yield odometry after the scan before, up to and at this one."""
    if scan.T_odom_sensor is None:
        return
    if before is not None and before.T_odom_sensor is not None:
        span = scan.stamp_ns - before.stamp_ns
        for stamp_ns in sorted({before.stamp_ns + span * k // n for k in range(1, n)}):
            if before.stamp_ns < stamp_ns < scan.stamp_ns:
                share = (stamp_ns - before.stamp_ns) / span
                yield stamp_ns, se3.interpolate(before.T_odom_sensor, scan.T_odom_sensor, share)
    yield scan.stamp_ns, scan.T_odom_sensor


def _header(stamp_ns: int, frame: str, typestore: Any) -> Any:
    types = typestore.types
    time = types["builtin_interfaces/msg/Time"](
        sec=int(stamp_ns // 1_000_000_000), nanosec=int(stamp_ns % 1_000_000_000)
    )
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _cloud_message(scan: Scan, typestore: Any) -> Any:
    types = typestore.types
    field = types["sensor_msgs/msg/PointField"]
    data = np.ascontiguousarray(scan.points, dtype="<f4")
    return types[CLOUD_TYPE](
        header=_header(scan.stamp_ns, "lidar", typestore),
        height=1,
        width=len(data),
        fields=[field(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(data),
        data=data.reshape(-1).view(np.uint8),
        is_dense=True,
    )


def _pose_message(T: Array, stamp_ns: int, frame: str, typestore: Any) -> Any:
    types = typestore.types
    x, y, z = (float(v) for v in T[:3, 3])
    qx, qy, qz, qw = (float(v) for v in se3.quaternion(T))
    unknown = np.zeros(36)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
        orientation=types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
    )
    still = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = types["geometry_msgs/msg/Twist"](linear=still, angular=still)
    return types[ODOMETRY_TYPE](
        header=_header(stamp_ns, frame, typestore),
        child_frame_id="lidar",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=unknown),
    )
