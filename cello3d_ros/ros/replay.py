"""Plays a recording into a running node and collects what it answers, over real DDS."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry.se3 import Array, interpolate
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.ros import messages
from cello3d_ros.ros.diagnostics import ANSWERED, WAITING

_TYPES: dict[str, Any] = {
    "relative_pose": PoseWithCovarianceStamped,
    "pose": PoseWithCovarianceStamped,
    "odometry": Odometry,
    "markers": MarkerArray,
    "diagnostics": DiagnosticArray,
}
_START_S = 600.0  # left to a live node to start: a busy machine compiles for minutes
_MATCHING_S = 1.0  # in which the node, too, learns of the publisher of clouds
_N_ODOMETRY = 4  # odometry messages for each cloud


class ReplayError(Cello3dError):
    """The node was not found or did not answer in time."""


@dataclass(frozen=True)
class Pose:
    """A pose as the node published it.  T: (4, 4); C: (6, 6), ROS convention."""

    T: Array
    C: Array
    received_s: float


@dataclass
class Replay:
    """What was played and what came back, by the stamp of the cloud in nanoseconds.

    status: keys and values of the diagnostics that name the cloud; last_status: the newest.
    raw: topic, ROS type, time of receipt and bytes of every message of the node.
    Times are of time.monotonic().
    """

    published_s: dict[int, float] = field(default_factory=dict)
    T_world: dict[int, Array | None] = field(default_factory=dict)
    T_odom: dict[int, Array] = field(default_factory=dict)
    relative: dict[int, Pose] = field(default_factory=dict)
    poses: dict[int, Pose] = field(default_factory=dict)
    odometry: dict[int, Odometry] = field(default_factory=dict)
    markers: dict[int, MarkerArray] = field(default_factory=dict)
    status: dict[int, dict[str, str]] = field(default_factory=dict)
    last_status: dict[str, str] = field(default_factory=dict)
    raw: list[tuple[str, str, int, bytes]] = field(default_factory=list)

    def latencies_ms(self) -> list[float]:
        """Return the times from publishing each answered cloud to receiving its pose."""
        return [
            1e3 * (pose.received_s - self.published_s[stamp_ns])
            for stamp_ns, pose in self.poses.items()
            if stamp_ns in self.published_s
        ]

    def is_settled(self, stamp_ns: int) -> bool:
        """Return whether the node has said all it will say of a cloud."""
        event = self.status.get(stamp_ns, {}).get("last_event", WAITING)
        if event == ANSWERED:
            heard = (self.relative, self.poses, self.odometry)
            return all(stamp_ns in messages_of for messages_of in heard)
        return event != WAITING


class Player:
    """A ROS node beside the one under test: publishes clouds and odometry, hears the answers."""

    def __init__(
        self,
        domain_id: int,
        target: str = "/covariance_node",
        check: Callable[[], object] = bool,
    ) -> None:
        """Join the graph.  check: called while waiting, to raise when the target has died."""
        self._context = Context()
        self._context.init(args=[], domain_id=domain_id)
        self._node = Node("cello3d_player", context=self._context, use_global_arguments=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._check = check
        self._status_name = f"{target.strip('/')}: "
        self.replay = Replay()
        # the target hears of the publishers in this order: who hears odometry also hears clouds
        self.clouds = self._node.create_publisher(PointCloud2, "/points", 5)
        self.odometry = self._node.create_publisher(Odometry, "/odom", 200)
        self._subscriptions = []
        for name, kind in _TYPES.items():
            topic = "/diagnostics" if name == "diagnostics" else f"{target}/{name}"
            self._subscriptions.append(
                self._node.create_subscription(kind, topic, self._hear(name, topic), 100, raw=True)
            )

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def connect(self, stamp_ns: int, T: Array | None, timeout_s: float) -> None:
        """Wait until the target hears and is heard, by odometry before ``stamp_ns``.

        T: the pose of that odometry; without one only the publishers and subscriptions are
        matched, and a second more.  Raises ReplayError after ``timeout_s``.
        """
        before_ns = stamp_ns - 900_000_000

        def connected() -> bool:
            nonlocal before_ns
            if self.odometry.get_subscription_count() and self.clouds.get_subscription_count():
                if T is None:
                    return all(s.get_publisher_count() for s in self._subscriptions)
                self.publish_odometry(before_ns, T)
                before_ns = min(before_ns + 5_000_000, stamp_ns - 1)
            heard = int(self.replay.last_status.get("odometry_received", 0)) > 0
            return heard and all(s.get_publisher_count() for s in self._subscriptions)

        if not self.spin_until(connected, timeout_s):
            raise ReplayError(f"no covariance_node was found in {timeout_s:g} s")
        if T is None:
            self.spin_for(_MATCHING_S)

    def publish_odometry(self, stamp_ns: int, T: Array) -> None:
        """Publish one pose of ``lidar`` in ``odom``."""
        self.odometry.publish(messages.odometry_to(stamp_ns, "odom", "lidar", T))

    def publish_cloud(self, stamp_ns: int, points: Array) -> None:
        """Publish one cloud in the frame ``lidar``."""
        message = messages.cloud_to(stamp_ns, "lidar", points)
        self.replay.published_s[stamp_ns] = time.monotonic()
        self.clouds.publish(message)

    def spin_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Listen until ``done()``; False after ``timeout_s``."""
        end_s = time.monotonic() + timeout_s
        while not done():
            self._check()
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return False
            self._executor.spin_once(timeout_sec=min(left_s, 0.05))
        return True

    def spin_for(self, seconds: float) -> None:
        """Listen for a while."""
        self.spin_until(lambda: False, seconds)

    def _hear(self, name: str, topic: str) -> Callable[[bytes], None]:
        kind = _TYPES[name]
        ros_type = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"

        def callback(raw: bytes) -> None:
            now_s = time.monotonic()
            self.replay.raw.append((topic, ros_type, time.time_ns(), raw))
            message: Any = deserialize_message(raw, kind)
            if name == "diagnostics":
                self._note_status(message)
                return
            if name == "markers":
                self.replay.markers[messages.stamp_ns_of(message.markers[0])] = message
                return
            if name == "odometry":
                self.replay.odometry[messages.stamp_ns_of(message)] = message
                return
            pose = Pose(
                messages.pose_from(message.pose.pose),
                np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6),
                now_s,
            )
            heard = self.replay.relative if name == "relative_pose" else self.replay.poses
            heard[messages.stamp_ns_of(message)] = pose

        return callback

    def _note_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            if status.name.startswith(self._status_name) and "last_stamp_ns" in values:
                values["level"], values["message"] = str(status.level[0]), status.message
                self.replay.status[int(values["last_stamp_ns"])] = values
                self.replay.last_status = values


def play(
    player: Player,
    recording: Recording,
    rate_hz: float | None = None,
    timeout_s: float = 20.0,
    progress: Callable[[int], object] = bool,
) -> Replay:
    """Play every scan and return what came back.

    Each cloud waits for the answer to the one before, or a failure that diagnostics name, for at
    most ``timeout_s``; with ``rate_hz`` clouds come at that rate whatever the node does, and only
    the last is waited for.  progress: called with the number of scans played.
    Odometry is played where the scans have it.  Raises ReplayError when the node is not found.
    """
    replay, before, next_s = player.replay, None, 0.0
    for n, scan in enumerate(recording):
        if before is None:
            player.connect(scan.stamp_ns, scan.T_odom_sensor, _START_S)
            next_s = time.monotonic()
        replay.T_world[scan.stamp_ns] = scan.T_world_sensor
        if scan.T_odom_sensor is not None:
            replay.T_odom[scan.stamp_ns] = scan.T_odom_sensor
        if rate_hz is not None:
            player.spin_for(next_s - time.monotonic())
            next_s += 1.0 / rate_hz
        for stamp_ns, T in _odometry_up_to(before, scan):
            player.publish_odometry(stamp_ns, T)
        player.publish_cloud(scan.stamp_ns, scan.points)
        if rate_hz is None:
            _wait(player, scan.stamp_ns, timeout_s)
        before = scan
        progress(n + 1)
    if rate_hz is not None and before is not None:
        _wait(player, before.stamp_ns, timeout_s)
    return replay


def _odometry_up_to(before: Scan | None, scan: Scan) -> Iterator[tuple[int, Array]]:
    """Yield stamps and poses after the scan before, up to and at this one."""
    if scan.T_odom_sensor is None:
        return
    if before is not None and before.T_odom_sensor is not None:
        span_ns = scan.stamp_ns - before.stamp_ns
        for k in range(1, _N_ODOMETRY):
            T = interpolate(before.T_odom_sensor, scan.T_odom_sensor, k / _N_ODOMETRY)
            yield before.stamp_ns + span_ns * k // _N_ODOMETRY, T
    yield scan.stamp_ns, scan.T_odom_sensor


def _wait(player: Player, stamp_ns: int, timeout_s: float) -> None:
    player.spin_until(lambda: player.replay.is_settled(stamp_ns), timeout_s)
