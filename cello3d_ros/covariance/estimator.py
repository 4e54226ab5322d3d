"""The online composition: two clouds and a first guess in, a pose and its covariance out."""

from __future__ import annotations

import functools
import logging
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.clouds.shape import Cloud, filtered, with_shape
from cello3d_ros.config import Pipeline, pipeline_warning
from cello3d_ros.covariance.case import DEFAULTS, Case, MethodSettings
from cello3d_ros.covariance.closed_form import free_error
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.lost import covering, is_lost
from cello3d_ros.covariance.methods import ASK_MODEL, METHODS, predicted, widened
from cello3d_ros.covariance.model import Model, load_model
from cello3d_ros.errors import (
    CloudError,
    ConfigError,
    CovarianceError,
    ModelError,
    NotConvergedError,
    RegistrationError,
)
from cello3d_ros.geometry.gaussian import bounded, rotation_first, to_fixed_axes
from cello3d_ros.geometry.se3 import Array, is_rigid
from cello3d_ros.registration.backends import register
from cello3d_ros.registration.icp import Registration


class Trust(NamedTuple):
    """How far an estimate is to be trusted.

    converged: whether ICP settled; overlap: share of the reading's points that overlap; novelty:
    in [0, 1], share of the training pairs that were nearer to the other examples; is_unknown: the
    pair is unlike all examples; is_lost: ICP probably ended in a wrong minimum; sentence: all of
    it in words.
    """

    converged: bool
    overlap: float
    novelty: float
    is_unknown: bool
    is_lost: bool
    sentence: str


class Estimate(NamedTuple):
    """A registration and its covariance.

    covariance: (6, 6), of xi in ``T_ref_read exp(xi)``, i.e. along the axes of the reading,
    ordered (u, omega): translation first; m^2, m rad, rad^2.  method: what said so.  nearest_rho:
    squared distance of the model's nearest training example; effective_neighbors: how many
    examples share in the model's answer; novelty, is_unknown, is_lost: see ``Trust``.  A
    registration that is probably lost has, by methods that ask the model, a covariance that covers
    the scatter of such registrations.
    """

    registration: Registration
    overlap_ratio: float
    covariance: Array
    nearest_rho: float
    effective_neighbors: float
    method: str = "cello3d"
    novelty: float = 0.0
    is_unknown: bool = False
    is_lost: bool = False

    @property
    def T_ref_read(self) -> Array:
        """The pose of the reading in the reference, ``p_ref = T_ref_read p_read``.  (4, 4)."""
        return self.registration.T_ref_read

    def covariance_ros(self) -> Array:
        """Return the covariance of a geometry_msgs/PoseWithCovariance.  (6, 6).

        Position (x, y, z), then rotation about x, y, z; errors along and about the fixed axes of
        the reference: ``p = p_mean + dp``, ``R = exp(dtheta) R_mean``.
        """
        return to_fixed_axes(self.T_ref_read[:3, :3], self.covariance)

    def covariance_gtsam(self) -> Array:
        """Return the covariance of a gtsam.Pose3 between the reference and the reading.  (6, 6).

        GTSAM perturbs on the same side, ``T exp(xi)``, with the rotation first.
        """
        return rotation_first(self.covariance)

    @property
    def trust(self) -> Trust:
        """How far to trust this estimate."""
        found = self.registration.converged, self.overlap_ratio, self.novelty
        return Trust(*found, self.is_unknown, self.is_lost, _sentence(self))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers under the names that they have here; matrices row by row."""
        registration = self.registration._asdict()
        return {
            "T_ref_read": self.T_ref_read.ravel().tolist(),
            "covariance": self.covariance.ravel().tolist(),
            "covariance_ros": self.covariance_ros().ravel().tolist(),
            "covariance_gtsam": self.covariance_gtsam().ravel().tolist(),
            "trust": self.trust._asdict(),
            "method": self.method,
            "nearest_rho": self.nearest_rho,
            "effective_neighbors": self.effective_neighbors,
            "registration": {
                name: registration[name]
                for name in ("n_iterations", "residual_rms_m", "n_associations")
            },
        }


class Estimator:
    """Registers pairs of scans and finds the covariance of each result.

    Call it with two arrays of points, (N, 3) and (M, 3), metres, each in the frame of its sensor,
    and the first guess of T_ref_read, (4, 4); it returns an ``Estimate``.

    >>> rng = np.random.default_rng(0)
    >>> room = rng.uniform(-4.0, 4.0, (6000, 3))
    >>> room[np.arange(6000), rng.integers(3, size=6000)] = rng.choice([-4.0, 4.0], 6000)
    >>> reference, reading = room[::2], room[1::2] - [0.1, 0.0, 0.0]
    >>> r = Estimator("general")(reading, reference, np.eye(4))
    >>> bool(np.abs(r.T_ref_read[:3, 3] - [0.1, 0.0, 0.0]).max() < 0.02)
    True
    >>> r.covariance.shape, r.covariance_ros().shape, r.covariance_gtsam().shape
    ((6, 6), (6, 6), (6, 6))
    >>> r.trust.converged, r.trust.is_lost
    (True, False)
    """

    def __init__(
        self,
        model: Model | Path | str = "general",
        method: str = "cello3d",
        settings: MethodSettings = DEFAULTS,
        pipeline: Pipeline | None = None,
    ) -> None:
        """Keep what every pair is judged by.

        model: also a file or a shipped model's name; method: a name of ``METHODS``; pipeline: the
        model's, unless another is given, of which a warning is logged.  Raises ModelError,
        ConfigError.
        """
        if method not in METHODS:
            raise ConfigError(f"method must be one of {', '.join(METHODS)}: {method!r}")
        self.model = model if isinstance(model, Model) else load_model(model)
        self.method, self.settings = method, settings
        self.pipeline = self.model.pipeline if pipeline is None else pipeline
        if warning := pipeline_warning(self.model.pipeline, self.pipeline):
            _warn_once(warning)

    def __call__(
        self,
        reading: ArrayLike,
        reference: ArrayLike,
        T_init: ArrayLike | None = None,
        seed: int = 0,
    ) -> Estimate:
        """Register two scans and return the pose of the reading with its covariance.

        reading, reference: (N, 3) and (M, 3), metres, each in the frame of its sensor; rows that
        are not finite are left out.  T_init: (4, 4), the first guess of T_ref_read, by default
        identity.  seed: of the random subsamples, which follow from it and the points alone.
        Raises CloudError for too few points and what ``register`` raises.
        """
        T = np.eye(4) if T_init is None else np.asarray(T_init, np.float64)
        if T.shape != (4, 4) or not is_rigid(T):
            raise RegistrationError("T_init is not a rigid transform (4, 4)")
        P, Q = _points(reading, "reading"), _points(reference, "reference")
        rng = draws(P, seed)
        read = self._cloud(P, "reading", rng, needs_shape(self.model, self.pipeline))
        ref = self._cloud(Q, "reference", draws(Q, seed), True)
        return self.register(read, ref, T, rng)

    def register(
        self, reading: Cloud, reference: Cloud, T_init: Array, rng: np.random.Generator
    ) -> Estimate:
        """Register two prepared clouds from the first guess T_init of T_ref_read (4, 4).

        Raises what ``judge`` raises.
        """
        icp, n_threads = self.pipeline.icp, self.settings.n_threads
        registration = register(reading, reference, T_init, icp, rng, n_threads)
        return self.judge(reading, reference, registration, rng)

    def judge(
        self,
        reading: Cloud,
        reference: Cloud,
        registration: Registration,
        rng: np.random.Generator,
    ) -> Estimate:
        """Return a registration, perhaps ``registered_elsewhere``, with its covariance.

        The local shape of the reading is looked at only where ``needs_shape`` says so.  Raises
        RegistrationError when ICP or the method has no answer, NoOverlapError when the clouds
        share too little, NotConvergedError when ICP reached its last iteration, and ModelError
        when the model looks at the descriptor and the grid is not the model's.
        """
        case = self._case(reading, reference, registration, rng)
        prediction, settings, model = predicted(case), self.settings, self.model
        Y = widened(prediction, case) if self.method == "cello3d" else METHODS[self.method](case)
        lost = is_lost(case.description.shapes["sandwich"], model.lost)
        if model.lost is not None and lost and self.method in ASK_MODEL:
            Y = covering(Y, model.lost)
        if not np.isfinite(Y).all():
            raise CovarianceError("the covariance is not finite")
        floors = settings.floor_sigma_m, settings.floor_sigma_rad
        return Estimate(
            registration,
            case.description.overlap_ratio,
            bounded(settings.scale * Y, *floors, settings.ceiling),
            prediction.nearest_rho,
            prediction.effective_neighbors,
            self.method,
            prediction.novelty,
            prediction.novelty > settings.unknown_quantile,
            lost,
        )

    def _cloud(
        self, points: Array, what: str, rng: np.random.Generator, with_its_shape: bool
    ) -> Cloud:
        """Return a scan after the filters.  Raises CloudError that says which one it is."""
        config, n_threads = self.pipeline.cloud, self.settings.n_threads
        try:
            cloud = filtered(points, config, rng)
        except CloudError as error:
            raise CloudError(f"the {what}: {error}") from None
        return with_shape(cloud, config, n_threads) if with_its_shape else cloud

    def _case(
        self,
        reading: Cloud,
        reference: Cloud,
        registration: Registration,
        rng: np.random.Generator,
    ) -> Case:
        """Return a registration, described.  Raises what ``judge`` raises."""
        model, pipeline = self.model, self.pipeline
        if _looks_at_descriptor(model) and pipeline.grid != model.pipeline.grid:
            raise ModelError(
                f"the model was trained with {model.pipeline.grid}, not {pipeline.grid}"
            )
        if not registration.has_answer:
            reason = registration.reason.replace("_", " ")
            raise RegistrationError(f"ICP has no answer: {reason}")
        description = describe(
            *(reading, reference, registration.T_ref_read, pipeline),
            n_rotations=1 if _looks_at_descriptor(model) else 0,
            n_threads=self.settings.n_threads,
        )
        if description.free:
            raise free_error(description.free)
        if not registration.converged:
            raise NotConvergedError(
                f"ICP did not converge in {registration.n_iterations} iterations: start it nearer "
                "to the truth or allow more (icp.max_iterations)"
            )
        return Case(
            reading, reference, registration, description, pipeline, model, rng, self.settings
        )


def draws(points: Array, seed: int) -> np.random.Generator:
    """Return the generator of the random draws for a scan: they follow from its points and a seed.

    So the same two scans have the same answer wherever they are asked about.
    """
    return np.random.default_rng([seed, zlib.crc32(np.ascontiguousarray(points).data)])


def needs_shape(model: Model, pipeline: Pipeline) -> bool:
    """Return whether an estimate looks at the local shape of the reading, too.

    The descriptor does, and so do other backends than this package's ICP.
    """
    return _looks_at_descriptor(model) or pipeline.icp.backend != "icp"


def registered_elsewhere(T_ref_read: Array) -> Registration:
    """Return a pose that another program found as a registration of which no more is known."""
    return Registration(np.array(T_ref_read, np.float64, order="C"), 0, True, "", float("nan"), 0)


@functools.cache
def _warn_once(sentence: str) -> None:
    logging.getLogger("cello3d_ros").warning(sentence)


def _looks_at_descriptor(model: Model) -> bool:
    return model.features != "global"


def _points(points: ArrayLike, what: str) -> Array:
    """Return the finite rows of an (N, 3) array.  Raises CloudError."""
    try:
        found = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise CloudError(f"the {what} is not an array of numbers") from None
    if found.ndim != 2 or found.shape[1] != 3:
        raise CloudError(f"the {what} has shape {found.shape}, expected (N, 3)")
    return found[np.isfinite(found).all(axis=1)]


def _sentence(estimate: Estimate) -> str:
    if estimate.is_lost:
        return "ICP probably ended in a wrong minimum: do not rely on this pose."
    if estimate.is_unknown:
        return "The pair is unlike the training data: the covariance is less certain than usual."
    return "The pair is like the training data: trust the pose as far as its covariance says."
