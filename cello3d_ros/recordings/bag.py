"""Recordings in ROS bags: rosbag1 (.bag), rosbag2 (a folder, .mcap or .db3)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.clouds.pointcloud2 import read_points
from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.bag_writer import (
    CLOUD_TYPE,
    GROUND_TRUTH,
    ODOMETRY,
    ODOMETRY_TYPE,
    write_bag,
)
from cello3d_ros.recordings.odometry import PoseTrack
from cello3d_ros.recordings.recording import Scan

__all__ = ["BagRecording", "write_bag"]

_POSE_TYPES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    ODOMETRY_TYPE: lambda m: (m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/msg/PoseStamped": lambda m: (m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/TransformStamped": lambda m: (
        m.transform.translation,
        m.transform.rotation,
    ),
}


_ENDINGS = (".bag", ".mcap", ".db3")


class Topics(NamedTuple):
    """Topics of a bag by what they are read as; None where there is none."""

    points: str
    odometry: str | None
    ground_truth: str | None


class BagRecording:
    """The clouds of one topic, with odometry and ground truth interpolated at their stamps.

    A topic that is not named is found by its type: the only PointCloud2; the only Odometry, or
    ``/odom`` of several; for ground truth ``/ground_truth``, or the only PoseStamped or
    TransformStamped.  The empty name says that there is none.  Poses are taken as those of the
    sensor itself.  A message without a stamp (0) has the time at which it was recorded.

    Raises RecordingError, in one sentence with the path, for whatever is wrong with the bag.
    """

    def __init__(
        self,
        path: Path | str,
        points_topic: str | None = None,
        odometry_topic: str | None = None,
        ground_truth_topic: str | None = None,
    ) -> None:
        self.path = Path(path)
        self._tracks: dict[str, PoseTrack] | None = None
        with _one_sentence(self.path):
            for file in [self.path] if self.path.is_file() else sorted(self.path.glob("*.db3")):
                _check_length(file)
        with _one_sentence(self.path), self._reader() as reader:
            types = {c.topic: c.msgtype for c in reader.connections}
            self.topics = _choose(types, points_topic, odometry_topic, ground_truth_topic)
            self._n_scans = sum(
                c.msgcount for c in reader.connections if c.topic == self.topics.points
            )

    @property
    def name(self) -> str:
        """Name of the file or folder, without its ending."""
        return self.path.stem if self.path.suffix in _ENDINGS else self.path.resolve().name

    def __len__(self) -> int:
        return self._n_scans

    def __iter__(self) -> Iterator[Scan]:
        truth, odometry = self._track(self.topics.ground_truth), self._track(self.topics.odometry)
        n, before_ns = 0, -1
        for _, stamp_ns, message in self._messages({self.topics.points}):
            with _one_sentence(self.path, f"cloud {n} of {self.topics.points}: "):
                points = read_points(message)
                if stamp_ns <= before_ns:
                    raise RecordingError(f"its stamp {stamp_ns} does not follow {before_ns}")
            n, before_ns = n + 1, stamp_ns
            yield Scan(
                stamp_ns=stamp_ns,
                points=points,
                T_world_sensor=None if truth is None else truth.at(stamp_ns),
                T_odom_sensor=None if odometry is None else odometry.at(stamp_ns),
            )
        if n < len(self):
            raise RecordingError(f"{self.path}: ends early, after {n} of {len(self)} clouds")

    def odometry(self) -> Iterator[tuple[int, Array]]:
        """Yield every odometry message as its stamp and T_odom_base (4, 4), in order of time."""
        yield from self._track(self.topics.odometry) or ()

    def _track(self, topic: str | None) -> PoseTrack | None:
        """Return the poses of a topic; those of both topics are read once, in one pass."""
        if self._tracks is None:
            wanted = {t for t in self.topics[1:] if t is not None}
            rows: dict[str, list[tuple[float, ...]]] = {t: [] for t in wanted}
            stamps: dict[str, list[int]] = {t: [] for t in wanted}
            for connection, stamp_ns, message in self._messages(wanted):
                position, rotation = _POSE_TYPES[connection.msgtype](message)
                stamps[connection.topic].append(stamp_ns)
                xyz = (position.x, position.y, position.z)
                xyzw = (rotation.x, rotation.y, rotation.z, rotation.w)
                rows[connection.topic].append((*xyz, *xyzw))
            self._tracks = {}
            for t in wanted:
                with _one_sentence(self.path, f"{t}: "):
                    self._tracks[t] = PoseTrack(stamps[t], rows[t])
        return self._tracks.get(topic) if topic is not None else None

    def _messages(self, topics: set[str]) -> Iterator[tuple[Any, int, Any]]:
        """Yield connection, stamp and message of the topics, in the order of recording."""
        if not topics:
            return
        with _one_sentence(self.path), self._reader() as reader:
            connections = [c for c in reader.connections if c.topic in topics]
            for connection, received_ns, raw in reader.messages(connections):
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
                yield connection, stamp_ns or int(received_ns), message

    def _reader(self) -> AnyReader:
        return AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_JAZZY))


@contextmanager
def _one_sentence(path: Path, where: str = "") -> Iterator[None]:
    """Turn whatever a damaged bag raises into a RecordingError with the path.

    rosbags parses untrusted bytes and lets through what its parsers raise (struct.error, KeyError,
    AssertionError, sqlite3.Error, zstd's and lz4's errors, ...), so nothing narrower will do.
    """
    try:
        yield
    except FileNotFoundError as error:
        what = "no such file or folder" if not path.exists() else "no metadata.yaml: not a rosbag2"
        raise RecordingError(f"{path}: {where}{what}") from error
    except Exception as error:
        if isinstance(error, RecordingError) and str(error).startswith(f"{path}: "):
            raise
        lines = str(error).splitlines() or [type(error).__name__]
        known = isinstance(error, Cello3dError)
        text = lines[0] if known else f"cannot be read ({lines[0].rstrip('.')})"
        raise RecordingError(f"{path}: {where}{text}") from error


def _check_length(file: Path) -> None:
    """Refuse an SQLite file shorter than its header says: SQLite reads the rest as zeros.

    Source: SQLite database file format, bytes 16-17 (page size) and 28-31 (pages), big-endian.
    """
    with file.open("rb") as stream:
        head = stream.read(32)
    if head.startswith(b"SQLite format 3\0") and len(head) == 32:
        page = int.from_bytes(head[16:18], "big")
        declared = (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big")
        if file.stat().st_size < declared:
            raise RecordingError(f"{file.name} has lost its end: {declared} bytes are declared")


def _choose(
    types: dict[str, str], points: str | None, odometry: str | None, ground_truth: str | None
) -> Topics:
    """Return the topics to read, of a bag's topics and their types and the names asked for."""
    clouds = [t for t, kind in types.items() if kind == CLOUD_TYPE]
    odometries = [t for t, kind in types.items() if kind == ODOMETRY_TYPE]
    poses = [t for t, kind in types.items() if kind in _POSE_TYPES and t not in odometries]
    cloud = _pick(points, clouds, "", "PointCloud2")
    if cloud is None:
        raise RecordingError(f"has no PointCloud2 topic; it has {', '.join(types) or 'none'}")
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
