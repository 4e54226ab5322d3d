"""From messages to answers, one cloud at a time: newest first, whatever is heard.

Knows messages but no graph: whoever owns a worker hands it what was heard and the time of now,
publishes what it answers and is told of every cloud that it drops.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from cello3d_ros.clouds.pointcloud2 import read_points
from cello3d_ros.config import Config
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import CloudError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros import messages
from cello3d_ros.ros.intake import JUMP_NS, Intake, Job, Skip, stamp_order
from cello3d_ros.ros.odometry import OdometryBuffer, OdometryError
from cello3d_ros.ros.tracker import Answer, Tracker


class Worker:
    """Hears odometry and clouds, chooses the cloud to work on and registers it.

    ``skip`` is called for each cloud that will have no answer, ``warn`` with a kind and a sentence
    for what else is wrong.  ``odometry_frame`` is the frame of the odometry heard last.
    """

    def __init__(
        self,
        model: Model,
        config: Config,
        skip: Callable[[Skip], None],
        warn: Callable[[str, str], None],
    ) -> None:
        node = config.node
        self.config = config
        self.odometry_frame = "odom"
        self.n_clock_jumps = 0
        self._skip, self._warn = skip, warn
        self._odometry = OdometryBuffer(node.odometry_buffer_s, node.odometry_gap_s)
        self._T_base_sensor = se3.pose(node.T_base_sensor[:3], node.T_base_sensor[3:])
        self._intake = Intake(self._odometry)
        self._newest_cloud_ns: int | None = None
        self._tracker = Tracker(model, config, node)

    @property
    def n_restarts(self) -> int:
        """How often a chain of poses has been given up."""
        return self._tracker.n_restarts

    @property
    def has_work(self) -> bool:
        """Whether a cloud waits, with or without its odometry."""
        return len(self._intake) > 0

    def set_config(self, config: Config) -> None:
        """Take the settings that may change while clouds come."""
        self.config = config
        self._tracker.pipeline, self._tracker.config = config, config.node
        self._odometry.gap_s = config.node.odometry_gap_s

    def hear_odometry(self, message: Odometry, now_ns: int) -> bool:
        """Remember a pose of the base; False when it was rejected."""
        stamp_ns = messages.stamp_ns_of(message)
        try:
            self._check_not_in_future(stamp_ns, now_ns)
            T = messages.pose_from(message.pose.pose)
            if stamp_order(stamp_ns, self._odometry.newest_ns) == "jump":
                self.jump_to(stamp_ns)
            self._odometry.add(stamp_ns, T)
        except OdometryError as error:
            self._warn("odometry", f"odometry message rejected: {error}")
            return False
        self.odometry_frame = message.header.frame_id or "odom"
        return True

    def hear_cloud(self, message: PointCloud2, now_ns: int) -> None:
        """Let a cloud wait for its odometry, or drop it."""
        received_s = time.monotonic()
        stamp_ns = messages.stamp_ns_of(message)
        points = self._admitted(stamp_ns, message, now_ns)
        if isinstance(points, Skip):
            self._skip(points)
            return
        for skip in self._intake.offer(Job(stamp_ns, points, message.header.frame_id, received_s)):
            self._skip(skip)

    def take(self) -> Job | None:
        """Return the newest cloud whose odometry is there, if there is one."""
        job, skips = self._intake.take()
        for skip in skips:
            self._skip(skip)
        return job

    def answer(self, job: Job) -> Answer | None:
        """Register a cloud that was taken; None: it is the reference of the next one.

        Raises Cello3dError when there is no answer.
        """
        assert job.T_odom_base is not None
        T_odom_sensor = job.T_odom_base @ self._T_base_sensor
        return self._tracker.step(job.stamp_ns, job.points, T_odom_sensor)

    def expire(self, elapsed_s: float) -> None:
        """Drop the clouds that have waited too long for their odometry."""
        for skip in self._intake.expire(elapsed_s, self.config.node.odometry_timeout_s):
            self._skip(skip)

    def jump_to(self, stamp_ns: int) -> None:
        """Time has jumped back to ``stamp_ns``: forget what now lies in the future."""
        self.n_clock_jumps += 1
        self._warn("clock_jump", "time jumped back: everything remembered is forgotten")
        newest_ns = self._odometry.newest_ns
        if newest_ns is not None and newest_ns - stamp_ns > JUMP_NS:
            self._odometry.clear()
        self._forget("clock_jump", "time jumped back while it waited")

    def stop(self) -> None:
        """Nothing more will be heard for a while: forget everything."""
        self._odometry.clear()
        self._forget("deactivated", "the node was deactivated while it waited")

    def reset(self) -> None:
        """Forget the reference and the chain; the next cloud starts anew."""
        self._tracker.reset()

    def _forget(self, reason: str, sentence: str) -> None:
        for skip in self._intake.clear(reason, sentence):
            self._skip(skip)
        self._newest_cloud_ns = None
        self._tracker.reset()

    def _admitted(self, stamp_ns: int, message: PointCloud2, now_ns: int) -> Array | Skip:
        """Return the points of a cloud in its turn; a damaged one does not move the clock."""
        try:
            self._check_not_in_future(stamp_ns, now_ns)
            points = read_points(message)
        except OdometryError as error:
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
        return points

    def _check_not_in_future(self, stamp_ns: int, now_ns: int) -> None:
        """Raise OdometryError for a stamp after now; a simulated clock at 0 has not started."""
        ahead_s = 1e-9 * (stamp_ns - now_ns)
        if now_ns > 0 and ahead_s > self.config.node.future_tolerance_s:
            raise OdometryError(f"the stamp is {ahead_s:.3f} s in the future")
