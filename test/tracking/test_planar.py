"""A robot on a floor: z, roll and pitch by odometry."""

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import GaussianPose, mahalanobis, to_left
from cello3d_ros.tracking.planar import SIGMA_M, SIGMA_RAD, on_the_floor

MOTION = se3.exp([0.4, 0.05, 0, 0, 0, 0.2])
MOUNTS = [np.eye(4), se3.exp([0.3, -0.2, 1.1, 0.02, 0.4, 2.0])]


@pytest.mark.parametrize("X", MOUNTS)
def test_z_roll_and_pitch_are_those_of_odometry_and_the_rest_is_registered(X) -> None:
    T_odometry = se3.inverse(X) @ MOTION @ X
    xi = np.array([0.02, -0.03, 0.05, 0.01, -0.02, 0.015])
    T = se3.inverse(X) @ MOTION @ se3.exp(xi) @ X
    found = on_the_floor(GaussianPose(T, 1e-4 * np.eye(6)), T_odometry, X)
    left = se3.log(se3.inverse(MOTION) @ X @ found.T @ se3.inverse(X))
    np.testing.assert_allclose(left, [0.02, -0.03, 0, 0, 0, 0.015], atol=1e-12)
    at_base = np.diag(to_left(X, found.Y))
    np.testing.assert_allclose(at_base[[2, 3, 4]], [SIGMA_M**2, SIGMA_RAD**2, SIGMA_RAD**2])


@pytest.mark.parametrize("X", MOUNTS)
def test_the_covariance_is_honest_for_a_robot_on_a_floor(X) -> None:
    """Odometry errs in x, y and yaw; the floor is even to 5 mm; registration errs by Y."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.repeat([0.02, 0.004], 3)[:, None]
    Y = A @ A.T
    bumps = np.diag([0.0, 0.0, SIGMA_M, SIGMA_RAD, SIGMA_RAD, 0.0])
    drift = np.diag([0.05, 0.05, 0.0, 0.0, 0.0, 0.02])
    errors, covariances = [], []
    for _ in range(2000):
        true = se3.inverse(X) @ MOTION @ se3.exp(bumps @ rng.normal(size=6)) @ X
        odometry = se3.inverse(X) @ MOTION @ se3.exp(drift @ rng.normal(size=6)) @ X
        step = GaussianPose(true @ se3.exp(A @ rng.normal(size=6)), Y)
        found = on_the_floor(step, odometry, X)
        errors.append(se3.log(se3.inverse(true) @ found.T))
        covariances.append(found.Y)
    assert 0.9 < np.mean(mahalanobis(errors, covariances) ** 2) / 6 < 1.1
