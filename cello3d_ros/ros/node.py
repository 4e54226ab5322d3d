"""covariance_node: clouds and odometry in, poses with their covariance out.

``~/relative_pose`` is one registration: the pose of the reading (the cloud with the message's
stamp) in the frame of the sensor at the reference, by default the cloud answered before;
header.frame_id is the frame of the cloud.  ``~/pose`` is the chain of them since its last restart,
in the frame of the odometry, where it starts without error at the odometry's pose; its errors
accumulate and must not be fused as if they were independent.  ``~/odometry`` is that chain with
the velocity of the last registration.  Nothing is published for a cloud without an answer;
``/diagnostics`` says why.

This module is the node's life and its wiring: configure loads and warms up, activate listens.
What is heard goes to the worker (worker.py), its answers to the outputs (outputs.py).
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from cello3d_ros.config import Config, named_pipeline, pipeline_warning, sections_of
from cello3d_ros.covariance.model import Model, find_model, load_model
from cello3d_ros.errors import Cello3dError, ConfigError
from cello3d_ros.ros import parameters
from cello3d_ros.ros.diagnostics import State, Statistics
from cello3d_ros.ros.inputs import Role, Topic, topics
from cello3d_ros.ros.life import ManagedNode
from cello3d_ros.ros.logbook import Logbook
from cello3d_ros.ros.messages import tf_message
from cello3d_ros.ros.outputs import Outputs
from cello3d_ros.ros.process import PROFILE
from cello3d_ros.ros.worker import Worker
from cello3d_ros.tracking.intake import JUMP_NS, Job, Skip
from cello3d_ros.tracking.tracker import Answer
from cello3d_ros.tracking.warmup import warm_up

_PATIENCE_S = 0.05  # longest time for which work is put off to hear what came before it
_N_LOOKS = 4  # seconds for which a publisher of clouds may be silent
_TICK_S = 0.05  # how often it is looked whether a cloud has waited too long


class CovarianceNode(ManagedNode):
    """Translates: messages in, one call of the worker, messages out, errors to diagnostics."""

    def __init__(self, name: str) -> None:
        """Join the graph, unconfigured.  Raises ConfigError for a parameter of a wrong type."""
        super().__init__(name)
        parameters.declare_first(self)
        self._config: Config | None = None  # None: not configured
        self._defaults: Config | None = None
        self._n_publishers = self._n_looks_in_vain = 0
        self._logbook = Logbook(lambda sentence: self.get_logger().warning(sentence))
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)

    @property
    def autostart(self) -> bool:
        """Whether the process is to configure and activate the node by itself."""
        return bool(self.get_parameter(parameters.AUTOSTART).value)

    def configure(self) -> None:
        """Load, check and warm up everything, then say what may be heard."""
        path = find_model(str(self.get_parameter(parameters.MODEL).value))
        self._model = load_model(path)
        config = self._declared(self._model)
        topics(config.node)  # what is not installed is better missed before the warming up
        if config.node.publish_tf:
            tf_message("node.publish_tf")
        self.get_logger().info("warming up; a first start compiles the kernels")
        warm_up(self._model, config)
        self._statistics = Statistics(path.name)
        is_given = parameters.T_BASE_SENSOR in parameters.overrides(self)
        self._worker = Worker(self._model, config, self._skip, self._logbook.warn, is_given)
        self.configured.callback(self._forget)
        self._outputs = Outputs(self, config.node)
        self.configured.callback(self._outputs.destroy)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.configured.callback(self.destroy_publisher, self._diagnostics)
        timer = self.create_timer(1.0, self._look_about, clock=self._steady)
        self.configured.callback(self.destroy_timer, timer)
        reset = self.create_service(Trigger, "~/reset", self._reset)
        self.configured.callback(self.destroy_service, reset)
        self._config = config
        self.get_logger().info(f"ready: model {path.name} of {self._model.n_examples} examples")

    def listen(self) -> None:
        """Start anew: clouds, odometry and what follows from them."""
        assert self._config is not None
        self._statistics.listen(True)
        self.active.callback(self._statistics.listen, False)
        self.active.callback(self._worker.stop)
        self._came: set[Role] = set()
        self._patient_until_s: float | None = None
        self._last_cloud: tuple[Any, int | None] = None, None  # its publisher and number
        self._n_publishers = 0  # of clouds, when the last one came
        self._n_looks_in_vain = 0  # at publishers from which no cloud comes
        self._work_is_there = self.create_guard_condition(self._work_when_quiet)
        self.active.callback(self.destroy_guard_condition, self._work_is_there)
        timer = self.create_timer(_TICK_S, self._expire, clock=self._steady)
        self.active.callback(self.destroy_timer, timer)
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-JUMP_NS), on_clock_change=False
        )
        jumps = self.get_clock().create_jump_callback(backward, post_callback=self._on_jump)
        self.active.callback(jumps.unregister)
        names = [self._hear(topic) for topic in topics(self._config.node)]
        self.get_logger().info(f"listening to {', '.join(dict.fromkeys(names))}")

    def _hear(self, topic: Topic) -> str:
        """Subscribe for as long as the node is active; return the full name of the topic."""
        callbacks: dict[Role, Callable[..., None]] = {
            Role.CLOUD: self._on_cloud,
            Role.POSE: self._on_pose,
            Role.REFERENCE: self._on_reference,
            Role.TRANSFORMS: self._on_transforms,
            Role.STATIC_TRANSFORMS: self._on_static_transforms,
        }
        subscription = self.create_subscription(
            topic.kind, topic.name, callbacks[topic.role], topic.qos
        )
        self.active.callback(self.destroy_subscription, subscription)
        return str(subscription.topic_name)

    def _declared(self, model: Model) -> Config:
        if self._defaults is not None:
            parameters.release(self, self._defaults)
        name = self.get_parameter(parameters.PIPELINE_NAME).value
        pipeline = named_pipeline(name, "parameters") if name else model.pipeline
        self._defaults = Config(**sections_of(pipeline), sampling=model.sampling)
        config = parameters.declare(self, self._defaults)
        if config.grid != model.pipeline.grid:
            raise ConfigError(f"parameters grid.* must be the model's, {model.pipeline.grid}")
        for name in parameters.unknown(self):
            self.get_logger().warning(f"unknown parameter {name} has no effect")
        self._warn_of_differences(config, model)
        return config

    def _forget(self) -> None:
        self._config = None
        del self._worker, self._model

    # what is heard

    def _on_pose(self, message: Odometry | PoseWithCovarianceStamped) -> None:
        self._came.add(Role.POSE)
        self._statistics.counts["odometry"] += 1
        if not self._worker.hear_pose(message, self._now_ns()):
            self._statistics.counts["odometry_rejected"] += 1
        elif self._worker.has_work:
            self._work_is_there.trigger()

    def _on_transforms(self, message: Any, static: bool = False) -> None:
        self._worker.hear_transforms(message, static)
        if self._worker.has_work:
            self._work_is_there.trigger()

    def _on_static_transforms(self, message: Any) -> None:
        self._on_transforms(message, static=True)

    def _on_reference(self, message: PointCloud2) -> None:
        self._worker.hear_reference(message)

    def _on_cloud(self, message: Any, info: dict[str, Any]) -> None:
        self._came.add(Role.CLOUD)
        n_unheard = self._n_unheard(info)
        self._statistics.receive(n_unheard)
        self._worker.hear_cloud(message, self._now_ns(), n_unheard)
        if self._worker.has_work:
            self._work_is_there.trigger()

    def _n_unheard(self, info: dict[str, Any]) -> int:
        """Return how many clouds of this publisher came since the last and never got here.

        Each publisher counts for itself, and nobody says whose a cloud is: 0 unless there is one,
        and the same as before.
        """
        publishers = self.get_publishers_info_by_topic(self.resolve_topic_name("points"))
        self._n_publishers = len(publishers)
        only = tuple(publishers[0].endpoint_gid) if len(publishers) == 1 else None
        number = info.get("publication_sequence_number")
        (publisher, before), self._last_cloud = self._last_cloud, (only, number)
        if only is None or publisher != only or before is None or number is None:
            return 0
        return max(0, int(number) - before - 1)

    def _expire(self) -> None:
        self._worker.expire(_TICK_S)
        if self._worker.has_work:  # perhaps one that can do without odometry
            self._work_is_there.trigger()

    def _on_jump(self, jump: TimeJump) -> None:
        self._worker.jump_to(self._now_ns())

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._worker.reset()
        response.success = True
        response.message = "the reference and the chain are forgotten"
        return response

    # what is said

    def _work_when_quiet(self) -> None:
        """Work; under overload first hear what came meanwhile: the newest cloud is next.

        A guard runs after the subscriptions, of which each hands over one message at a time: the
        newest cloud may be one turn away, and its odometry behind all that came before it.
        """
        came, self._came = self._came, set()
        is_waited_for = {Role.CLOUD} if self._worker.newest_is_ready else {Role.CLOUD, Role.POSE}
        now_s = time.monotonic()
        is_patient = self._worker.is_overloaded and now_s < (self._patient_until_s or math.inf)
        if came & is_waited_for and is_patient:
            self._patient_until_s = self._patient_until_s or now_s + _PATIENCE_S
            self._work_is_there.trigger()
            return
        self._patient_until_s = None
        self._work()

    def _work(self) -> None:
        job = self._worker.take()
        if job is None:
            return
        try:
            answer = self._worker.answer(job)
            if answer is None:
                self._statistics.reference(job.stamp_ns)
            else:
                self._publish(job, answer)
        except Cello3dError as error:
            self._skip(Skip(job.stamp_ns, error.reason, str(error)))
        except Exception as error:  # a node that dies of one cloud is worse than a lost answer
            self._outlive()
            self._skip(Skip(job.stamp_ns, "internal", f"{type(error).__name__}: {error}"))
        self._publish_diagnostics()
        try:
            self._worker.finish()
        except Exception:  # the cloud is answered; as a reference it is of no use
            self._outlive()
            self._worker.reset()
        if self._worker.has_work:
            self._work_is_there.trigger()

    def _outlive(self) -> None:
        """Log the exception that is being handled; raise it again where the node has to end."""
        if not self.context.ok():
            raise
        self.get_logger().error(traceback.format_exc())

    def _publish(self, job: Job, answer: Answer) -> None:
        assert self._config is not None
        C, verdict = self._outputs.publish(job, answer, self._config.node)
        self._statistics.answer(answer, C, verdict, job.received_s, self._now_ns())

    def _skip(self, skip: Skip) -> None:
        self._statistics.fail(skip.stamp_ns, skip.reason, skip.sentence)
        if skip.reason != "superseded":
            self._logbook.warn(skip.reason, f"cloud skipped: {skip.sentence}")
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        assert self._config is not None
        self._diagnostics.publish(
            self._statistics.message(
                f"{self.get_fully_qualified_name().strip('/')}: registration",
                self._now_ns(),
                self._config.node,
                self._state(),
            )
        )

    def _state(self) -> State:
        worker = self._worker
        warnings = [*worker.warnings, *self._publisher_warnings()]
        for sentence in warnings:
            self._logbook.warn_once(sentence)
        return State(worker.n_restarts, worker.last_restart, worker.n_clock_jumps, tuple(warnings))

    def _publisher_warnings(self) -> Iterator[str]:
        topic = self.resolve_topic_name("points")
        if self._n_publishers > 1:
            yield (
                f"{self._n_publishers} publishers send clouds on {topic}: if they are lidars, "
                "merge their clouds or start a node for each"
            )
        if self._n_looks_in_vain >= _N_LOOKS:
            yield (
                f"{topic} has a publisher but no cloud arrives: large clouds need the DDS profile "
                f"config/{PROFILE} of this package (FASTRTPS_DEFAULT_PROFILES_FILE) in both "
                "programs"
            )

    def _look_about(self) -> None:
        """Once a second: is there a publisher of clouds from which none has ever come?"""
        is_in_vain = (
            self._statistics.is_waiting
            and self._statistics.counts["received"] == 0
            and self.count_publishers(self.resolve_topic_name("points")) > 0
        )
        self._n_looks_in_vain = self._n_looks_in_vain + 1 if is_in_vain else 0
        self._publish_diagnostics()

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    # parameters

    def _check_parameters(self, given: list[Parameter]) -> SetParametersResult:
        try:
            if self._config is not None:
                parameters.changed(self._config, given)
            else:
                parameters.check(self, given)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, given: list[Parameter]) -> None:
        if self._config is None:  # configure reads them
            return
        self._config = parameters.changed(self._config, given)
        self._worker.set_config(self._config)
        self._warn_of_differences(self._config, self._model)

    def _warn_of_differences(self, config: Config, model: Model) -> None:
        if warning := pipeline_warning(model.pipeline, config):
            self.get_logger().warning(warning)
