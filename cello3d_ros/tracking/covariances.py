"""Covariances as ROS has them, bounded so that every one can be published.  Imports no ROS."""

from __future__ import annotations

import numpy as np

from cello3d_ros.errors import CovarianceError
from cello3d_ros.geometry.gaussian import bounded, symmetrized, to_fixed_axes
from cello3d_ros.geometry.se3 import Array

N_SIGMA = 3.0  # of what is shown and judged

_HUGE = 1e12  # times the ceiling: beyond it a covariance is scaled down, so that nothing overflows


def ros_covariance(
    Y: Array, R_header_read: Array, floor_sigma_m: float, floor_sigma_rad: float, ceiling: float
) -> Array:
    """Return the covariance of a PoseWithCovariance from a reading-side one.

    ``C = B Y B^T`` with ``B = blkdiag(R, R)``, to first order: of the additive error of the
    position and of the rotation about fixed axes, both along the axes of header.frame_id.
    Y: (6, 6), ordered (u, omega).  R_header_read: (3, 3).  Returns (6, 6) in m^2 and rad^2 within
    the bounds of ``bounded``.  Raises CovarianceError for a Y that is not finite.
    """
    C = to_fixed_axes(R_header_read, _tamed(Y, ceiling))
    return bounded(C, floor_sigma_m, floor_sigma_rad, ceiling)


def twist_covariance(
    Y: Array, dt_s: float, floor_sigma_m: float, floor_sigma_rad: float, ceiling: float
) -> Array:
    """Return the covariance of a TwistWithCovariance from that of a step: ``Y / dt^2``.

    The twist is ``log(T_ref_read) / dt``, along the axes of the reading and constant over the
    step; to first order in the error and for a short step (times ``Jr^-1``, right Jacobian of the
    step, for a long one), so that ``dt^2`` times it is the covariance of the step again, which is
    what fuse makes of it.  Y: (6, 6), ordered (u, omega), reading side.  Returns (6, 6) in
    m^2/s^2 and rad^2/s^2 within the bounds of ``bounded``, whose floors are those of the pose
    over dt.  Raises CovarianceError for a Y that is not finite.
    """
    C = _tamed(_tamed(Y, ceiling * dt_s**2) / dt_s**2, ceiling)
    return bounded(C, floor_sigma_m / dt_s, floor_sigma_rad / dt_s, ceiling)


def principal_axes(C: Array) -> tuple[Array, Array]:
    """Return the standard deviations (3,) of a (3, 3) covariance, largest first, and their axes.

    The axes are the columns of a rotation (3, 3); the first points where its largest entry is
    positive, so that it does not flip from one answer to the next.
    """
    values, vectors = np.linalg.eigh(C)
    axes = vectors[:, ::-1].copy()
    axes *= np.sign(axes[np.abs(axes).argmax(axis=0), range(3)])
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes


def _tamed(Y: Array, ceiling: float) -> Array:
    """Return a finite Y, exactly symmetric and not so large that products of it overflow."""
    if np.shape(Y) != (6, 6) or not np.isfinite(Y).all():
        raise CovarianceError("the covariance is not finite")
    largest = float(np.abs(Y).max())
    scale = min(1.0, _HUGE * ceiling / largest) if largest > 0.0 else 1.0
    return symmetrized(np.asarray(Y, dtype=np.float64) * scale)
