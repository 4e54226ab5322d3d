"""A few online registrations: alone (Monte Carlo), or with the model as their prior (fused)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.covariance.case import Case
from cello3d_ros.covariance.sigma_points import registered_from
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.gaussian import sampled_covariance, symmetrized
from cello3d_ros.geometry.se3 import Array

PRIOR_WEIGHT = 40.0  # nu: registrations that the model is worth; chosen on validation recordings
FEWEST = 8  # registrations below which six dimensions have no covariance to speak of


def registrations(case: Case) -> Array:
    """Return xi about T_hat of a few registrations that ended where T_hat is.  (at most n, 6).

    n is the settings' ``n_registrations``.  Starts are ``T_hat exp(xi)``, xi ~ N(0, a I), a the
    variance of the model's sampling.  Those in another minimum are no errors of this one: kept is
    what steps of at most one clustering radius connect to T_hat.
    """
    sampling, n = case.model.sampling, case.settings.n_registrations
    xi = registered_from(case, case.rng.normal(scale=np.sqrt(sampling.variance), size=(n, 6)))
    return xi[connected(xi, sampling.cluster_scale_m, sampling.cluster_scale_rad)]


def connected(xi: Array, scale_m: float, scale_rad: float) -> NDArray[np.bool_]:
    """Return which of (n, 6) are linked to zero by steps of at most one scale.  (n,)."""
    scaled = np.concatenate([np.zeros((1, 6)), xi / np.repeat([scale_m, scale_rad], 3)])
    near = np.linalg.norm(scaled[:, None] - scaled, axis=2) <= 1.0
    reached = near[0]
    for _ in xi:
        reached = near[reached].any(axis=0)
    return np.asarray(reached[1:])


def monte_carlo(xi: Array) -> Array:
    """Return the covariance of registrations about their mean.  (n, 6) -> (6, 6)."""
    if len(xi) < FEWEST:
        raise RegistrationError(
            f"{len(xi)} registrations agree with the reported one, a covariance needs {FEWEST}"
        )
    return sampled_covariance(xi, xi.mean(axis=0))


def fused(F: Array, xi: Array, prior_weight: float = PRIOR_WEIGHT) -> Array:
    """Return ``(nu F + sum (xi - m)(xi - m)^T) / (nu + n)``, F the model's answer.  (6, 6).

    xi: (n, 6), about the reported registration; m is their median, axis by axis: a robot has no
    ground truth to centre on, and a few stragglers do not move it.  n = 0 gives F.
    """
    if len(xi) == 0:
        return F
    centred = xi - np.median(xi, axis=0)
    return symmetrized((prior_weight * F + centred.T @ centred) / (prior_weight + len(xi)))
