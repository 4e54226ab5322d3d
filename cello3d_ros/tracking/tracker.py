"""From a stream of scans to relative poses and a chain of them.  Imports no ROS.

Which scan is paired with which, when the chain of poses breaks and where it starts again is
decided here; registration and covariance are one call of the estimator.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from cello3d_ros.clouds.shape import filtered, with_shape
from cello3d_ros.config import NodeConfig, Pipeline
from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.covariance.estimator import Estimate, Estimator, draws, needs_shape
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import ModelError, RegistrationError
from cello3d_ros.geometry.gaussian import GaussianPose, compound_right, is_positive_definite
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.geometry.transforms import seen_from_base
from cello3d_ros.tracking.external import External, checked
from cello3d_ros.tracking.guess import CONSTANT_VELOCITY, EXTERNAL, ODOMETRY, Motion, Place
from cello3d_ros.tracking.pairing import Frame, Link, Map, makes_keyframe

_ORIGIN = np.eye(4)
_MAX_TURN2_RAD2 = 3.0  # one radian about each axis
_N_THREADS = min(os.cpu_count() or 1, 4)  # more than that is not worth starting


class TooFarApartError(RegistrationError):
    """Two scans are too far apart in time to be a pair."""

    reason = "too_far_apart"


class BrokenChainError(RegistrationError):
    """Frames or odometry have changed, so that a scan cannot be paired with those before it."""

    reason = "broken_chain"


class NoReferenceError(RegistrationError):
    """No reference cloud has come."""

    reason = "no_reference"


@dataclass(frozen=True)
class Answer:
    """One registration and the chain that ends with it, as they are published.

    T_odom_read: (4, 4), the accumulated pose; its covariance Y_chain: (6, 6), reading side.
    frame_id, pose_frame_id: the frames of the registration and of the accumulated pose;
    child_frame_id: whose pose they are.  guess: where the first guess came from.  offset: (6,),
    the twist by which ICP would move an external pose, else None.
    """

    stamp_ns: int
    reference_ns: int
    estimate: Estimate
    T_odom_read: Array
    Y_chain: Array
    frame_id: str = "lidar"
    pose_frame_id: str = "odom"
    child_frame_id: str = "lidar"
    guess: str = ODOMETRY
    offset: Array | None = None


class Tracker:
    """Pairs each scan with the one before, a keyframe or a map, and accumulates the poses."""

    def __init__(self, model: Model, pipeline: Pipeline, config: NodeConfig) -> None:
        self.model, self.pipeline, self.config = model, pipeline, config
        self.n_failures = 0  # in a row, against the present reference
        self.n_restarts = 0
        self.last_restart = ""
        self._map: Map | None = None
        self._reference: Link | None = None
        self._latest: Link | None = None
        self._rival: Link | None = None  # failed against a first scan that nothing has fitted
        self._motion = Motion()
        self._T_map_odom: Array = _ORIGIN

    def reset(self, reason: str = "") -> None:
        """Forget the reference and the chain; the next scan starts anew.  A map stays."""
        if self._reference is not None:
            self.n_restarts += 1
            self.last_restart = reason
        self._reference = self._latest = self._rival = None
        self._motion = Motion()
        self._T_map_odom = _ORIGIN
        self.n_failures = 0

    def take_map(self, stamp_ns: int, points: Array, frame_id: str) -> None:
        """Register scans to this cloud from now on.  points: (N, 3), in the frame ``frame_id``.

        One that comes again, as it does by two subscriptions, is not prepared again.
        """
        new = Map(stamp_ns, points, frame_id)
        if self._map is None or self._map.frame_id != frame_id:
            self.reset("the frame of the reference cloud changed")
        elif self._map.is_same(new):
            return
        self._map = new

    def step(self, stamp_ns: int, points: Array, place: Place) -> Answer | None:
        """Register a scan to the reference; it becomes the reference, or not, by ``pairing``.

        points: (N, 3), sensor frame.  Returns None for a scan that only starts a chain.
        Raises CloudError, RegistrationError or ModelError (the pair is beyond the model) when
        there is no answer: the reference stays, until ``max_failures`` scans in a row have failed
        against it; then the chain starts again at the last of them.  It starts again at once
        where nothing has fitted the first scan of a chain and two scans after it fit each other.
        """
        rng = draws(points, self.config.seed)
        cloud = filtered(points, self.pipeline.cloud, rng, _N_THREADS)
        frame = Frame(stamp_ns, cloud, place, place.T_odom_sensor)
        if needs_shape(self.model, self.pipeline):
            frame = self._shaped(frame)
        if self._latest is not None:
            frame = self._in_chain(frame, self._latest.frame)
        if self.config.pairing == "topics":
            self._reference = self._map_around(frame)
        elif self._reference is None:
            self._begin(self._first(frame, _ORIGIN))
            return None
        self.finish()
        reference = self._reference
        assert reference is not None
        try:
            answer = self._answer(frame, reference, rng)
        except (RegistrationError, ModelError):
            rival, match = self._rival, self._match(frame, self._rival, rng)
            if rival is None or match is None:
                self._fail(frame)
                raise
            self.reset("two scans fit each other but not the first of the chain")
            self._begin(rival)
            answer, reference = match, rival
        self._accept(frame, answer, reference)
        return self._published(answer, place, reference)

    def finish(self) -> None:
        """Work ahead: find the local shape of the reference, which the next scan will need.

        An answer need not wait for it; without this call, the next step does it first.
        """
        if self._reference is not None:
            self._reference = replace(self._reference, frame=self._shaped(self._reference.frame))

    def _shaped(self, frame: Frame) -> Frame:
        return replace(frame, cloud=with_shape(frame.cloud, self.pipeline.cloud, _N_THREADS))

    def _in_chain(self, frame: Frame, before: Frame) -> Frame:
        """Return a scan that can follow the one before; else start the chain at it and raise.

        A map is still where it was when odometry is not: then the guess does without odometry.
        """
        to_map = self.config.pairing == "topics"
        gap_s = 1e-9 * (frame.stamp_ns - before.stamp_ns)
        error: RegistrationError
        if broken := _broken(before.place, frame.place):
            if to_map:
                is_external = frame.place.guess == EXTERNAL
                return frame if is_external else replace(frame, T_odom_sensor=None)
            error = BrokenChainError(f"{broken}: the chain starts again here")
        elif gap_s > self.config.max_pair_gap_s and not to_map:
            error = TooFarApartError(
                f"the scan comes {gap_s:.1f} s after the one before it, more than "
                f"{self.config.max_pair_gap_s:g} s: the chain starts again here"
            )
        else:
            return frame
        self._restart_at(frame, str(error))
        raise error

    def _map_around(self, frame: Frame) -> Link:
        """Return the part of the map around the first guess of the sensor as a reference."""
        if self._map is None:
            raise NoReferenceError("no cloud has been received on reference_points")
        given = frame.place.T_map_odom
        T_map_odom = self._T_map_odom if given is None else given
        if frame.T_odom_sensor is None:
            T_map_sensor = self._motion.at(frame.stamp_ns)
        else:
            T_map_sensor = T_map_odom @ frame.T_odom_sensor
        cloud, T_map_crop = self._map.around(T_map_sensor[:3, 3], self.config, self.pipeline.cloud)
        T_odom_crop = inverse(T_map_odom) @ T_map_crop
        crop = Frame(self._map.stamp_ns, cloud, frame.place, T_odom_crop)
        return Link(crop, T_map_crop, np.zeros((6, 6)))

    def _answer(self, reading: Frame, reference: Link, rng: np.random.Generator) -> Answer:
        T_init, guess = self._guess(reading, reference)
        clouds = reading.cloud, self._shaped(reference.frame).cloud  # a rival has none yet
        external: External | None = None
        if guess == EXTERNAL:
            limit = self.config.max_external_offset
            external = checked(*clouds, T_init, self.pipeline.icp, limit, rng)
            found = self._estimator().judge(*clouds, external.registration, rng)
            offset = external.offset
            found = found._replace(covariance=found.covariance + np.outer(offset, offset))
        else:
            found = self._estimator().register(*clouds, T_init, rng)
        T, Y = _extended(reference.T, reference.Y, found.registration.T_ref_read, found.covariance)
        return Answer(
            reading.stamp_ns,
            reference.frame.stamp_ns,
            found,
            T,
            Y,
            guess=guess,
            offset=None if external is None else external.offset,
        )

    def _match(self, frame: Frame, rival: Link | None, rng: np.random.Generator) -> Answer | None:
        """Return what a scan is to the one that failed before it, or None."""
        try:
            return None if rival is None else self._answer(frame, rival, rng)
        except (RegistrationError, ModelError):
            return None

    def _guess(self, reading: Frame, reference: Link) -> tuple[Array, str]:
        """Return the first guess of T_ref_read and where it comes from."""
        T_odom_ref, T_odom_read = reference.frame.T_odom_sensor, reading.T_odom_sensor
        if T_odom_ref is not None and T_odom_read is not None:
            return inverse(T_odom_ref) @ T_odom_read, reading.place.guess
        return inverse(reference.T) @ self._motion.at(reading.stamp_ns), CONSTANT_VELOCITY

    def _accept(self, frame: Frame, answer: Answer, reference: Link) -> None:
        """Take an answered scan into the chain, and as the next reference if it is one."""
        place = frame.place
        T_ref_read = answer.estimate.registration.T_ref_read
        T_odom_ref = reference.frame.T_odom_sensor
        if place.guess not in (ODOMETRY, EXTERNAL) and T_odom_ref is not None:
            frame = replace(frame, T_odom_sensor=T_odom_ref @ T_ref_read)
        self._latest = Link(frame, answer.T_odom_read, answer.Y_chain)
        self._motion.add(frame.stamp_ns, answer.T_odom_read)
        self._rival = None
        self.n_failures = 0
        if self.config.pairing == "topics":
            if place.guess == ODOMETRY and place.T_odom_sensor is not None:
                self._T_map_odom = answer.T_odom_read @ inverse(place.T_odom_sensor)
        elif self.config.pairing == "consecutive" or makes_keyframe(
            T_ref_read, answer.estimate.overlap_ratio, self.config
        ):
            self._reference = self._latest

    def _published(self, answer: Answer, place: Place, reference: Link) -> Answer:
        """Return an answer in the frames in which it is published."""
        base = self.config.output_frame == "base"
        child = place.base_frame if base else place.sensor_frame
        found = answer.estimate
        T, X_ref = found.registration.T_ref_read, reference.frame.place.T_base_sensor
        frame_id, pose_frame_id = child, place.odom_frame
        if self.config.pairing == "topics" and self._map is not None:
            T, X_ref = answer.T_odom_read, _ORIGIN
            frame_id = pose_frame_id = self._map.frame_id
        step = GaussianPose(T, found.covariance)
        pose = GaussianPose(answer.T_odom_read, answer.Y_chain)
        if base:
            X = place.T_base_sensor
            step = seen_from_base(*step, X_ref, X)
            pose = seen_from_base(*pose, _ORIGIN, X)
        registration = found.registration._replace(T_ref_read=step.T)
        return replace(
            answer,
            estimate=found._replace(registration=registration, covariance=step.Y),
            T_odom_read=pose.T,
            Y_chain=pose.Y,
            frame_id=frame_id,
            pose_frame_id=pose_frame_id,
            child_frame_id=child,
        )

    def _estimator(self) -> Estimator:
        config = self.config
        settings = MethodSettings(
            sigma_m=config.sensor_sigma_m,
            n_registrations=config.n_registrations,
            unknown_quantile=config.unknown_quantile,
            widen_unknown=config.inflate_unknown,
            scale=config.scale,
            floor_sigma_m=config.floor_sigma_m,
            floor_sigma_rad=config.floor_sigma_rad,
            ceiling=config.ceiling,
            n_threads=_N_THREADS,
        )
        return Estimator(self.model, config.covariance_mode, settings, self.pipeline)

    def _fail(self, frame: Frame) -> None:
        self.n_failures += 1
        if self.n_failures >= self.config.max_failures:
            self._restart_at(frame, f"{self.n_failures} failures in a row")
            return
        if self.config.pairing == "keyframe":
            self._reference = self._latest  # the keyframe may be too far away by now
        if self._latest is not None and not self._latest.Y.any():  # it is the first
            self._rival = self._first(frame, self._motion.at(frame.stamp_ns))

    def _restart_at(self, frame: Frame, reason: str) -> None:
        T_odom_sensor = self._motion.at(frame.stamp_ns)
        self.reset(reason)
        if self.config.pairing != "topics":
            self._begin(self._first(frame, T_odom_sensor))

    def _first(self, frame: Frame, T_predicted: Array) -> Link:
        """Return the start of a chain, where odometry puts it or, without it, as expected."""
        T = T_predicted if frame.T_odom_sensor is None else frame.T_odom_sensor
        return Link(frame, T, np.zeros((6, 6)))

    def _begin(self, link: Link) -> None:
        self._reference = self._latest = link
        self._motion.add(link.frame.stamp_ns, link.T)


def _broken(before: Place, now: Place) -> str:
    """Return why a scan cannot follow another, or ""."""
    for what, old, new in (
        ("frame_id of the clouds", before.sensor_frame, now.sensor_frame),
        ("frame of the odometry", before.odom_frame, now.odom_frame),
        ("child frame of the odometry", before.base_frame, now.base_frame),
    ):
        if old != new:
            return f"the {what} changed from {old!r} to {new!r}"
    return "" if before.epoch == now.epoch else "the odometry jumped or began anew"


def _extended(T: Array, Y: Array, T_step: Array, Y_step: Array) -> tuple[Array, Array]:
    """Return the chain one step longer: 4th order, 2nd where the 4th means nothing.

    That is where its result is not positive definite, or rotations are hardly known: the terms of
    4th order multiply variances, and would from a radian on make a chain grow without bound.
    """
    if max(np.trace(Y[3:, 3:]), np.trace(Y_step[3:, 3:])) <= _MAX_TURN2_RAD2:
        longer = compound_right(T, Y, T_step, Y_step, order=4)
        if is_positive_definite(longer.Y):
            return longer.T, longer.Y
    longer = compound_right(T, Y, T_step, Y_step, order=2)
    return longer.T, longer.Y
