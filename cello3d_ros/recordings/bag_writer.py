"""Scans to a rosbag2 (mcap or sqlite3) that every ROS tool plays."""

from __future__ import annotations

import sqlite3
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

from cello3d_ros.atomic import new_folder
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.bag_messages import Messages
from cello3d_ros.recordings.mcap_checksums import add_checksums
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.recordings.topics import (
    CLOUD_TYPE,
    GROUND_TRUTH,
    ODOMETRY,
    ODOMETRY_TYPE,
    POINTS,
    TF,
    TF_STATIC,
)

__all__ = ["CLOUD_TYPE", "GROUND_TRUTH", "ODOMETRY", "ODOMETRY_TYPE", "POINTS", "write_bag"]

_FOREVER = QosTime(9223372036, 854775807)
_LATCHED = {TF_STATIC}
ODOMETRY_PER_SCAN = 10


def write_bag(
    path: Path | str,
    scans: Iterable[Scan],
    *,
    odometry: int | PoseTrack = ODOMETRY_PER_SCAN,
    provenance: Mapping[str, str] | None = None,
    storage: str = "mcap",
    double: bool = False,
) -> int:
    """Write scans, in order of time, into a new rosbag2 folder; return how many there were.

    ``/points`` is PointCloud2 (float32 x, y, z, ...; frame ``lidar``); ``/odom`` and
    ``/ground_truth`` are Odometry of ``lidar`` in ``odom`` and ``map``, left out where a scan has
    none.  Their covariances are 0: unknown.  ``/odom`` has a message at each cloud's stamp, just
    before the cloud, and others between: ``odometry`` an interval in all, interpolated, or those
    of a track, which may begin before the first scan.
    ``/tf`` has map -> odom -> base_link (without odometry map -> base_link), ``/tf_static``
    base_link -> lidar, the identity.

    provenance: kept as custom data in metadata.yaml.  storage: "mcap" or "sqlite3".
    double: x, y, z as float64, which RViz does not show.
    The folder appears under its name when it is complete.  Raises RecordingError when there is no
    scan or a stamp does not follow, WriteError when there is something of that name or no room.
    """
    path = Path(path)
    counts = {POINTS: 0}
    messages = _messages(scans, odometry, double)
    with new_folder(path) as folder:
        write_messages(folder, _counted(messages, counts), provenance or {}, storage)
        if not counts[POINTS]:
            raise RecordingError(f"there is no scan to write into {path.name}")
    return counts[POINTS]


def write_messages(
    folder: Path,
    messages: Iterable[tuple[str, int, Any]],
    provenance: Mapping[str, str] | None = None,
    storage: str = "mcap",
) -> None:
    """Write messages (topic, time in ns, message) of rosbags' types into a rosbag2 folder."""
    serialize = get_typestore(Stores.ROS2_JAZZY).serialize_cdr
    raw = (
        (topic, message.__msgtype__, stamp_ns, serialize(message, message.__msgtype__))
        for topic, stamp_ns, message in messages
    )
    write_raw(folder, raw, provenance, storage)


def write_raw(
    folder: Path,
    messages: Iterable[tuple[str, str, int, bytes | memoryview]],
    provenance: Mapping[str, str] | None = None,
    storage: str = "mcap",
) -> None:
    """Write messages (topic, ROS type, time in ns, CDR bytes) into a rosbag2 folder.

    Raises OSError where the disk refuses.
    """
    typestore = get_typestore(Stores.ROS2_JAZZY)
    connections: dict[str, Any] = {}
    try:
        with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
            for key, value in (provenance or {}).items():
                writer.set_custom_data(key, value)
            for topic, kind, time_ns, data in messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, kind, typestore=typestore, offered_qos_profiles=[_qos(topic)]
                    )
                writer.write(connections[topic], time_ns, data)
    except sqlite3.Error as error:
        raise OSError(str(error)) from error
    for file in folder.glob("*.mcap"):
        add_checksums(file)


def _counted(
    messages: Iterable[tuple[str, int, Any]], counts: dict[str, int]
) -> Iterator[tuple[str, int, Any]]:
    for message in messages:
        counts[POINTS] += message[0] == POINTS
        yield message


def _qos(topic: str) -> Qos:
    latched = topic in _LATCHED
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def _messages(
    scans: Iterable[Scan], between: int | PoseTrack, double: bool
) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, stamp and message in order of time."""
    make = Messages(get_typestore(Stores.ROS2_JAZZY))
    before: Scan | None = None
    for scan in scans:
        now = scan.stamp_ns
        if before is None:
            first = now if isinstance(between, int) else min(now, int(between.stamps_ns[0]))
            yield TF_STATIC, first, make.transform(np.eye(4), first, "base_link", "lidar")
        elif now <= before.stamp_ns:
            raise RecordingError(
                f"scans are not in order of time: {now} follows {before.stamp_ns}"
            )
        for stamp_ns, T in _odometry(before, scan, between):
            yield ODOMETRY, stamp_ns, make.odometry(T, stamp_ns, "odom")
            yield TF, stamp_ns, make.transform(T, stamp_ns, "odom", "base_link")
        if (T_world := scan.T_world_sensor) is not None:
            yield GROUND_TRUTH, now, make.odometry(T_world, now, "map")
            if (T_odom := scan.T_odom_sensor) is not None:
                yield TF, now, make.transform(T_world @ se3.inverse(T_odom), now, "map", "odom")
            else:
                yield TF, now, make.transform(T_world, now, "map", "base_link")
        yield POINTS, now, make.cloud(scan, double)
        before = scan


def _odometry(
    before: Scan | None, scan: Scan, between: int | PoseTrack
) -> Iterator[tuple[int, Array]]:
    """Yield odometry after the scan before, up to and at this one."""
    if scan.T_odom_sensor is None:
        return
    if not isinstance(between, int):
        stamps = between.stamps_ns
        after = 0 if before is None else np.searchsorted(stamps, before.stamp_ns, side="right")
        for stamp_ns in stamps[after : np.searchsorted(stamps, scan.stamp_ns)].tolist():
            yield stamp_ns, between.pose(stamp_ns)
    elif before is not None and before.T_odom_sensor is not None:
        span = scan.stamp_ns - before.stamp_ns
        for stamp_ns in sorted({before.stamp_ns + span * k // between for k in range(1, between)}):
            if before.stamp_ns < stamp_ns < scan.stamp_ns:
                share = (stamp_ns - before.stamp_ns) / span
                yield stamp_ns, se3.interpolate(before.T_odom_sensor, scan.T_odom_sensor, share)
    yield scan.stamp_ns, scan.T_odom_sensor
