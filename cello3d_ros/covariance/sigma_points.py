"""Sigma points: what ICP makes of twelve chosen starts, and what sensor noise adds."""

from __future__ import annotations

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.closed_form import common_bias
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.gaussian import symmetrized
from cello3d_ros.geometry.se3 import Array, exp, inverse, log
from cello3d_ros.registration.backends import register_many
from cello3d_ros.registration.overlap import Overlap


def offsets(prior: Array) -> Array:
    """Return ``+-sqrt(6) chol(prior)_i``: of mean zero and covariance ``prior``.  (12, 6)."""
    columns = np.sqrt(6.0) * np.linalg.cholesky(prior).T
    return np.concatenate([columns, -columns])


def sigma_points(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    overlap: Overlap,
    inverse_H: Array,
    pipeline: Pipeline,
    prior: Array,
    sigma_m: float,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Array:
    """Return ``1/12 sum xi xi^T + sigma^2 (2 H^-1 + 2 b b^T)``.  (6, 6), reading side.

    xi = log(T_hat^-1 T_i), T_i the result of ICP started from ``T_hat exp(offset_i)``; overlap:
    the associations at T_hat; inverse_H: (6, 6), H^-1 as in ``closed_form``; prior: (6, 6),
    covariance of the starts; b as in ``common_bias``; starts without an answer are left out.  12
    runs of ICP, each with subsamples of its own; n_threads changes no result.
    Source: Brossard, Bonnabel, Barrau 2020.
    """
    xi = registered_from(reading, reference, T_hat, offsets(prior), pipeline, rng, n_threads)
    if len(xi) == 0:
        raise RegistrationError("ICP has no answer from any sigma point")
    added = sensor_term(reading, reference, T_hat, overlap, inverse_H, pipeline, sigma_m)
    return symmetrized(xi.T @ xi / len(xi) + added)


def sensor_term(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    overlap: Overlap,
    inverse_H: Array,
    pipeline: Pipeline,
    sigma_m: float,
) -> Array:
    """Return ``sigma^2 (2 H^-1 + 2 b b^T)``: independent noise and a common bias, two clouds."""
    found = (overlap.distances2, overlap.indices, pipeline.icp)
    b = common_bias(reading, reference, T_hat, *found)
    return np.asarray(2.0 * sigma_m**2 * (inverse_H + np.outer(b, b)))


def registered_from(
    reading: Cloud,
    reference: Cloud,
    T_hat: Array,
    starts: Array,
    pipeline: Pipeline,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Array:
    """Run ICP from ``T_hat exp(start)`` for each start (n, 6), with subsamples drawn anew.

    Returns ``log(T_hat^-1 T)`` of those with an answer.  (at most n, 6).
    """
    seeds = rng.integers(2**32, size=(len(starts), 4)).tolist()
    results = register_many(
        reading, reference, T_hat @ exp(starts), seeds, pipeline.icp, n_threads
    )
    answers = [r.T_ref_read for r in results if r.has_answer]
    return log(inverse(T_hat) @ np.array(answers).reshape(-1, 4, 4))
