"""From messages to answers, one cloud at a time, whatever is heard.

Knows messages but no graph: its owner passes in messages and the time, publishes the answers and
hears of every cloud that is dropped.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from cello3d_ros.clouds.livox import TIME, read_livox
from cello3d_ros.clouds.point_times import Clock, PointTimesError, TimesOfClouds
from cello3d_ros.clouds.pointcloud2 import read_fields
from cello3d_ros.config import Config
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import CloudError
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.geometry.transforms import TransformTree
from cello3d_ros.ros import messages
from cello3d_ros.tracking.guess import Locator
from cello3d_ros.tracking.intake import JUMP_NS, Intake, Job, Skip, stamp_order
from cello3d_ros.tracking.odometry import PoseSource
from cello3d_ros.tracking.tracker import Answer, Tracker

MAX_CLOUD_BYTES = 64 * 1024**2  # of a message on points: work takes up to 30 times its size
_LIVOX_BYTES = 20  # of a point
MAX_MAP_BYTES = 1024**3  # of one on reference_points, which is cropped before it is worked on


class Worker:
    """Hears poses and clouds, chooses the cloud to work on and registers it.

    ``skip`` is called for each cloud that will have no answer, ``warn`` with a kind and a sentence
    for what else is wrong.
    """

    def __init__(
        self,
        model: Model,
        config: Config,
        skip: Callable[[Skip], None],
        warn: Callable[[str, str], None],
        extrinsic_is_given: bool = False,
    ) -> None:
        """extrinsic_is_given: as in Locator."""
        node = config.node
        self.config = config
        self.n_clock_jumps = 0
        self._skip, self._warn = skip, warn
        length_s, gap_s = node.odometry_buffer_s, node.odometry_gap_s
        what = "external pose" if node.registration == "external" else "odometry"
        self._poses = PoseTrack(gap_s, length_s, 100_000, what)
        self._source = PoseSource(self._poses)
        self._transforms = TransformTree(gap_s, length_s) if node.use_tf else None
        self._locator = Locator(node, self._source, self._transforms, extrinsic_is_given)
        self._intake = Intake(self._locator.place, node.odometry_timeout_s, what)
        self._newest_cloud_ns: int | None = None
        self._times = TimesOfClouds()
        self._tracker = Tracker(model, config, node)

    @property
    def n_restarts(self) -> int:
        """How often a chain of poses has been given up."""
        return self._tracker.n_restarts

    @property
    def last_restart(self) -> str:
        """Why the last one was given up."""
        return self._tracker.last_restart

    @property
    def warnings(self) -> list[str]:
        """What seems wrong with the clouds or the odometry altogether, in sentences."""
        found = self._locator.warning, self._tracker.warning, self._source.rejection
        return [sentence for sentence in found if sentence]

    @property
    def has_work(self) -> bool:
        """Whether a cloud waits, with or without its odometry."""
        return len(self._intake) > 0

    @property
    def is_overloaded(self) -> bool:
        """Whether clouds come faster than they can be worked on: then the newest is next."""
        return self._intake.is_overloaded

    @property
    def newest_is_ready(self) -> bool:
        """Whether the cloud that came last need not wait for its odometry."""
        return self._intake.newest_is_ready()

    def set_config(self, config: Config) -> None:
        """Take the settings that may change while clouds come."""
        self.config = config
        self._tracker.pipeline, self._tracker.config = config, config.node
        self._locator.config = config.node
        self._intake.timeout_s = config.node.odometry_timeout_s
        self._poses.gap_s = config.node.odometry_gap_s

    def hear_pose(self, message: Odometry | PoseWithCovarianceStamped, now_ns: int) -> bool:
        """Remember a pose of odometry or of the external registration; False if rejected."""
        stamp_ns, what = messages.stamp_ns_of(message), self._poses.what
        try:
            self._check_not_in_future(stamp_ns, now_ns)
            T = messages.pose_from(message.pose.pose)
            if stamp_order(stamp_ns, self._poses.newest_ns) == "jump":
                self.jump_to(stamp_ns)
            frames = message.header.frame_id, getattr(message, "child_frame_id", "")
            node = self.config.node
            fastest = node.max_odometry_speed_m_s
            Y = None if node.registration == "external" else messages.covariance_from(message)
            if broken := self._source.hear(stamp_ns, T, *frames, fastest, Y):
                self._warn("broken_chain", f"{broken}: the chain starts again")
        except PoseError as error:
            self._source.reject(str(error))
            self._warn("odometry", f"{what} message rejected: {error}")
            return False
        return True

    def hear_transforms(self, message: Any, static: bool) -> None:
        """Remember the transforms of a tf2_msgs/TFMessage."""
        if self._transforms is not None:
            for sentence in self._transforms.add(message, static):
                self._warn("transform", sentence)

    def hear_reference(self, message: PointCloud2) -> None:
        """Register to this cloud from now on."""
        stamp_ns, frame_id = messages.stamp_ns_of(message), message.header.frame_id
        try:
            points = _points(message, MAX_MAP_BYTES)
            if not frame_id or not len(points):
                raise CloudError("it has no frame_id" if not frame_id else "it has no points")
        except Exception as error:  # whatever bytes may do, the node outlives them
            self._warn("reference", f"reference cloud rejected: {error}")
            return
        self._locator.map_frame = frame_id
        self._tracker.take_map(stamp_ns, points, frame_id)

    def hear_cloud(self, message: Any, now_ns: int, n_unheard: int = 0) -> None:
        """Let a cloud wait for its odometry, or drop it.

        n_unheard: clouds that came before it and were overwritten before they were heard.
        """
        received_s = time.monotonic()
        offset_ns = round(1e9 * self.config.node.cloud_time_offset_s)
        stamp_ns = messages.stamp_ns_of(message) + offset_ns
        job = self._admitted(stamp_ns, message, now_ns, received_s)
        if isinstance(job, Skip):
            self._skip(job)
            return
        for skip in self._intake.offer(job, n_unheard):
            self._skip(skip)

    def take(self) -> Job | None:
        """Return the next cloud whose odometry is there, if there is one."""
        job, skips = self._intake.take()
        for skip in skips:
            self._skip(skip)
        return job

    def answer(self, job: Job) -> Answer | None:
        """Register a cloud that was taken; None: it is the reference of the next one.

        Raises Cello3dError when there is no answer.
        """
        assert job.place is not None
        self._began_s = time.monotonic()
        answer = self._tracker.step(job.stamp_ns, job.points, job.place, job.time_s)
        if answer is not None and job.time_s is None:
            answer = replace(answer, deskewed=f"no: {job.no_times}")
        return answer

    def finish(self) -> None:
        """Do what the next cloud would have to wait for, once the last one is answered."""
        try:
            self._tracker.finish()
        finally:
            self._intake.note_work(time.monotonic() - self._began_s)

    def expire(self, elapsed_s: float) -> None:
        """Drop the clouds that have waited too long for their odometry."""
        for skip in self._intake.expire(elapsed_s):
            self._skip(skip)

    def jump_to(self, stamp_ns: int) -> None:
        """Time has jumped back to ``stamp_ns``: forget what now lies in the future."""
        self.n_clock_jumps += 1
        self._warn("clock_jump", "time jumped back: everything remembered is forgotten")
        newest_ns = self._poses.newest_ns
        if newest_ns is not None and newest_ns - stamp_ns > JUMP_NS:
            self._source.clear()
        if self._transforms is not None:
            self._transforms.clear()
        self._forget("clock_jump", "time jumped back")

    def stop(self) -> None:
        """Nothing more will be heard for a while: forget everything."""
        self._source.clear()
        if self._transforms is not None:
            self._transforms.clear()
        self._forget("deactivated", "the node was deactivated")

    def reset(self) -> None:
        """Forget the reference and the chain; the next cloud starts anew."""
        self._tracker.reset("on request")

    def _forget(self, reason: str, event: str) -> None:
        for skip in self._intake.clear(reason, f"{event} while it waited"):
            self._skip(skip)
        self._newest_cloud_ns = None
        self._times = TimesOfClouds()
        self._tracker.reset(event)

    def _admitted(self, stamp_ns: int, message: Any, now_ns: int, received_s: float) -> Job | Skip:
        """Return a cloud in its turn; a damaged one does not move the clock."""
        try:
            self._check_not_in_future(stamp_ns, now_ns)
            points, times = _columns(message, MAX_CLOUD_BYTES, self.config.node.deskew)
        except PoseError as error:
            return Skip(stamp_ns, "future_stamp", str(error))
        except CloudError as error:
            return Skip(stamp_ns, "malformed", str(error))
        except Exception as error:  # whatever bytes may do, the node outlives them
            return Skip(stamp_ns, "malformed", f"{type(error).__name__}: {error}")
        order = stamp_order(stamp_ns, self._newest_cloud_ns)
        if order == "jump":
            self.jump_to(stamp_ns)
        elif order != "later":
            sentence = f"{order.replace('_', ' ')}: not later than the cloud before"
            return Skip(stamp_ns, order, sentence)
        self._newest_cloud_ns = stamp_ns
        job = Job(stamp_ns, points, message.header.frame_id, received_s)
        return self._timed(job, times, messages.stamp_ns_of(message))

    def _timed(self, job: Job, times: NDArray[Any] | str, clock_ns: int) -> Job:
        """Return a cloud with the times of its points, or why it has none.

        times: as the message has them, or why not; clock_ns: its own stamp.  Points whose time is
        damaged are left out.
        """
        if isinstance(times, str):
            return replace(job, no_times=times)
        try:
            time_s = self._times.read(times, clock_ns)
        except PointTimesError as error:
            self._warn("times", f"the motion within clouds is not undone: {error}")
            return replace(job, no_times=str(error))
        known = np.isfinite(time_s)
        if not known.any():
            return replace(job, no_times="no point has a finite time")
        if known.all():
            return replace(job, time_s=time_s)
        return replace(job, points=job.points[known], time_s=time_s[known])

    def _check_not_in_future(self, stamp_ns: int, now_ns: int) -> None:
        """Raise PoseError for a stamp after now; a simulated clock at 0 has not started."""
        ahead_s = 1e-9 * (stamp_ns - now_ns)
        if now_ns > 0 and ahead_s > self.config.node.future_tolerance_s:
            raise PoseError(f"the stamp is {ahead_s:.3f} s in the future")


def _points(message: Any, max_bytes: int) -> Array:
    """Return the points (N, 3) of a cloud of bounded size.  Raises CloudError."""
    return _columns(message, max_bytes, wants_times=False)[0]


def _columns(message: Any, max_bytes: int, wants_times: bool) -> tuple[Array, NDArray[Any] | str]:
    """Return points and times of a PointCloud2, or Livox's CustomMsg, of bounded size.

    The times are as the message has them, (N,), or why there are none.  Raises CloudError.
    """
    is_livox = not isinstance(message, PointCloud2)
    n_bytes = _LIVOX_BYTES * len(message.points) if is_livox else len(message.data)
    if n_bytes > max_bytes:
        raise CloudError(f"the cloud holds {n_bytes} bytes, more than {max_bytes}")
    time = TIME if is_livox else Clock().column(field.name for field in message.fields)
    if not wants_times:
        time, why = None, "node.deskew is false"
    else:
        why = "the points carry no times"
    if is_livox:
        found = read_livox(message)
    else:
        try:
            found = read_fields(message, ("x", "y", "z", *([time] if time else ())))
        except CloudError as error:
            found, time, why = read_fields(message, ("x", "y", "z")), None, str(error)
    points = np.stack([found[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return points, why if time is None else found[time]
