"""Sigma points: what ICP makes of twelve chosen starts, and what sensor noise adds."""

from __future__ import annotations

import numpy as np

from cello3d_ros.covariance.case import Case
from cello3d_ros.covariance.closed_form import common_bias
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.gaussian import symmetrized
from cello3d_ros.geometry.se3 import Array, exp, inverse, log
from cello3d_ros.registration.backends import register_many


def offsets(prior: Array) -> Array:
    """Return ``+-sqrt(6) chol(prior)_i``: of mean zero and covariance ``prior``.  (12, 6)."""
    columns = np.sqrt(6.0) * np.linalg.cholesky(prior).T
    return np.concatenate([columns, -columns])


def sigma_points(case: Case) -> Array:
    """Return ``1/12 sum xi xi^T + sigma^2 (2 H^-1 + 2 b b^T)``.  (6, 6), reading side.

    xi = log(T_hat^-1 T_i), T_i the result of ICP started from ``T_hat exp(offset_i)``, offsets of
    the covariance of the starts in training; H as in ``closed_form``, b as in ``common_bias``.
    12 runs of ICP, each with subsamples of its own; starts without an answer are left out.
    Source: Brossard, Bonnabel, Barrau 2020.
    """
    xi = registered_from(case, offsets(case.model.sampling.variance * np.eye(6)))
    if len(xi) == 0:
        raise RegistrationError("ICP has no answer from any sigma point")
    return symmetrized(xi.T @ xi / len(xi) + sensor_term(case))


def sensor_term(case: Case) -> Array:
    """Return ``sigma^2 (2 H^-1 + 2 b b^T)``: independent noise and a common bias, two clouds."""
    found = case.description
    b = common_bias(case.reference, case.T_hat, found.overlap, case.pipeline.icp)
    inverse_H = found.shapes["hessian"]
    return np.asarray(2.0 * case.settings.sigma_m**2 * (inverse_H + np.outer(b, b)))


def registered_from(case: Case, starts: Array) -> Array:
    """Run ICP from ``T_hat exp(start)`` for each start (n, 6), with subsamples drawn anew.

    Returns ``log(T_hat^-1 T)`` of those with an answer.  (at most n, 6).
    """
    seeds = case.rng.integers(2**32, size=(len(starts), 4)).tolist()
    results = register_many(
        *(case.reading, case.reference, case.T_hat @ exp(starts), seeds),
        case.pipeline.icp,
        case.settings.n_threads,
    )
    answers = [r.T_ref_read for r in results if r.has_answer]
    return log(inverse(case.T_hat) @ np.array(answers).reshape(-1, 4, 4))
