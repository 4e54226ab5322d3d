"""covariance_node: clouds and odometry in, poses with their covariance out.

``~/relative_pose`` is one registration: the pose of the reading (the cloud with the message's
stamp) in the frame of the sensor at the reference, the cloud answered before; header.frame_id is
the frame of the cloud.  ``~/pose`` is the chain of them since its last restart, in the frame of
the odometry, where it starts without error at the odometry's pose; its errors accumulate and must
not be fused as if they were independent.  Nothing is published for a cloud without an answer;
``/diagnostics`` says why.
"""

from __future__ import annotations

import contextlib
import math
import re
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import PointCloud2
from threadpoolctl import threadpool_limits

from cello3d_ros.clouds.pointcloud2 import read_points
from cello3d_ros.config import PIPELINE, Config, differences
from cello3d_ros.covariance.model import Model, load_model, shipped_model_path
from cello3d_ros.errors import Cello3dError, CloudError, ConfigError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros import messages, parameters
from cello3d_ros.ros.diagnostics import Statistics
from cello3d_ros.ros.intake import JUMP_NS, Intake, Job, Skip, stamp_order
from cello3d_ros.ros.odometry import OdometryBuffer, OdometryError
from cello3d_ros.ros.tracker import Answer, Tracker, reason_of
from cello3d_ros.ros.warmup import warm_up

NAME = "covariance_node"

_TICK_S = 0.05  # how often it is looked whether a cloud has waited too long
_WARNING_PERIOD_S = 5.0  # warnings of one kind come at most this often
_MAX_WARNINGS = 100  # kinds of warnings remembered


class CovarianceNode(Node):
    """Translates: messages in, one call of the estimator, messages out, errors to diagnostics."""

    def __init__(self) -> None:
        """Load, check and warm up everything, then listen.  Raises Cello3dError."""
        super().__init__(NAME)
        path = Path(parameters.declare_model(self) or shipped_model_path())
        model = load_model(path)
        self.config = self._configured(model)
        config = self.config.node
        self._odometry = OdometryBuffer(config.odometry_buffer_s, config.odometry_gap_s)
        self._odometry_frame = "odom"
        self._T_base_sensor = se3.pose(config.T_base_sensor[:3], config.T_base_sensor[3:])
        self._intake = Intake(self._odometry)
        self._newest_cloud_ns: int | None = None
        self._tracker = Tracker(model, self.config, config)
        self._statistics = Statistics(path.name, config.max_failures)
        self._warned_s: dict[str, float] = {}
        self.get_logger().info("warming up; a first start compiles the kernels")
        warm_up(model, self.config)
        self._connect()
        self.get_logger().info(
            f"ready: model {path.name} of {model.n_examples} examples, listening to "
            f"{self.resolve_topic_name('points')} and {self.resolve_topic_name('odom')}"
        )

    def _configured(self, model: Model) -> Config:
        defaults = Config(**{name: getattr(model.pipeline, name) for name in PIPELINE})
        config = parameters.declare(self, defaults)
        if config.grid != model.pipeline.grid:
            raise ConfigError(f"parameters grid.* must be the model's, {model.pipeline.grid}")
        for name in parameters.unknown(self):
            self.get_logger().warning(f"unknown parameter {name} has no effect")
        for difference in differences(config, model.pipeline):
            self.get_logger().warning(f"not as the model was trained: {difference}")
        return config

    def _connect(self) -> None:
        shallow = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT, depth=2
        )
        deep = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT, depth=200
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._relative = self.create_publisher(PoseWithCovarianceStamped, "~/relative_pose", 10)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # a guard runs after the subscriptions, so that the newest cloud is there when work starts
        self._work_is_there = self.create_guard_condition(self._work)
        self.create_timer(_TICK_S, self._expire, clock=steady)
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-JUMP_NS), on_clock_change=False
        )
        self._jumps = self.get_clock().create_jump_callback(
            backward, post_callback=self._on_clock_jump
        )
        self.create_subscription(Odometry, "odom", self._on_odometry, deep)
        self.create_subscription(PointCloud2, "points", self._on_cloud, shallow)

    def _on_odometry(self, message: Odometry) -> None:
        self._statistics.counts["odometry"] += 1
        stamp_ns = messages.stamp_ns_of(message)
        try:
            self._check_not_in_future(stamp_ns)
            T = messages.pose_from(message.pose.pose)
            if stamp_order(stamp_ns, self._odometry.newest_ns) == "jump":
                self._forget(stamp_ns)
            self._odometry.add(stamp_ns, T)
        except OdometryError as error:
            self._statistics.counts["odometry_rejected"] += 1
            self._warn("odometry", f"odometry message rejected: {error}")
            return
        self._odometry_frame = message.header.frame_id or "odom"
        if len(self._intake):
            self._work_is_there.trigger()

    def _on_cloud(self, message: PointCloud2) -> None:
        self._statistics.counts["received"] += 1
        received_s = time.monotonic()
        stamp_ns = messages.stamp_ns_of(message)
        points = self._admitted(stamp_ns, message)
        if isinstance(points, Skip):
            self._skip(points)
            return
        job = Job(stamp_ns, points, message.header.frame_id, received_s)
        for skip in self._intake.offer(job):
            self._skip(skip)
        self._work_is_there.trigger()

    def _admitted(self, stamp_ns: int, message: PointCloud2) -> Array | Skip:
        """Return the points of a cloud in its turn; a damaged one does not move the clock."""
        try:
            self._check_not_in_future(stamp_ns)
            points = read_points(message)
        except OdometryError as error:
            return Skip(stamp_ns, "future_stamp", str(error))
        except CloudError as error:
            return Skip(stamp_ns, "malformed", str(error))
        except Exception as error:  # whatever bytes may do, the node outlives them
            return Skip(stamp_ns, "malformed", f"{type(error).__name__}: {error}")
        order = stamp_order(stamp_ns, self._newest_cloud_ns)
        if order == "jump":
            self._forget(stamp_ns)
        elif order != "later":
            sentence = f"{order.replace('_', ' ')}: not later than the cloud before"
            return Skip(stamp_ns, order, sentence)
        self._newest_cloud_ns = stamp_ns
        return points

    def _work(self) -> None:
        job, skips = self._intake.take()
        for skip in skips:
            self._skip(skip)
        if job is None or job.T_odom_base is None:
            return
        try:
            answer = self._tracker.step(
                job.stamp_ns, job.points, job.T_odom_base @ self._T_base_sensor
            )
            if answer is None:
                self._statistics.reference(job.stamp_ns)
            else:
                self._publish(job, answer)
        except Cello3dError as error:
            self._skip(Skip(job.stamp_ns, reason_of(error), str(error)))
        except Exception as error:  # a node that dies of one cloud is worse than a lost answer
            if not self.context.ok():
                raise
            self.get_logger().error(traceback.format_exc())
            self._skip(Skip(job.stamp_ns, "internal", f"{type(error).__name__}: {error}"))
        self._publish_diagnostics()
        if len(self._intake):
            self._work_is_there.trigger()

    def _publish(self, job: Job, answer: Answer) -> None:
        T_ref_read = answer.estimate.registration.T_ref_read
        relative = self._with_covariance(job, job.frame_id, T_ref_read, answer.estimate.covariance)
        pose = self._with_covariance(job, self._odometry_frame, answer.T_odom_read, answer.Y_chain)
        self._relative.publish(relative)
        self._pose.publish(pose)
        now_ns = self.get_clock().now().nanoseconds
        C = relative.pose.covariance.reshape(6, 6)
        self._statistics.answer(answer, C, job.received_s, now_ns)

    def _with_covariance(
        self, job: Job, frame_id: str, T: Array, Y: Array
    ) -> PoseWithCovarianceStamped:
        config = self.config.node
        C = messages.ros_covariance(
            Y, T[:3, :3], config.floor_sigma_m, config.floor_sigma_rad, config.ceiling
        )
        return messages.pose_with_covariance(job.stamp_ns, frame_id, T, C)

    def _expire(self) -> None:
        skips = self._intake.expire(_TICK_S, self.config.node.odometry_timeout_s)
        for skip in skips:
            self._skip(skip)

    def _skip(self, skip: Skip) -> None:
        self._statistics.fail(skip.stamp_ns, skip.reason, skip.sentence)
        if skip.reason != "superseded":
            self._warn(skip.reason, f"cloud skipped: {skip.sentence}")
        self._publish_diagnostics()

    def _warn(self, kind: str, sentence: str) -> None:
        """Log, but sentences that differ only in numbers at most once a while."""
        key, now_s = kind + re.sub(r"[0-9.]+", "", sentence), time.monotonic()
        if now_s - self._warned_s.get(key, -math.inf) >= _WARNING_PERIOD_S:
            if len(self._warned_s) >= _MAX_WARNINGS:
                self._warned_s.clear()
            self._warned_s[key] = now_s
            self.get_logger().warning(sentence)

    def _publish_diagnostics(self) -> None:
        name = f"{self.get_name()}: registration"
        now_ns = self.get_clock().now().nanoseconds
        self._diagnostics.publish(self._statistics.message(name, now_ns, self._tracker.n_restarts))

    def _check_not_in_future(self, stamp_ns: int) -> None:
        """Raise OdometryError for a stamp after now; a simulated clock at 0 has not started."""
        now_ns = self.get_clock().now().nanoseconds
        ahead_s = 1e-9 * (stamp_ns - now_ns)
        if now_ns > 0 and ahead_s > self.config.node.future_tolerance_s:
            raise OdometryError(f"the stamp is {ahead_s:.3f} s in the future")

    def _on_clock_jump(self, jump: TimeJump) -> None:
        self._forget(self.get_clock().now().nanoseconds)

    def _forget(self, stamp_ns: int) -> None:
        """Time has jumped back to ``stamp_ns``: what is remembered lies in the future."""
        self._statistics.counts["clock_jumps"] += 1
        self._warn("clock_jump", "time jumped back: everything remembered is forgotten")
        for skip in self._intake.clear():
            self._skip(skip)
        newest_ns = self._odometry.newest_ns
        if newest_ns is not None and newest_ns - stamp_ns > JUMP_NS:
            self._odometry.clear()
        self._newest_cloud_ns = None
        self._tracker.reset()

    def _check_parameters(self, given: list[Parameter]) -> SetParametersResult:
        try:
            parameters.changed(self.config, given)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, given: list[Parameter]) -> None:
        self.config = parameters.changed(self.config, given)
        self._tracker.pipeline = self.config
        self._tracker.config = self.config.node
        self._odometry.gap_s = self.config.node.odometry_gap_s
        for difference in differences(self.config, self._tracker.model.pipeline):
            self.get_logger().warning(f"not as the model was trained: {difference}")


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop; the return value is the exit status."""
    is_starting = True

    def stop(*_: Any) -> None:  # once the node spins, rclpy's own handler ends it
        nonlocal is_starting
        if is_starting:
            is_starting = False
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        _initialise(args)
        with threadpool_limits(1, user_api="blas"):  # its waiting threads take the kernels' cores
            node = CovarianceNode()
            is_starting = False
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except Cello3dError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        return 1
    except RuntimeError:  # what rclpy raises when a signal has ended its context in mid-callback
        if rclpy.ok():
            raise
        return 0
    finally:
        is_starting = False
        with contextlib.suppress(RuntimeError):  # rclpy's own handler may be at it, too
            try_shutdown()
        for number in (signal.SIGINT, signal.SIGTERM):  # impatience does not change the status
            signal.signal(number, signal.SIG_IGN)
    return 0


def _initialise(args: Sequence[str] | None) -> None:
    try:
        rclpy.init(args=None if args is None else list(args))
    except (RuntimeError, ValueError) as error:
        text = " ".join(str(error).split())
        raise ConfigError(f"cannot start with these ROS arguments: {text}") from None


if __name__ == "__main__":
    sys.exit(main())
