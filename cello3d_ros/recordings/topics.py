"""Which topics of a bag are read as what."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from cello3d_ros.clouds import livox
from cello3d_ros.errors import RecordingError

POINTS, ODOMETRY, GROUND_TRUTH = "/points", "/odom", "/ground_truth"
TF, TF_STATIC = "/tf", "/tf_static"
CLOUD_TYPE, ODOMETRY_TYPE = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"
_SCAN_2D = "sensor_msgs/msg/LaserScan"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

POSE_TYPES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    ODOMETRY_TYPE: lambda m: (m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/msg/PoseStamped": lambda m: (m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/TransformStamped": lambda m: (
        m.transform.translation,
        m.transform.rotation,
    ),
}


class Topics(NamedTuple):
    """Topics of a bag by what they are read as; None where there is none."""

    points: str
    odometry: str | None
    ground_truth: str | None


def choose(
    types: dict[str, str], points: str | None, odometry: str | None, ground_truth: str | None
) -> Topics:
    """Return the topics to read, of a bag's topics and their types and the names asked for."""
    clouds = [t for t, kind in types.items() if kind in (CLOUD_TYPE, *livox.TYPES)]
    odometries = [t for t, kind in types.items() if kind == ODOMETRY_TYPE]
    poses = [t for t, kind in types.items() if kind in POSE_TYPES and t not in odometries]
    cloud = _pick(points, clouds, "", "PointCloud2")
    if cloud is None:
        planar = [t for t, kind in types.items() if kind == _SCAN_2D]
        what = f"; the scans on {planar[0]} are 2-D, a 3-D lidar is needed" if planar else ""
        raise RecordingError(
            f"has no PointCloud2 topic{what}; it has {', '.join(types) or 'none'}"
        )
    named = ground_truth is not None or GROUND_TRUTH in odometries
    candidates = odometries + poses if named else poses
    truth = _pick(ground_truth, candidates, GROUND_TRUTH, "ground truth")
    rest = [t for t in odometries if t != truth or t == odometry]
    return Topics(cloud, _pick(odometry, rest, ODOMETRY, "Odometry"), truth)


def _pick(named: str | None, candidates: list[str], usual: str, what: str) -> str | None:
    """Return the topic named, else the usual or only one; None if there is none."""
    listed = ", ".join(sorted(candidates)) or "none"
    if named == "":
        return None
    if named is not None:
        if named not in candidates:
            raise RecordingError(f"has no {what} topic {named!r}; candidates are {listed}")
        return named
    if usual in candidates:
        return usual
    if len(candidates) > 1:
        raise RecordingError(f"has several {what} topics, name one of {listed}")
    return candidates[0] if candidates else None
