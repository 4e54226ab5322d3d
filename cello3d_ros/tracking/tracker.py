"""From a stream of scans to relative poses and a chain of them.  Imports no ROS.

When the chain of poses breaks and where it starts again is decided here, what a scan is registered
to in pairing.py; registration and covariance are one call of the estimator.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.motion import undistorted
from cello3d_ros.clouds.shape import Cloud, filtered
from cello3d_ros.config import NodeConfig, Pipeline
from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.covariance.estimator import Estimate, Estimator, draws, needs_shape
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import ModelError, RegistrationError
from cello3d_ros.geometry.gaussian import (
    REFERENCE_SHARE,
    Chained,
    GaussianPose,
    between,
    extended,
)
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.se3 import Array, inverse, log
from cello3d_ros.geometry.transforms import seen_from_base
from cello3d_ros.tracking.agreement import (
    Alternation,
    OdometryDisagreesError,
    contradiction,
    step_covariance,
)
from cello3d_ros.tracking.chain import Chain, Frame, Link
from cello3d_ros.tracking.external import checked
from cello3d_ros.tracking.guess import CONSTANT_VELOCITY, EXTERNAL, ODOMETRY, Place
from cello3d_ros.tracking.map import Map
from cello3d_ros.tracking.pairing import PAIRINGS, ToMap, has_moved
from cello3d_ros.tracking.planar import on_the_floor

_ORIGIN = np.eye(4)
NO_TIMES = "no: the points carry no times"
_N_THREADS = min(os.cpu_count() or 1, 4)  # more than that is not worth starting


class TooFarApartError(RegistrationError):
    """Two scans are too far apart in time to be a pair."""

    reason = "too_far_apart"


class BrokenChainError(RegistrationError):
    """Frames or odometry have changed, so that a scan cannot be paired with those before it."""

    reason = "broken_chain"


@dataclass(frozen=True)
class Answer:
    """One registration and the chain that ends with it.

    estimate: of the sensor at the two scans.  step: the pose of ``child_frame_id`` at the reading
    in ``frame_id``, by this registration; pose: its accumulated pose in ``pose_frame_id``; both as
    they are published, with right covariances.  motion: the pose of ``child_frame_id`` seen from
    where it was at the scan answered before, span_s earlier; both None where that is unknown.
    guess: where the first guess came from.  offset: (6,), the twist by which ICP would move an
    external pose, else None.  disagreement: why odometry contradicts it, in a sentence, or "".
    deskewed: by what the motion within the reading was undone, or "no: " and why it was not.
    """

    stamp_ns: int
    reference_ns: int
    estimate: Estimate
    step: GaussianPose
    pose: GaussianPose
    frame_id: str = "lidar"
    pose_frame_id: str = "odom"
    child_frame_id: str = "lidar"
    motion: GaussianPose | None = None
    span_s: float | None = None
    guess: str = ODOMETRY
    offset: Array | None = None
    disagreement: str = ""
    deskewed: str = NO_TIMES


class _Found(NamedTuple):
    """A registration of the sensor, what is made of it, and where its first guess came from."""

    estimate: Estimate
    step: GaussianPose
    guess: str
    offset: Array | None = None
    disagreement: str = ""
    motion: GaussianPose | None = None
    span_s: float | None = None


class Tracker:
    """Registers each scan to what its pairing chooses, and accumulates the poses."""

    def __init__(self, model: Model, pipeline: Pipeline, config: NodeConfig) -> None:
        self.model, self.pipeline, self.config = model, pipeline, config
        self.n_failures = 0  # in a row, against the present reference
        self.n_restarts = 0
        self.last_restart = ""
        self._pairing = PAIRINGS[config.pairing]()
        self._chain = Chain()
        self._before: tuple[Link, GaussianPose] | None = None  # the last reference and step
        self._rival: Link | None = None  # failed against a first scan that nothing has fitted
        self._alternation = Alternation()

    @property
    def warning(self) -> str:
        """What seems wrong with the clouds altogether, or ""."""
        return self._alternation.sentence

    def reset(self, reason: str = "") -> None:
        """Forget the reference and the chain; the next scan starts anew.  A map stays."""
        if self._chain.newest is not None:
            self.n_restarts += 1
            self.last_restart = reason
        self._chain, self._before, self._rival = Chain(), None, None
        self.n_failures = 0
        self._pairing.begin(None)

    def take_map(self, stamp_ns: int, points: Array, frame_id: str) -> None:
        """Register scans to this cloud from now on.  points: (N, 3), in the frame ``frame_id``.

        One that comes again, as it does by two subscriptions, is not prepared again.
        """
        if isinstance(self._pairing, ToMap) and self._pairing.take(
            Map(stamp_ns, points, frame_id)
        ):
            self.reset("the frame of the reference cloud changed")

    def step(
        self, stamp_ns: int, points: Array, place: Place, time_s: Array | None = None
    ) -> Answer | None:
        """Register a scan to its reference; it becomes the next one, or not, by ``pairing``.

        points: (N, 3), sensor frame.  time_s: (N,), finite, when each was seen, after the stamp,
        or None: by them the motion within the scan is undone.  Returns None for a scan that only
        starts a chain.  Raises CloudError, RegistrationError or ModelError (the pair is beyond
        the model) when there is no answer: the reference stays, until ``max_failures`` scans in a
        row have failed against it; then the chain starts again at the last of them.  It starts
        again at once where nothing has fitted the first scan of a chain and two scans after it
        fit each other.
        """
        sweep = None if time_s is None or place.motion is not None else (points, time_s)
        points, deskewed = self._deskewed(stamp_ns, points, place, time_s)
        rng = draws(points, self.config.seed)
        cloud = filtered(points, self.pipeline.cloud, rng)
        frame = self._in_chain(Frame(stamp_ns, cloud, place, place.T_odom_sensor, sweep))
        reference = self._pairing.reference(frame, self._chain, self.config, self.pipeline.cloud)
        if reference is None:
            self._begin(Link.first(frame, _ORIGIN))
            return None
        try:
            found = self._registered(frame, reference, rng)
        except (RegistrationError, ModelError):
            rival, match = self._rival, self._match(frame, rng)
            if rival is None or match is None:
                self._alternation.add(None)
                self._fail(frame)
                raise
            self.reset("two scans fit each other but not the first of the chain")
            self._begin(rival)
            found, reference = match, rival
        pose = extended(reference.pose, found.step, self.model.bias)
        found = self._with_motion(frame, found, reference)
        self._accept(frame, found, reference, pose)
        return replace(self._published(frame, found, reference, pose.pose), deskewed=deskewed)

    def finish(self) -> None:
        """Work ahead: find the local shape of the reference, which the next scan will need.

        An answer need not wait for it; without this call, the next step does it first.
        """
        if (frame := self._pairing.next_reference) is not None:
            frame.shaped(self.pipeline.cloud, _N_THREADS)

    def _deskewed(
        self, stamp_ns: int, points: Array, place: Place, time_s: Array | None
    ) -> tuple[Array, str]:
        """Return points as seen at the stamp, and what told the motion or why it is not undone.

        Odometry tells it, else the last registration: its velocity goes on.  The reference is
        undone by the same velocity, so that an error of it is common to both.
        """
        if time_s is None:
            return points, NO_TIMES
        if place.motion is not None:
            return undistorted(points, time_s, place.motion), "by odometry"
        newest, velocity = self._chain.newest, self._chain.velocity
        if newest is None or velocity is None:
            return points, "no: nothing tells the motion yet"
        if 1e-9 * (stamp_ns - newest.frame.stamp_ns) > self.config.max_pair_gap_s:
            return points, "no: the last registration is too old to tell the motion"
        motion = Motion.constant(velocity)
        return undistorted(points, time_s, motion), "by the last registration"

    def _in_chain(self, frame: Frame) -> Frame:
        """Return a scan that can follow the one before; else start the chain at it and raise.

        A map is still where it was when odometry is not: then the guess does without odometry.
        """
        if self._chain.newest is None:
            return frame
        before = self._chain.newest.frame
        gap_s = 1e-9 * (frame.stamp_ns - before.stamp_ns)
        broken = _broken(before.place, frame.place)
        if not self._pairing.needs_chain:
            is_external = frame.place.guess == EXTERNAL
            return frame if is_external or not broken else frame.at(None)
        error: RegistrationError
        if broken:
            error = BrokenChainError(f"{broken}: the chain starts again here")
        elif gap_s > self.config.max_pair_gap_s:
            error = TooFarApartError(
                f"the scan comes {gap_s:.1f} s after the one before it, more than "
                f"{self.config.max_pair_gap_s:g} s: the chain starts again here"
            )
        else:
            return frame
        self._restart_at(frame, str(error))
        raise error

    def _registered(self, reading: Frame, reference: Link, rng: np.random.Generator) -> _Found:
        """Register a scan.  Raises RegistrationError or ModelError when there is no answer."""
        T_init, guess = self._guess(reading, reference)
        is_looked_at = needs_shape(self.model, self.pipeline)
        clouds = (
            self._shaped(reading) if is_looked_at else reading.cloud,
            self._shaped(reference.frame),
        )
        estimator = estimator_of(self.model, self.pipeline, self.config)
        if guess == EXTERNAL:
            limit = self.config.max_external_offset
            registration, d = checked(*clouds, T_init, self.pipeline.icp, limit, rng)
            found = estimator.judge(*clouds, registration, rng)
            found = found._replace(covariance=found.covariance + np.outer(d, d))
            return _Found(found, GaussianPose(found.T_ref_read, found.covariance), guess, d)
        found = estimator.register(*clouds, T_init, rng)
        step = GaussianPose(found.T_ref_read, found.covariance)
        disagreement = ""
        if guess == ODOMETRY and self._pairing.knows_odometry:
            disagreement = self._disagreement(reading, reference, T_init, step)
        if self.config.planar:
            step = on_the_floor(step, T_init, reading.place.T_base_sensor)
        return _Found(found, step, guess, disagreement=disagreement)

    def _disagreement(
        self, reading: Frame, reference: Link, T_init: Array, step: GaussianPose
    ) -> str:
        """Return why odometry contradicts a registration, or ""; raise it unless published."""
        xi = log(inverse(T_init) @ step.T)
        P = step_covariance(reference.frame.place.Y_odom, reading.place.Y_odom, T_init)
        Y = np.zeros((6, 6)) if P is None else P + step.Y
        found = contradiction(xi, Y, self.config)
        if found and not self.config.publish_disagreeing:
            raise OdometryDisagreesError(found)
        self._alternation.add(xi)
        return found

    def _match(self, frame: Frame, rng: np.random.Generator) -> _Found | None:
        """Return what a scan is to the one that failed before it, or None."""
        try:
            return None if self._rival is None else self._registered(frame, self._rival, rng)
        except (RegistrationError, ModelError):
            return None

    def _guess(self, reading: Frame, reference: Link) -> tuple[Array, str]:
        """Return the first guess of T_ref_read and where it comes from."""
        T_odom_ref, T_odom_read = reference.frame.T_odom_sensor, reading.T_odom_sensor
        if T_odom_ref is not None and T_odom_read is not None:
            return inverse(T_odom_ref) @ T_odom_read, reading.place.guess
        T_init = inverse(reference.pose.T) @ self._chain.predicted(reading.stamp_ns)
        if self.config.planar and self._pairing.needs_chain:  # it does not leave its floor
            flat = GaussianPose(T_init, np.eye(6))
            T_init = on_the_floor(flat, _ORIGIN, reading.place.T_base_sensor).T
        return T_init, CONSTANT_VELOCITY

    def _with_motion(self, frame: Frame, found: _Found, reference: Link) -> _Found:
        """Return a registration with the motion since the scan before, where that is known.

        Where both have been registered to one scan it is the difference of the two, in which what
        they share cancels.  Where each scan is the next reference, the covariance holds for the
        sum of many, taken as independent, and is wider than that of one.
        """
        newest, before, step = self._chain.newest, self._before, found.step
        self._before = reference, step
        if newest is None or self._pairing.map_frame:
            return found
        if newest.frame is not reference.frame:
            if before is None or before[0] is not reference:
                return found
            step = between(before[1], step, REFERENCE_SHARE)
        elif self._pairing.adds_each_step and has_moved(found.estimate):
            step = GaussianPose(step.T, self.model.bias.inflation(step.T) * step.Y)
        span_s = 1e-9 * (frame.stamp_ns - newest.frame.stamp_ns)
        if not 0.0 < span_s <= self.config.max_pair_gap_s:
            return found
        if self.config.output_frame == "base":
            extrinsics = newest.frame.place.T_base_sensor, frame.place.T_base_sensor
            step = seen_from_base(*step, *extrinsics)
        return found._replace(motion=step, span_s=span_s)

    def _accept(self, frame: Frame, found: _Found, reference: Link, pose: Chained) -> None:
        """Take an answered scan into the chain, and as the next reference if it is one."""
        T_odom_ref = reference.frame.T_odom_sensor
        if frame.place.guess not in (ODOMETRY, EXTERNAL) and T_odom_ref is not None:
            frame = frame.at(T_odom_ref @ found.step.T)
        link = Link(frame, pose)
        self._chain.add(link)
        for scan in (frame, reference.frame):  # the first of a chain has not been undone yet
            scan.velocity = self._chain.velocity
        self._pairing.accept(link, found.estimate, self.config)
        self._rival, self.n_failures = None, 0

    def _published(
        self, frame: Frame, found: _Found, reference: Link, pose: GaussianPose
    ) -> Answer:
        """Return an answer in the frames in which it is published."""
        place, step, X_ref = frame.place, found.step, reference.frame.place.T_base_sensor
        child = place.base_frame if self.config.output_frame == "base" else place.sensor_frame
        frame_id, pose_frame_id = child, place.odom_frame
        if map_frame := self._pairing.map_frame:
            step, X_ref = GaussianPose(pose.T, step.Y), _ORIGIN
            frame_id = pose_frame_id = map_frame
        if self.config.output_frame == "base":
            step = seen_from_base(*step, X_ref, place.T_base_sensor)
            pose = seen_from_base(*pose, _ORIGIN, place.T_base_sensor)
        return Answer(
            stamp_ns=frame.stamp_ns,
            reference_ns=reference.frame.stamp_ns,
            estimate=found.estimate,
            step=step,
            pose=pose,
            frame_id=frame_id,
            pose_frame_id=pose_frame_id,
            child_frame_id=child,
            motion=found.motion,
            span_s=found.span_s,
            guess=found.guess,
            offset=found.offset,
            disagreement=found.disagreement,
        )

    def _fail(self, frame: Frame) -> None:
        self.n_failures += 1
        if self.n_failures >= self.config.max_failures:
            self._restart_at(frame, f"{self.n_failures} failures in a row")
            return
        self._pairing.fail(self._chain)
        if self._chain.is_at_first:
            self._rival = Link.first(frame, self._chain.predicted(frame.stamp_ns))

    def _restart_at(self, frame: Frame, reason: str) -> None:
        link = Link.first(frame, self._chain.predicted(frame.stamp_ns))
        self.reset(reason)
        if self._pairing.needs_chain:
            self._begin(link)

    def _begin(self, link: Link) -> None:
        self._chain.begin(link)
        self._pairing.begin(link)

    def _shaped(self, frame: Frame) -> Cloud:
        return frame.shaped(self.pipeline.cloud, _N_THREADS)


def estimator_of(model: Model, pipeline: Pipeline, config: NodeConfig) -> Estimator:
    """Return what registers pairs and judges them, by the settings of the node."""
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
    estimator = Estimator(model, config.covariance_mode, settings)
    estimator.pipeline = pipeline  # of which whoever chose it has warned
    return estimator


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
