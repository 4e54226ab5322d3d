"""The online composition: two clouds and a first guess in, a pose and its covariance out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.case import DEFAULTS, Case, MethodSettings
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.lost import covering, is_lost
from cello3d_ros.covariance.methods import ASK_MODEL, METHODS, predicted, widened
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import ModelError, NotConvergedError, RegistrationError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.backends import register
from cello3d_ros.registration.icp import Registration


class Estimate(NamedTuple):
    """A registration and what a method says of it.

    covariance: (6, 6), reading side, ordered (u, omega), by ``method``; nearest_rho: squared
    distance of the model's nearest training example; effective_neighbors: how many examples
    share in the model's answer; novelty: in [0, 1], how far from all of them beside the training
    pairs (``Prediction``); is_unknown: whether that is beyond the settings' quantile; is_lost:
    whether ICP probably ended in another minimum.  Then methods that ask the model give the
    scatter of such registrations (``covering``).
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


class Estimator:
    """Registers pairs of clouds and finds the covariance of each result."""

    def __init__(
        self,
        model: Model,
        method: str = "cello3d",
        settings: MethodSettings = DEFAULTS,
        pipeline: Pipeline | None = None,
    ) -> None:
        """Keep what every pair is judged by.

        method: a name of ``METHODS``; pipeline: the model's, unless another is given.
        """
        self.model, self.method, self.settings = model, method, settings
        self.pipeline = model.pipeline if pipeline is None else pipeline

    def register(
        self, reading: Cloud, reference: Cloud, T_init: Array, rng: np.random.Generator
    ) -> Estimate:
        """Register two clouds from the first guess T_init of T_ref_read (4, 4), and judge that."""
        registration = register(reading, reference, T_init, self.pipeline.icp, rng)
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
        RegistrationError when ICP or the method has no answer, NotConvergedError when ICP reached
        its last iteration, NoOverlapError when the clouds share too little, and ModelError when
        the model looks at the descriptor and the grid is not the model's.
        """
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
        if not registration.converged:
            raise NotConvergedError(
                f"ICP did not converge in {registration.n_iterations} iterations: start it nearer "
                "to the truth or allow more (icp.max_iterations)"
            )
        case = Case(
            reading, reference, registration, description, pipeline, model, rng, self.settings
        )
        prediction = predicted(case)
        Y = widened(prediction, case) if self.method == "cello3d" else METHODS[self.method](case)
        lost = is_lost(description.shapes["sandwich"], model.lost)
        if model.lost is not None and lost and self.method in ASK_MODEL:
            Y = covering(Y, model.lost)
        return Estimate(
            registration,
            description.overlap_ratio,
            self.settings.scale * Y,
            prediction.nearest_rho,
            prediction.effective_neighbors,
            self.method,
            prediction.novelty,
            prediction.novelty > self.settings.unknown_quantile,
            lost,
        )


def needs_shape(model: Model, pipeline: Pipeline) -> bool:
    """Return whether an estimate looks at the local shape of the reading, too.

    The descriptor does, and so do other backends than this package's ICP.
    """
    return _looks_at_descriptor(model) or pipeline.icp.backend != "icp"


def registered_elsewhere(T_ref_read: Array) -> Registration:
    """Return a pose that another program found as a registration of which no more is known."""
    return Registration(np.array(T_ref_read, np.float64, order="C"), 0, True, "", float("nan"), 0)


def _looks_at_descriptor(model: Model) -> bool:
    return model.features != "global"
