"""A robot that stays on its floor: z, roll and pitch by odometry.  Imports no ROS."""

from __future__ import annotations

import numpy as np

from cello3d_ros.geometry.gaussian import GaussianPose, to_left
from cello3d_ros.geometry.se3 import Array, exp, inverse, log

SIGMA_M, SIGMA_RAD = 0.005, 0.005  # of z, and of roll and pitch, between two scans: a real floor

_FLAT = [2, 3, 4]  # z, and rotations about x and y
_FREE = [0, 1, 5]


def on_the_floor(step: GaussianPose, T_odometry: Array, T_base_read: Array) -> GaussianPose:
    """Return a registration with z, roll and pitch of the base as odometry has them.

    With X = T_base_read, the registration is ``T_odometry X^-1 exp(xi) X``, xi along the axes of
    the base at the reading.  x, y and yaw of xi stay, with their covariance; the others are 0,
    with standard deviations of 5 mm and 5 mrad, which do not depend on those.
    step: at the sensor, right covariance, and so is the result; T_odometry: (4, 4), the same pose
    by odometry; T_base_read: (4, 4).
    """
    X = T_base_read
    xi = log(X @ inverse(T_odometry) @ step.T @ inverse(X))
    xi[_FLAT] = 0.0
    Y = np.zeros((6, 6))
    Y[np.ix_(_FREE, _FREE)] = to_left(X, step.Y)[np.ix_(_FREE, _FREE)]
    Y[_FLAT, _FLAT] = [SIGMA_M**2, SIGMA_RAD**2, SIGMA_RAD**2]
    return GaussianPose(T_odometry @ inverse(X) @ exp(xi) @ X, to_left(inverse(X), Y))
