"""Recordings in ROS bags: rosbag1 (.bag), rosbag2 (a folder, .mcap or .db3)."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds import livox
from cello3d_ros.clouds.point_times import (
    INTENSITIES,
    N_FIRST,
    Clock,
    PointTimesError,
    TimeLaw,
    law_of,
    relative_s,
)
from cello3d_ros.clouds.pointcloud2 import read_fields
from cello3d_ros.errors import CloudError, RecordingError
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack, checked_pose
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.geometry.transforms import NotConnectedError, TransformTree
from cello3d_ros.recordings.bag_reader import (
    ENDINGS,
    check_sqlite,
    one_sentence,
    open_bag,
    parts_of,
    reason_in_words,
)
from cello3d_ros.recordings.recording import LenientRecording, ReadOptions, Scan, Skips
from cello3d_ros.recordings.topics import POSE_TYPES, TF_STATIC, TF_TYPES, choose


class _Message(NamedTuple):
    """A message as read.  stamp_ns: its own stamp, else the time at which it was recorded."""

    topic: str
    kind: str
    stamp_ns: int
    content: Any


class _Poses:
    """What a bag says of poses: tracks by topic, the frames they are of, and transforms."""

    def __init__(self, skips: Skips) -> None:
        self.skips = skips
        self.tracks: dict[str, PoseTrack] = {}
        self.child_frames: dict[str, str] = {}
        self.tree = TransformTree()


class BagRecording(LenientRecording):
    """The clouds of one topic, with odometry and ground truth interpolated at their stamps.

    A topic that is not named is found by its type: the only cloud; the only Odometry, or
    ``/odom`` of several; for ground truth ``/ground_truth``, or the only PoseStamped or
    TransformStamped.  The empty name says that there is none.  ``ground_truth_frames`` takes the
    ground truth from TF instead: the pose of the second frame in the first.

    Poses of another frame than the clouds' are moved to the sensor by ``T_base_sensor``, else by
    the transforms that are static or never change; poses that name no frame are the sensor's.
    A message without a stamp (0) has the time at which it was recorded.

    Messages that cannot be read are left out and counted.  Raises RecordingError, in one sentence
    with the path, for whatever else is wrong with the bag.
    """

    def __init__(self, path: Path | str, options: ReadOptions | None = None) -> None:
        """Read what the bag says of its topics."""
        self.path = Path(path)
        options = options or ReadOptions()
        super().__init__(self.path, options)
        self._frames, self._T_base_sensor = options.ground_truth_frames, options.T_base_sensor
        with one_sentence(self.path):
            self._parts = parts_of(self.path)
            check_sqlite(self.path)
        with one_sentence(self.path), open_bag(self._parts) as reader:
            self.types = {c.topic: c.msgtype for c in reader.connections}
            self.counts = dict.fromkeys(self.types, 0)
            for c in reader.connections:
                self.counts[c.topic] += c.msgcount
            named = "" if self._frames is not None else options.ground_truth
            self.topics = choose(self.types, options.points, options.odometry, named)
            if self._frames is not None and not self._tf_topics():
                raise RecordingError("has no TFMessage topic to take ground truth from")

    @property
    def name(self) -> str:
        """Name of the file or folder, without its ending."""
        return self.path.stem if self.path.suffix in ENDINGS else self.path.resolve().name

    @property
    def n_declared(self) -> int:
        """How many clouds the bag says it has."""
        return self.counts[self.topics.points]

    @property
    def n_projected(self) -> int:
        """0: quaternions are normalised, which is no projection."""
        return 0

    @property
    def has_odometry(self) -> bool:
        """Whether there is a topic of odometry."""
        return self.topics.odometry is not None

    @property
    def skipped(self) -> dict[str, int]:
        """How many clouds and poses were left out, by reason, once the scans have been read."""
        poses = self.__dict__.get("_poses")
        return dict(self._cloud_skips.counts + (poses.skips.counts if poses else Counter()))

    def __iter__(self) -> Iterator[Scan]:
        for scan, frame in self._kept():
            with one_sentence(self.path):
                truth = self._truth(scan.stamp_ns, frame)
                odometry = self._pose(self.topics.odometry, scan.stamp_ns, frame)
            yield replace(scan, T_world_sensor=truth, T_odom_sensor=odometry)

    def odometry(self) -> Iterator[tuple[int, Array]]:
        """Yield every odometry message as its stamp and T_odom_base (4, 4), in order of time."""
        if self.topics.odometry is not None:
            yield from self._poses.tracks[self.topics.odometry]

    def track(self) -> PoseTrack | None:
        """Return the sensor's poses at all odometry messages, else all of ground truth's."""
        topic = self.topics.odometry or self.topics.ground_truth
        if topic is None:
            return None
        track = self._poses.tracks[topic]
        T = np.array([T for _, T in track]).reshape(-1, 4, 4)
        return PoseTrack.of_poses(track.stamps_ns, T @ self.extrinsic(topic))

    def extrinsic(self, topic: str) -> Array:
        """Return the pose (4, 4) of the clouds' frame in the frame whose poses a topic tells."""
        frames = (m.content.header.frame_id for m in self._messages({self.topics.points}))
        with one_sentence(self.path):
            return self._extrinsic(topic, next(frames, ""))

    def _law(self) -> TimeLaw | None:
        first = []
        for message in islice(self._messages({self.topics.points}), N_FIRST):
            if message.kind in livox.TYPES:
                return TimeLaw(1)
            try:
                values = _columns(message, self._clock).get("time")
            except PointTimesError:
                raise
            except CloudError:
                continue
            first.append((values, message.stamp_ns))
        return law_of(first, self._clock.unit)

    def _clouds(self, skips: Skips) -> Iterator[tuple[Scan, str]]:
        """Yield each cloud as a scan without poses, and its frame."""
        topic, counts = self.topics.points, Counter[str]()
        law, _ = self._times
        for n, message in enumerate(in_order(self._messages({topic}, skips, counts), skips)):
            try:
                scan = _scan(message, law, self._clock)
            except CloudError as error:
                skips.add("malformed", f"cloud {n} of {topic}: {error}")
                continue
            yield scan, message.content.header.frame_id
        if counts[topic] < self.n_declared:
            raise RecordingError(
                f"{self.path}: ends early, after {counts[topic]} of {self.n_declared} clouds"
            )

    def _truth(self, stamp_ns: int, frame: str) -> Array | None:
        if self._frames is None:
            return self._pose(self.topics.ground_truth, stamp_ns, frame)
        try:
            T = self._poses.tree.at(*self._frames, stamp_ns)
        except NotConnectedError:
            raise
        except PoseError:
            return None
        return T @ self._moved(self._frames[1], frame, "TF")

    def _pose(self, topic: str | None, stamp_ns: int, frame: str) -> Array | None:
        if topic is None:
            return None
        T = self._poses.tracks[topic].at(stamp_ns)
        return None if T is None else T @ self._extrinsic(topic, frame)

    def _extrinsic(self, topic: str, frame: str) -> Array:
        return self._moved(self._poses.child_frames.get(topic, frame), frame, topic)

    def _moved(self, base: str, frame: str, topic: str) -> Array:
        """Return T_base_frame.  Raises RecordingError where nobody says it."""
        if self._T_base_sensor is not None:
            return self._T_base_sensor
        if base.strip("/") == frame.strip("/"):
            return np.eye(4)
        T = self._poses.tree.constant(base, frame)
        if T is None:
            raise RecordingError(
                f"the poses on {topic} are of {base!r}, the clouds of {frame!r}, and no constant "
                "transform connects them: say where the sensor is with --extrinsic X Y Z QX QY QZ "
                "QW (0 0 0 0 0 0 1 where it is the same)"
            )
        return T

    @cached_property
    def _poses(self) -> _Poses:
        """All poses of the bag, read once, in one pass."""
        poses, counts = _Poses(Skips(self.path, self._strict)), Counter[str]()
        wanted = {t for t in self.topics[1:] if t is not None}
        poses.tracks = {t: PoseTrack() for t in wanted}
        for message in self._messages(wanted | self._tf_topics(), poses.skips, counts):
            with one_sentence(self.path, f"{message.topic}: "):
                self._remember(message, poses)
        for t in wanted:
            if (n := counts[t]) < self.counts[t]:
                raise RecordingError(
                    f"{self.path}: {t}: ends early, after {n} of {self.counts[t]} poses"
                )
            if n and not len(poses.tracks[t]):
                raise RecordingError(
                    f"{self.path}: {t}: none of its {n} poses can be used: {poses.skips.first}"
                )
        return poses

    def _remember(self, message: _Message, poses: _Poses) -> None:
        topic, content = message.topic, message.content
        if topic not in poses.tracks:
            for sentence in poses.tree.add(content, topic.endswith(TF_STATIC)):
                poses.skips.add("unusable_transform", sentence)
            return
        try:
            T = checked_pose(*POSE_TYPES[message.kind](content))
            poses.tracks[topic].add(message.stamp_ns, T)
        except PoseError as error:
            poses.skips.add("unusable_pose", f"{topic}: {error}")
            return
        if child := getattr(content, "child_frame_id", ""):
            poses.child_frames.setdefault(topic, child)

    def _tf_topics(self) -> set[str]:
        return {t for t, kind in self.types.items() if kind in TF_TYPES}

    def _messages(
        self, topics: set[str], skips: Skips | None = None, counts: Counter[str] | None = None
    ) -> Iterator[_Message]:
        """Yield the messages of the topics, in the order of recording.

        skips: of those that cannot be read.  counts: of all of each topic.
        """
        if not topics:
            return
        with one_sentence(self.path), open_bag(self._parts) as reader:
            connections = [c for c in reader.connections if c.topic in topics]
            for connection, received_ns, raw in reader.messages(connections):
                topic, kind = connection.topic, connection.msgtype
                if counts is not None:
                    counts[topic] += 1
                try:
                    content: Any = reader.deserialize(raw, kind)
                except Exception as error:  # rosbags lets through what its parsers raise
                    if skips is not None:
                        skips.add("malformed", f"{topic}: a message {reason_in_words(error)}")
                    continue
                stamp_ns = 0 if kind in TF_TYPES else _stamp_ns(content)
                yield _Message(topic, kind, stamp_ns or int(received_ns), content)


def in_order(messages: Iterator[_Message], skips: Skips) -> Iterator[_Message]:
    """Yield the messages whose stamps increase; count the others.

    A stamp beyond those of the next two, which both follow what came before, is wrong itself.
    """
    before_ns: int | None = None
    waiting: deque[_Message] = deque()
    for message in messages:
        waiting.append(message)
        if len(waiting) == 3:
            kept = _next(waiting, before_ns, skips)
            if kept is not None:
                before_ns = kept.stamp_ns
                yield kept
    while waiting:
        if (kept := _next(waiting, before_ns, skips)) is not None:
            before_ns = kept.stamp_ns
            yield kept


def _next(waiting: deque[_Message], before_ns: int | None, skips: Skips) -> _Message | None:
    """Take the first of up to three messages; return it if it is in order."""
    message = waiting.popleft()
    now_ns = message.stamp_ns
    where = f"the stamp {now_ns} of a cloud on {message.topic}"
    if before_ns is not None and now_ns <= before_ns:
        reason = "duplicate_stamp" if now_ns == before_ns else "out_of_order"
        skips.add(reason, f"{where} does not follow {before_ns}")
        return None
    later = [other.stamp_ns for other in waiting]
    floor_ns = -1 if before_ns is None else before_ns
    if len(later) == 2 and all(floor_ns < other < now_ns for other in later):
        skips.add("out_of_order", f"{where} is later than the next two")
        return None
    return message


def _stamp_ns(content: Any) -> int:
    stamp = content.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _columns(message: _Message, clock: Clock) -> dict[str, NDArray[Any]]:
    """Return x, y, z and, where known, intensity and time, each (N,), of a cloud message."""
    if message.kind in livox.TYPES:
        found = livox.read_livox(message.content)
        return {
            **{axis: found[axis] for axis in "xyz"},
            "intensity": found["reflectivity"],
            "time": found[livox.TIME],
        }
    names = [field.name for field in message.content.fields]
    present = {name.lower(): name for name in reversed(names)}
    wanted = {
        "intensity": next((present[n] for n in INTENSITIES if n in present), None),
        "time": clock.column(names),
    }
    used = {role: name for role, name in wanted.items() if name is not None}
    fields = read_fields(message.content, ("x", "y", "z", *used.values()))
    return {axis: fields[axis] for axis in "xyz"} | {r: fields[n] for r, n in used.items()}


def _scan(message: _Message, law: TimeLaw | None, clock: Clock) -> Scan:
    """Return the scan of a cloud message, without poses."""
    found = _columns(message, clock)
    intensity, time = found.get("intensity"), found.get("time")
    time_s = None
    if time is not None and law is not None:
        time_s = relative_s(time, law, message.stamp_ns)
    return Scan(
        stamp_ns=message.stamp_ns + clock.offset_ns,
        points=np.stack([found[axis] for axis in "xyz"], axis=1).astype(np.float64),
        intensity=None if intensity is None else intensity.astype(np.float64),
        time_s=time_s,
    )
