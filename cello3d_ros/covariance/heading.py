"""The motion frame: the reading's axes turned about z so that x lies along the motion.

The bias of ICP lies along the motion, so covariances of robots that look ahead, aside or back
compare when x is the horizontal motion of the sensor.  Where it hardly moves there is no such
direction: what is known of the motion frame then is its mean over all turns about z.  Between the
two the share of the former is ``a = m^2 / (m^2 + s^2)``, m the motion and s = 0.03 m, so an answer
turns with the sensor and is continuous in the motion.
"""

from __future__ import annotations

import numpy as np

from cello3d_ros.geometry.gaussian import symmetrized
from cello3d_ros.geometry.se3 import Array

FRAMES = ("motion", "sensor")  # in which a model holds covariances
_SCALE_M = 0.03


def motion_of(T_ref_read: Array) -> Array:
    """Return the horizontal motion of the sensor along its own axes x and y, m.  (..., 2).

    T_ref_read: (..., 4, 4).  It is that from the reference to the reading, seen in the reading.
    """
    R, t = T_ref_read[..., :3, :3], T_ref_read[..., :3, 3]
    return np.asarray(np.einsum("...ji,...j->...i", R, t)[..., :2])


def into_motion(Y: Array, motion: Array) -> Array:
    """Return covariances (..., 6, 6) of the reading's axes along those of the motion (..., 2)."""
    return _turned(Y, -np.arctan2(motion[..., 1], motion[..., 0]))


def out_of_motion(Y: Array, motion: Array) -> Array:
    """Return covariances (..., 6, 6) of the motion frame along the axes of the reading."""
    return _turned(Y, np.arctan2(motion[..., 1], motion[..., 0]))


def blended(Y: Array, motion: Array) -> Array:
    """Return ``a Y + (1 - a) mean of Y over all turns about z``: as far as the motion has a frame.

    Y: (..., 6, 6), of the motion frame or of the sensor; motion: (..., 2).  Symmetric in Y, so
    that it is its own adjoint: ``tr(A blended(B)) = tr(blended(A) B)``.
    """
    m2 = np.einsum("...i,...i->...", motion, motion)
    a = (m2 / (m2 + _SCALE_M**2))[..., None, None]
    return symmetrized(a * Y + (1.0 - a) * mean_of_turns(Y))


def mean_of_turns(Y: Array) -> Array:
    """Return the mean of ``Ad_R Y Ad_R^T`` over all turns R about z.  (..., 6, 6)."""
    mean = np.zeros(np.shape(Y))
    for rows in (slice(0, 3), slice(3, 6)):
        for columns in (slice(0, 3), slice(3, 6)):
            B, M = Y[..., rows, columns], mean[..., rows, columns]
            M[..., 0, 0] = M[..., 1, 1] = 0.5 * (B[..., 0, 0] + B[..., 1, 1])
            M[..., 0, 1] = 0.5 * (B[..., 0, 1] - B[..., 1, 0])
            M[..., 1, 0] = -M[..., 0, 1]
            M[..., 2, 2] = B[..., 2, 2]
    return mean


def _turned(Y: Array, angle_rad: Array) -> Array:
    """Return ``Ad_R Y Ad_R^T``, R the turns about z by (...).  (..., 6, 6)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    A = np.zeros((*np.shape(angle_rad), 6, 6))
    for k in (0, 3):
        A[..., k, k] = A[..., k + 1, k + 1] = c
        A[..., k, k + 1], A[..., k + 1, k] = -s, s
        A[..., k + 2, k + 2] = 1.0
    return symmetrized(A @ Y @ np.swapaxes(A, -1, -2))
