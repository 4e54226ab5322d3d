"""Recordings in ROS bags: rosbag1 (.bag), rosbag2 (a folder, .mcap or .db3)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.clouds.point_times import INTENSITIES, NAMES, TimeLaw, recognise, relative_s
from cello3d_ros.clouds.pointcloud2 import read_fields
from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack, checked_pose
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.geometry.transforms import NotConnectedError, TransformTree
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.recordings.topics import POSE_TYPES, TF_STATIC, TF_TYPES, choose

__all__ = ["BagRecording"]

_ENDINGS = (".bag", ".mcap", ".db3")


class _Poses:
    """What a bag says of poses: tracks by topic, the frames they are of, and transforms."""

    def __init__(self) -> None:
        self.tracks: dict[str, PoseTrack] = {}
        self.child_frames: dict[str, str] = {}
        self.tree = TransformTree()


class BagRecording:
    """The clouds of one topic, with odometry and ground truth interpolated at their stamps.

    A topic that is not named is found by its type: the only PointCloud2; the only Odometry, or
    ``/odom`` of several; for ground truth ``/ground_truth``, or the only PoseStamped or
    TransformStamped.  The empty name says that there is none.  ``ground_truth_frames`` takes the
    ground truth from TF instead: the pose of the second frame in the first.

    Poses of another frame than the clouds' are moved to the sensor by ``T_base_sensor``, else by
    the static transforms; where neither says anything they are taken as those of the sensor.
    A message without a stamp (0) has the time at which it was recorded.

    Raises RecordingError, in one sentence with the path, for whatever is wrong with the bag.
    """

    def __init__(
        self,
        path: Path | str,
        points_topic: str | None = None,
        odometry_topic: str | None = None,
        ground_truth_topic: str | None = None,
        *,
        ground_truth_frames: tuple[str, str] | None = None,
        T_base_sensor: Array | None = None,
    ) -> None:
        self.path = Path(path)
        self._frames, self._T_base_sensor = ground_truth_frames, T_base_sensor
        self._poses: _Poses | None = None
        with _one_sentence(self.path):
            self._parts = _parts(self.path)
            for file in [self.path] if self.path.is_file() else sorted(self.path.glob("*.db3")):
                _check_length(file)
        with _one_sentence(self.path), self._reader() as reader:
            self.types = {c.topic: c.msgtype for c in reader.connections}
            self.counts = dict.fromkeys(self.types, 0)
            for c in reader.connections:
                self.counts[c.topic] += c.msgcount
            named = "" if ground_truth_frames is not None else ground_truth_topic
            self.topics = choose(self.types, points_topic, odometry_topic, named)
            if ground_truth_frames is not None and not self._tf_topics():
                raise RecordingError("has no TFMessage topic to take ground truth from")

    @property
    def name(self) -> str:
        """Name of the file or folder, without its ending."""
        return self.path.stem if self.path.suffix in _ENDINGS else self.path.resolve().name

    def __len__(self) -> int:
        return self.counts[self.topics.points]

    def __iter__(self) -> Iterator[Scan]:
        n, before_ns = 0, -1
        law: TimeLaw | None = None
        for _, stamp_ns, message in self._messages({self.topics.points}):
            with _one_sentence(self.path, f"cloud {n} of {self.topics.points}: "):
                scan, law = _scan(message, stamp_ns, law)
                if stamp_ns <= before_ns:
                    raise RecordingError(f"its stamp {stamp_ns} does not follow {before_ns}")
                frame = message.header.frame_id
                truth = self._truth(stamp_ns, frame)
                odometry = self._pose(self.topics.odometry, stamp_ns, frame)
            n, before_ns = n + 1, stamp_ns
            yield Scan(**{**vars(scan), "T_world_sensor": truth, "T_odom_sensor": odometry})
        if n < len(self):
            raise RecordingError(f"{self.path}: ends early, after {n} of {len(self)} clouds")

    @property
    def n_projected(self) -> int:
        """0: quaternions are normalised, which is no projection."""
        return 0

    @property
    def has_odometry(self) -> bool:
        """Whether there is a topic of odometry."""
        return self.topics.odometry is not None

    def odometry(self) -> Iterator[tuple[int, Array]]:
        """Yield every odometry message as its stamp and T_odom_base (4, 4), in order of time."""
        if self.topics.odometry is not None:
            yield from self._read_poses().tracks[self.topics.odometry]

    def track(self) -> PoseTrack | None:
        """Return the sensor's poses at all odometry messages, else all of ground truth's."""
        topic = self.topics.odometry or self.topics.ground_truth
        if topic is None:
            return None
        track = self._read_poses().tracks[topic]
        _, _, first = next(self._messages({self.topics.points}))
        T = np.array([T for _, T in track]).reshape(-1, 4, 4)
        T_base_sensor = self._extrinsic(topic, first.header.frame_id)
        return PoseTrack.of_poses(track.stamps_ns, T @ T_base_sensor)

    def _truth(self, stamp_ns: int, frame: str) -> Array | None:
        if self._frames is None:
            return self._pose(self.topics.ground_truth, stamp_ns, frame)
        tree = self._read_poses().tree
        try:
            return tree.at(*self._frames, stamp_ns) @ self._moved(self._frames[1], frame)
        except NotConnectedError:
            raise
        except PoseError:
            return None

    def _pose(self, topic: str | None, stamp_ns: int, frame: str) -> Array | None:
        if topic is None:
            return None
        T = self._read_poses().tracks[topic].at(stamp_ns)
        return None if T is None else T @ self._extrinsic(topic, frame)

    def _extrinsic(self, topic: str, frame: str) -> Array:
        """Return the pose (4, 4) of the clouds' frame in the frame whose pose a topic tells."""
        return self._moved(self._read_poses().child_frames.get(topic, frame), frame)

    def _moved(self, base: str, frame: str) -> Array:
        if self._T_base_sensor is not None:
            return self._T_base_sensor
        T = None if base == frame else self._read_poses().tree.constant(base, frame)
        return np.eye(4) if T is None else T

    def _read_poses(self) -> _Poses:
        """Return all poses of the bag but the clouds, read once, in one pass."""
        if self._poses is None:
            poses = _Poses()
            wanted = {t for t in self.topics[1:] if t is not None}
            poses.tracks = {t: PoseTrack() for t in wanted}
            n_read = dict.fromkeys(wanted, 0)
            for topic, stamp_ns, message in self._messages(wanted | self._tf_topics()):
                with _one_sentence(self.path, f"{topic}: "):
                    if topic in wanted:
                        T = checked_pose(*POSE_TYPES[self.types[topic]](message))
                        poses.tracks[topic].add(stamp_ns, T)
                        n_read[topic] += 1
                        if child := getattr(message, "child_frame_id", ""):
                            poses.child_frames.setdefault(topic, child)
                    else:
                        for sentence in poses.tree.add(message, topic.endswith(TF_STATIC)):
                            raise RecordingError(sentence)
            for t in wanted:
                with _one_sentence(self.path, f"{t}: "):
                    if (n := n_read[t]) < self.counts[t]:
                        raise RecordingError(f"ends early, after {n} of {self.counts[t]} poses")
            self._poses = poses
        return self._poses

    def _tf_topics(self) -> set[str]:
        """Return the transform topics that are needed: the static ones, all for ground truth."""
        tf = {t for t, kind in self.types.items() if kind in TF_TYPES}
        return {t for t in tf if self._frames is not None or t.endswith(TF_STATIC)}

    def _messages(self, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, stamp and message of the topics, in the order of recording."""
        if not topics:
            return
        with _one_sentence(self.path), self._reader() as reader:
            connections = [c for c in reader.connections if c.topic in topics]
            for connection, received_ns, raw in reader.messages(connections):
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp_ns = 0
                if connection.msgtype not in TF_TYPES:
                    stamp = message.header.stamp
                    stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
                yield connection.topic, stamp_ns or int(received_ns), message

    def _reader(self) -> AnyReader:
        return AnyReader(self._parts, default_typestore=get_typestore(Stores.ROS2_JAZZY))


def _scan(message: Any, stamp_ns: int, law: TimeLaw | None) -> tuple[Scan, TimeLaw | None]:
    """Return the scan of a message, and how its times were read: as the first said, if any."""
    present = {field.name.lower(): field.name for field in reversed(message.fields)}
    intensity = next((present[n] for n in INTENSITIES if n in present), None)
    time = next((present[n] for n in NAMES if n in present), None)
    wanted = tuple(name for name in (intensity, time) if name is not None)
    fields = read_fields(message, ("x", "y", "z", *wanted))
    points = np.stack([fields["x"], fields["y"], fields["z"]], axis=1).astype(np.float64)
    if time is not None and law is None:
        law = recognise(fields[time], stamp_ns)
    scan = Scan(
        stamp_ns=stamp_ns,
        points=points,
        intensity=None if intensity is None else fields[intensity].astype(np.float64),
        time_s=None if law is None or time is None else relative_s(fields[time], law, stamp_ns),
    )
    return scan, law


def _parts(path: Path) -> list[Path]:
    """Return what to open: the path, or the files of a folder that rosbags would not know.

    Such are bags that were split without metadata, and a rosbag2 named like a rosbag1, ``.bag``.
    """
    if path.is_dir() and (path.suffix == ".bag" or not (path / "metadata.yaml").exists()):
        for ending in _ENDINGS:
            if parts := sorted(path.glob(f"*{ending}")):
                return parts
    return [path]


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
