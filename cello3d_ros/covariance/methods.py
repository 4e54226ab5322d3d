"""Every way to the covariance of a registration behind one interface, by name.

A method takes ``(reading, reference, T_hat, pipeline, model, rng, settings)`` and returns a (6, 6)
positive definite covariance, reading side, ordered (u, omega).  T_hat: (4, 4), the T_ref_read that
ICP reported.  The model's ``sampling`` says how starts scatter.  RegistrationError, NoOverlapError
or ModelError say that a method has no answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.closed_form import ClosedForm, censi, closed_form
from cello3d_ros.covariance.estimator import describe
from cello3d_ros.covariance.fused import fused, monte_carlo, registrations
from cello3d_ros.covariance.model import Model, predict
from cello3d_ros.covariance.sigma_points import sigma_points
from cello3d_ros.errors import ModelError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite, matrix_sqrt, symmetrized
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.overlap import find_overlap


class MethodSettings(NamedTuple):
    """What the baselines assume.

    sigma_m: deviation of the sensor's noise along each axis; n_registrations: extra runs of ICP
    by ``monte_carlo`` and ``fused``.
    """

    sigma_m: float = 0.01
    n_registrations: int = 12


Method = Callable[
    [Cloud, Cloud, Array, Pipeline, Model, np.random.Generator, MethodSettings], Array
]


def extra_runs(name: str, settings: MethodSettings) -> int:
    """Return how many runs of ICP a method adds to the registration that it judges."""
    n = settings.n_registrations
    return {"sigma_points": 12, "monte_carlo": n, "fused": n}.get(name, 0)


def by_model(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the model's prediction."""
    pair = describe(reading, reference, T_hat, pipeline)
    return predict(model, pair.descriptors[0], pair.shapes.get(model.shape)).covariance


def by_constant(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the mean of the model's examples, relative to the pair's shape as they are."""
    mean = mean_example(model)
    if model.shape == "none":
        return mean
    shape = getattr(_closed_form(reading, reference, T_hat, pipeline), model.shape)
    root = matrix_sqrt(shape)
    return symmetrized(root @ mean @ root)


def by_hessian(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``sigma^2 H^-1``."""
    return settings.sigma_m**2 * _closed_form(reading, reference, T_hat, pipeline).hessian


def by_sandwich(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``H^-1 (sum g g^T) H^-1``."""
    return _closed_form(reading, reference, T_hat, pipeline).sandwich


def by_censi(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``censi`` of ``closed_form``."""
    found = find_overlap(
        reading, reference, T_hat, pipeline.overlap.radius_m, pipeline.icp.n_neighbors
    )
    return censi(
        reading,
        reference,
        T_hat,
        found.distances2,
        found.indices,
        pipeline.icp,
        settings.sigma_m,
    )


def by_sigma_points(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return ``sigma_points`` for starts that scatter like those of the training."""
    prior = model.sampling.variance * np.eye(6)
    return sigma_points(reading, reference, T_hat, pipeline, prior, settings.sigma_m, rng)


def by_monte_carlo(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the covariance of a few registrations."""
    n = settings.n_registrations
    xi = registrations(reading, reference, T_hat, pipeline, model.sampling, n, rng)
    if not is_positive_definite(Y := monte_carlo(xi)):
        raise RegistrationError(f"the covariance of {len(xi)} registrations is singular")
    return Y


def by_fusion(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    pipeline: Pipeline,
    model: Model,
    rng: np.random.Generator,
    settings: MethodSettings,
) -> Array:
    """Return the model's prediction, updated by a few registrations."""
    F = by_model(reading, reference, T_hat, pipeline, model, rng, settings)
    n = settings.n_registrations
    return fused(F, registrations(reading, reference, T_hat, pipeline, model.sampling, n, rng))


#: Methods by name.
METHODS: dict[str, Method] = {
    "model": by_model,
    "constant_relative": by_constant,
    "hessian": by_hessian,
    "sandwich": by_sandwich,
    "censi": by_censi,
    "sigma_points": by_sigma_points,
    "monte_carlo": by_monte_carlo,
    "fused": by_fusion,
}


def mean_example(model: Model) -> Array:
    """Return the mean of the examples as recorded, without their copies turned about z.  (6, 6).

    The turns of a pair stand side by side, in the order of the provenance's ``rotations_rad``.
    """
    turns = model.provenance.get("rotations_rad", [0.0])
    if 0.0 not in turns or model.n_examples % len(turns):
        raise ModelError(f"the model's {model.n_examples} examples are not turns by {turns}")
    return symmetrized(model.covariances[turns.index(0.0) :: len(turns)].mean(axis=0))


def _closed_form(reading: Cloud, reference: Cloud, T_hat: Array, pipeline: Pipeline) -> ClosedForm:
    icp = pipeline.icp
    found = find_overlap(reading, reference, T_hat, pipeline.overlap.radius_m, icp.n_neighbors)
    return closed_form(reading, reference, T_hat, found.distances2, found.indices, icp)
