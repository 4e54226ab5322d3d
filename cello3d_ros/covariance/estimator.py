"""The online composition: two clouds and a first guess in, a pose and its covariance out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.lost import covering, is_lost
from cello3d_ros.covariance.methods import (
    ASK_MODEL,
    DEFAULTS,
    METHODS,
    MethodSettings,
    Pair,
    predicted,
    widened,
)
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import ModelError, RegistrationError
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
    method: str = "model"
    novelty: float = 0.0
    is_unknown: bool = False
    is_lost: bool = False


def estimate(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    model: Model,
    pipeline: Pipeline,
    rng: np.random.Generator,
    method: str = "model",
    settings: MethodSettings = DEFAULTS,
    registration: Registration | None = None,
) -> Estimate:
    """Register two clouds and find the covariance of the result.

    reading: its local shape is looked at only where ``needs_shape`` says so; T_init: (4, 4), the
    first guess of T_ref_read.  method: a name of ``METHODS``.  registration: the result of whoever
    registered the clouds (``registered_elsewhere``); ICP is then not run and T_init not looked at.
    A registration that reached its last iteration is returned with ``converged`` False: its
    covariance says little.  Raises RegistrationError when ICP or the method has no answer,
    NoOverlapError when the clouds share too little and ModelError when the model looks at the
    descriptor and the grid is not the model's.
    """
    if _looks_at_descriptor(model) and pipeline.grid != model.pipeline.grid:
        raise ModelError(f"the model was trained with {model.pipeline.grid}, not {pipeline.grid}")
    if registration is None:
        registration = register(reading, reference, T_init, pipeline.icp, rng)
    if not registration.has_answer:
        raise RegistrationError(f"ICP has no answer: {registration.reason.replace('_', ' ')}")
    T_ref_read = registration.T_ref_read
    n_rotations = 1 if _looks_at_descriptor(model) else 0
    description = describe(
        reading, reference, T_ref_read, pipeline, n_rotations, settings.n_threads
    )
    pair = Pair(reading, reference, registration, description)
    prediction = predicted(pair, model)
    if method == "model":
        Y = widened(prediction, pair, pipeline, model, rng, settings)
    else:
        Y = METHODS[method](pair, pipeline, model, rng, settings)
    lost = is_lost(description.shapes["sandwich"], model.lost)
    if model.lost is not None and lost and method in ASK_MODEL:
        Y = covering(Y, model.lost)
    return Estimate(
        registration,
        description.overlap_ratio,
        settings.scale * Y,
        prediction.nearest_rho,
        prediction.effective_neighbors,
        method,
        prediction.novelty,
        prediction.novelty > settings.unknown_quantile,
        lost,
    )


def needs_shape(model: Model, pipeline: Pipeline) -> bool:
    """Return whether ``estimate`` looks at the local shape of the reading, too.

    The descriptor does, and so do other backends than this package's ICP.
    """
    return _looks_at_descriptor(model) or pipeline.icp.backend != "icp"


def registered_elsewhere(T_ref_read: Array) -> Registration:
    """Return a pose that another program found as a registration of which no more is known."""
    return Registration(np.array(T_ref_read, np.float64, order="C"), 0, True, "", float("nan"), 0)


def _looks_at_descriptor(model: Model) -> bool:
    return model.features != "global"
