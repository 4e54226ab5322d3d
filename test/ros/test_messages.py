"""Conversion of poses and covariances to messages, against Monte Carlo of the ROS convention."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cello3d_ros.errors import CovarianceError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError
from cello3d_ros.ros import messages

LIMITS = (1e-4, 1e-5, 900.0)


def random_covariance(rng: np.random.Generator, scale: float) -> np.ndarray:
    A = rng.normal(size=(6, 6)) * scale
    return A @ A.T


@pytest.mark.parametrize("seed", range(4))
def test_covariance_is_that_of_position_and_rotation_about_fixed_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6) * [5, 5, 5, 1, 1, 1])
    Y = random_covariance(rng, 3e-3)
    xi = rng.multivariate_normal(np.zeros(6), Y, size=100_000)
    noisy = T @ se3.exp(xi)
    position = noisy[:, :3, 3] - T[:3, 3]
    turn = Rotation.from_matrix(noisy[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    sampled = np.cov(np.hstack([position, turn]).T)
    C = messages.ros_covariance(Y, T[:3, :3], *LIMITS)
    sigma = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(
        C / np.outer(sigma, sigma), sampled / np.outer(sigma, sigma), atol=0.03
    )


def test_covariance_converts_back() -> None:
    rng = np.random.default_rng(5)
    R = se3.exp(rng.normal(size=6))[:3, :3]
    Y = random_covariance(rng, 0.01)
    C = messages.ros_covariance(Y, R, *LIMITS)
    np.testing.assert_allclose(messages.reading_covariance(C.reshape(36), R), Y, atol=1e-15)


@pytest.mark.parametrize(
    "Y",
    [
        np.zeros((6, 6)),
        np.diag([1e-30, 1.0, 1e9, 1e-30, 1.0, 1e9]),
        np.diag([-1.0, 1.0, 1.0, 1.0, 1.0, -1e-3]),
        np.full((6, 6), 1e3),
        np.outer(np.arange(6) - 2.5, np.arange(6) - 2.5) * 1e-4,
    ],
    ids=["zero", "extreme", "indefinite", "singular_large", "singular"],
)
@pytest.mark.parametrize("floors", [(1e-4, 1e-5), (1e-9, 1e-9), (1e-2, 1e-9)])
def test_what_is_published_is_symmetric_positive_definite_and_bounded(Y, floors) -> None:
    R = se3.exp([0, 0, 0, 0.3, -0.5, 1.0])[:3, :3]
    C = messages.ros_covariance(Y, R, *floors, 900.0)
    assert (C == C.T).all()
    values = np.linalg.eigvalsh(C)
    assert values[0] > 0.0
    assert values[-1] <= 900.0 * (1 + 1e-9)
    np.linalg.cholesky(C)


def test_floors_hold_in_every_direction_in_their_own_units() -> None:
    Y = np.zeros((6, 6))
    Y[0, 0] = 1.0
    C = messages.ros_covariance(Y, np.eye(3), 1e-3, 1e-5, 900.0)
    np.testing.assert_allclose(np.diag(C), [1.0, 1e-6, 1e-6, 1e-10, 1e-10, 1e-10], rtol=1e-3)


def test_a_covariance_within_the_bounds_is_only_turned() -> None:
    Y = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    quarter = se3.exp([0, 0, 0, 0, 0, np.pi / 2])[:3, :3]
    C = messages.ros_covariance(Y, quarter, *LIMITS)
    np.testing.assert_allclose(np.diag(C), [2.0, 1.0, 3.0, 0.2, 0.1, 0.3], atol=1e-12)


def test_a_covariance_that_is_not_finite_is_refused() -> None:
    Y = np.eye(6)
    Y[2, 3] = np.nan
    with pytest.raises(CovarianceError, match="not finite"):
        messages.ros_covariance(Y, np.eye(3), *LIMITS)
    with pytest.raises(CovarianceError, match="not finite"):
        messages.pose_with_covariance(0, "lidar", np.eye(4), Y)


def test_a_pose_survives_the_message() -> None:
    T = se3.exp([1.0, -2.0, 3.0, 0.4, -0.5, 2.6])
    message = messages.odometry_to(1_500_000_000, "odom", "lidar", T)
    assert messages.stamp_ns_of(message) == 1_500_000_000
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "lidar")
    np.testing.assert_allclose(messages.pose_from(message.pose.pose), T, atol=1e-12)


def test_the_empty_pose_of_a_message_is_valid_and_a_zero_quaternion_is_not() -> None:
    message = messages.odometry_to(0, "odom", "lidar", np.eye(4))
    message.pose.pose.orientation.w = 0.0
    with pytest.raises(PoseError, match="zero"):
        messages.pose_from(message.pose.pose)


def test_covariance_cells_are_row_major_doubles() -> None:
    C = np.arange(36.0).reshape(6, 6)
    message = messages.pose_with_covariance(1, "lidar", np.eye(4), C)
    assert message.pose.covariance.dtype == np.float64
    np.testing.assert_array_equal(message.pose.covariance, np.arange(36.0))
