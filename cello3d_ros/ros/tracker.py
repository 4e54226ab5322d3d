"""From a stream of scans to relative poses and a chain of them.  Imports no ROS.

Which scan is paired with which, when the chain of poses breaks and where it starts again is
decided here; registration and covariance are one call of the estimator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import NodeConfig, Pipeline
from cello3d_ros.covariance.estimator import Estimate, estimate
from cello3d_ros.covariance.methods import METHODS, MethodSettings
from cello3d_ros.covariance.model import Model
from cello3d_ros.covariance.novelty import rho_limit
from cello3d_ros.errors import CloudError, ModelError, NoOverlapError, RegistrationError
from cello3d_ros.geometry.gaussian import compound_right, is_positive_definite
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.ros.covariances import CovarianceError

#: Names of METHODS by ``node.covariance_mode``.
METHOD_OF = {"cello3d": "model"} | {name: name for name in METHODS}


class NotConvergedError(RegistrationError):
    """ICP stopped before it settled."""


class TooFarApartError(RegistrationError):
    """Two scans are too far apart in time to be a pair."""


@dataclass(frozen=True)
class Frame:
    """A prepared scan and the odometry at its stamp."""

    stamp_ns: int
    cloud: Cloud
    T_odom_sensor: Array


@dataclass(frozen=True)
class Answer:
    """One registration and the chain that ends with it.

    T_odom_read: (4, 4), the accumulated pose; its covariance Y_chain: (6, 6), reading side.
    """

    stamp_ns: int
    reference_ns: int
    estimate: Estimate
    T_odom_read: Array
    Y_chain: Array


class Tracker:
    """Pairs each scan with the one before and accumulates the poses."""

    def __init__(self, model: Model, pipeline: Pipeline, config: NodeConfig) -> None:
        self.model, self.pipeline, self.config = model, pipeline, config
        self._rho_limit = rho_limit(model, config.unknown_quantile)
        self.n_failures = 0  # in a row, against the present reference
        self.n_restarts = 0
        self._reference: Frame | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the reference and the chain; the next scan starts anew."""
        self.n_restarts += self._reference is not None
        self._reference = None
        self._T_odom_ref: Array = np.eye(4)
        self._Y_chain: Array = np.zeros((6, 6))
        self.n_failures = 0

    def step(self, stamp_ns: int, points: Array, T_odom_sensor: Array) -> Answer | None:
        """Register a scan to the reference; it becomes the reference.

        points: (N, 3), sensor frame.  Returns None for the first scan, which only is a reference.
        Raises CloudError, RegistrationError or ModelError (the pair is beyond the model) when
        there is no answer: the reference stays, until ``max_failures`` scans in a row have failed
        against it; then the chain starts again at the last of them.
        """
        rng = np.random.default_rng([self.config.seed, stamp_ns & (2**64 - 1)])
        frame = Frame(stamp_ns, prepare(points, self.pipeline.cloud, rng), T_odom_sensor)
        if self._reference is None:
            self._start_at(frame)
            return None
        gap_s = 1e-9 * (stamp_ns - self._reference.stamp_ns)
        if gap_s > self.config.max_pair_gap_s:
            self._restart_at(frame)
            raise TooFarApartError(
                f"the scan comes {gap_s:.1f} s after the one before it, more than "
                f"{self.config.max_pair_gap_s:g} s: the chain starts again here"
            )
        try:
            answer = self._answer(frame, self._reference, rng)
        except (RegistrationError, ModelError):
            self._fail(frame)
            raise
        self._reference, self.n_failures = frame, 0
        self._T_odom_ref, self._Y_chain = answer.T_odom_read, answer.Y_chain
        return answer

    def _answer(self, reading: Frame, reference: Frame, rng: np.random.Generator) -> Answer:
        T_init = inverse(reference.T_odom_sensor) @ reading.T_odom_sensor
        found = estimate(
            *(reading.cloud, reference.cloud, T_init, self.model, self.pipeline, rng),
            method=METHOD_OF[self.config.covariance_mode],
            settings=self._settings(),
        )
        if not found.registration.converged:
            raise NotConvergedError(
                f"ICP did not converge in {found.registration.n_iterations} iterations "
                f"({found.registration.reason})"
            )
        T, Y = _extended(
            self._T_odom_ref, self._Y_chain, found.registration.T_ref_read, found.covariance
        )
        return Answer(reading.stamp_ns, reference.stamp_ns, found, T, Y)

    def _settings(self) -> MethodSettings:
        config = self.config
        return MethodSettings(
            sigma_m=config.sensor_sigma_m,
            n_registrations=config.n_registrations,
            rho_limit=self._rho_limit,
            widen_unknown=config.inflate_unknown,
            scale=config.scale,
        )

    def _fail(self, frame: Frame) -> None:
        self.n_failures += 1
        if self.n_failures >= self.config.max_failures:
            self._restart_at(frame)

    def _restart_at(self, frame: Frame) -> None:
        self.n_restarts += 1
        self._start_at(frame)

    def _start_at(self, frame: Frame) -> None:
        self._reference, self.n_failures = frame, 0
        self._T_odom_ref, self._Y_chain = frame.T_odom_sensor, np.zeros((6, 6))


def reason_of(error: Exception) -> str:
    """Return the short name under which a failure is counted."""
    names = {
        NotConvergedError: "not_converged",
        TooFarApartError: "too_far_apart",
        NoOverlapError: "no_overlap",
        RegistrationError: "registration",
        ModelError: "beyond_model",
        CloudError: "too_few_points",
        CovarianceError: "covariance",
    }
    return next((name for kind, name in names.items() if isinstance(error, kind)), "internal")


def _extended(T: Array, Y: Array, T_step: Array, Y_step: Array) -> tuple[Array, Array]:
    """Return the chain one step longer: 4th order, 2nd where the 4th is not positive definite."""
    longer = compound_right(T, Y, T_step, Y_step, order=4)
    if not is_positive_definite(longer.Y):
        longer = compound_right(T, Y, T_step, Y_step, order=2)
    return longer.T, longer.Y
