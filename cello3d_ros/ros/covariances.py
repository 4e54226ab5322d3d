"""Covariances as ROS has them, bounded so that every one can be published.  Imports no ROS."""

from __future__ import annotations

import numpy as np

from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry.gaussian import symmetrized, to_fixed_axes
from cello3d_ros.geometry.se3 import Array

_CONDITION = 1e-13  # least ratio of eigenvalues that still is positive definite when rounded


class CovarianceError(Cello3dError):
    """A covariance cannot be published."""


def ros_covariance(
    Y: Array, R_header_read: Array, floor_sigma_m: float, floor_sigma_rad: float, ceiling: float
) -> Array:
    """Return the covariance of a PoseWithCovariance from a reading-side one.

    ``C = B Y B^T`` with ``B = blkdiag(R, R)``, to first order: of the additive error of the
    position and of the rotation about fixed axes, both along the axes of header.frame_id.
    Y: (6, 6), ordered (u, omega).  R_header_read: (3, 3).  Returns (6, 6) in m^2 and rad^2,
    exactly symmetric, positive definite, ``C - diag(floor_sigma_m^2, floor_sigma_rad^2)``
    positive semidefinite and no eigenvalue above ``ceiling``.  Raises CovarianceError for a Y
    that is not finite.
    """
    if np.shape(Y) != (6, 6) or not np.isfinite(Y).all():
        raise CovarianceError("the covariance is not finite")
    C = to_fixed_axes(R_header_read, Y)
    unit = np.repeat([floor_sigma_m, floor_sigma_rad], 3)
    unit2 = np.outer(unit, unit)
    C = unit2 * _clamped(C / unit2, 1.0, np.inf)
    largest = min(float(np.linalg.norm(C, 2)), ceiling)
    return _clamped(C, _CONDITION * largest, ceiling)


def _clamped(A: Array, low: float, high: float) -> Array:
    """Return a symmetric matrix with its eigenvalues moved into [low, high]."""
    values, vectors = np.linalg.eigh(A)
    if low <= values[0] and values[-1] <= high:
        return symmetrized(A)
    return symmetrized((vectors * np.clip(values, low, high)) @ vectors.T)
