"""Every way to the covariance of a registration behind one interface, by name.

A method takes a ``Pair``, which was described once for all of them, and returns a (6, 6) positive
definite covariance of its registration, reading side, ordered (u, omega).  The model's
``sampling`` says how starts scatter.  RegistrationError or ModelError: a method has no answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.closed_form import censi
from cello3d_ros.covariance.description import Description
from cello3d_ros.covariance.features import model_inputs
from cello3d_ros.covariance.fused import fused, monte_carlo, registrations
from cello3d_ros.covariance.model import Model, Prediction, predict
from cello3d_ros.covariance.sigma_points import sigma_points
from cello3d_ros.errors import ModelError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite, larger, matrix_sqrt, symmetrized
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.icp import Registration


class Pair(NamedTuple):
    """Two clouds, how they were registered, and the description of that."""

    reading: Cloud
    reference: Cloud
    registration: Registration
    description: Description


class MethodSettings(NamedTuple):
    """What methods assume and what is made of their answers.

    sigma_m: deviation of the sensor's noise along each axis; n_registrations: extra runs of ICP
    by ``monte_carlo`` and ``fused``; unknown_quantile: the ``novelty`` beyond which a pair is
    unlike all examples; widen_unknown: whether the model's prediction is then widened to their
    mean; scale: what ``estimate`` multiplies every covariance by; n_threads changes no result.
    """

    sigma_m: float = 0.01
    n_registrations: int = 12
    unknown_quantile: float = 1.0
    widen_unknown: bool = False
    scale: float = 1.0
    n_threads: int = 1


Method = Callable[[Pair, Pipeline, Model, np.random.Generator, MethodSettings], Array]


def extra_runs(name: str, settings: MethodSettings) -> int:
    """Return how many runs of ICP a method adds to the registration that it judges."""
    n = settings.n_registrations
    return {"sigma_points": 12, "monte_carlo": n, "fused": n}.get(name, 0)


def by_model(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the model's prediction, wider where the settings say so."""
    return widened(predicted(pair, model), pair, pipeline, model, rng, settings)


def by_constant(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the mean of the model's examples, relative to the pair's shape as they are."""
    mean = mean_example(model)
    if model.shape == "none":
        return mean
    root = matrix_sqrt(pair.description.shapes[model.shape])
    return symmetrized(root @ mean @ root)


def by_hessian(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``sigma^2 H^-1``."""
    return settings.sigma_m**2 * pair.description.shapes["hessian"]


def by_sandwich(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``H^-1 (sum g g^T) H^-1``."""
    return pair.description.shapes["sandwich"]


def by_censi(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``censi`` of ``closed_form``."""
    found = pair.description.overlap
    T_hat = pair.registration.T_ref_read
    return censi(
        *(pair.reading, pair.reference, T_hat),
        *(found.distances2, found.indices),
        pipeline.icp,
        settings.sigma_m,
    )


def by_sigma_points(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``sigma_points`` for starts that scatter like those of the training."""
    prior = model.sampling.variance * np.eye(6)
    return sigma_points(
        *(pair.reading, pair.reference, pair.registration.T_ref_read),
        pair.description.overlap,
        pair.description.shapes["hessian"],
        pipeline,
        prior,
        settings.sigma_m,
        rng,
        settings.n_threads,
    )


def by_monte_carlo(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the covariance of a few registrations."""
    xi = _online(pair, pipeline, model, rng, settings)
    if not is_positive_definite(Y := monte_carlo(xi)):
        raise RegistrationError(f"the covariance of {len(xi)} registrations is singular")
    return Y


def by_fusion(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the answer of ``by_model``, updated by a few registrations."""
    F = by_model(pair, pipeline, model, rng, settings)
    return fused(F, _online(pair, pipeline, model, rng, settings))


DEFAULTS = MethodSettings()

#: Methods by name.
METHODS: dict[str, Method] = {
    "model": by_model,
    "constant": by_constant,
    "hessian": by_hessian,
    "sandwich": by_sandwich,
    "censi": by_censi,
    "sigma_points": by_sigma_points,
    "monte_carlo": by_monte_carlo,
    "fused": by_fusion,
}
ASK_MODEL = ("model", "fused")  # methods that answer with the model's prediction


def mean_example(model: Model) -> Array:
    """Return the mean of the examples as recorded, without their copies turned about z.  (6, 6).

    The turns of a pair stand side by side, in the order of the provenance's ``rotations_rad``.
    """
    turns = model.provenance.get("rotations_rad", [0.0])
    if 0.0 not in turns or model.n_examples % len(turns):
        raise ModelError(f"the model's {model.n_examples} examples are not turns by {turns}")
    return symmetrized(model.covariances[turns.index(0.0) :: len(turns)].mean(axis=0))


def predicted(pair: Pair, model: Model) -> Prediction:
    """Return the model's answer with the evidence for it."""
    found = pair.description
    inputs = model_inputs(model.features, found.descriptors, found.features)
    return predict(model, inputs[0], found.shapes.get(model.shape))


def widened(
    prediction: Prediction,
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return a prediction's covariance; of a pair unlike all examples, if asked for, the larger.

    That is the larger of it and the mean of the examples (``by_constant``).
    """
    if not settings.widen_unknown or prediction.novelty <= settings.unknown_quantile:
        return prediction.covariance
    prior = by_constant(pair, pipeline, model, rng, settings)
    return larger(prior, prediction.covariance)


def _online(
    pair: Pair,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the errors of a few registrations about the pair's own.  (at most n, 6)."""
    return registrations(
        *(pair.reading, pair.reference, pair.registration.T_ref_read),
        pipeline,
        model.sampling,
        settings.n_registrations,
        rng,
        settings.n_threads,
    )
