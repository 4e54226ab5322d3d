"""SE(3): the laws of the group at ordinary and at edge angles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array

EDGE_ANGLES = (0.0, 1e-10, 1e-9, 1e-4, 9.999e-3, 1.0001e-2, 1.0, np.pi - 1e-3, np.pi - 1e-6)
angles = pytest.mark.parametrize("angle", EDGE_ANGLES)


def twists(angle: float, n: int = 50) -> Array:
    """Return twists of one angle about random axes.  (n, 6)."""
    rng = np.random.default_rng(7)
    axes = rng.standard_normal((n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([rng.uniform(-3, 3, (n, 3)), angle * axes], axis=1)


def matrix(xi: Array) -> Array:
    """Return the 4x4 matrix of the algebra for one twist."""
    out = np.zeros((4, 4))
    out[:3, :3] = se3.hat(xi[3:])
    out[:3, 3] = xi[:3]
    return out


def test_exp_of_a_quarter_turn_with_forward_motion_ends_on_the_circle() -> None:
    T = se3.exp([1, 0, 0, 0, 0, np.pi / 2])
    np.testing.assert_allclose(T[:3, 3], [2 / np.pi, 2 / np.pi, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(T[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], rtol=0, atol=1e-15)


@angles
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    for xi, T in zip(twists(angle, 10), se3.exp(twists(angle, 10)), strict=True):
        np.testing.assert_allclose(T, expm(matrix(xi)), rtol=0, atol=4e-15)


@angles
def test_log_undoes_exp(angle: float) -> None:
    # within 1e-6 of pi the two half-turns differ by rounding of the matrix alone
    tolerance = 1e-9 if angle <= np.pi - 1e-3 else 1e-8
    xi = twists(angle)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=0, atol=tolerance)


@angles
def test_exp_undoes_log(angle: float) -> None:
    T = se3.exp(twists(angle))
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, rtol=0, atol=1e-12)


def test_log_of_a_half_turn_has_angle_pi() -> None:
    T = np.diag([-1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(np.abs(se3.log(T)), [0, 0, 0, 0, 0, np.pi], rtol=0, atol=1e-12)


@angles
def test_adjoint_moves_a_perturbation_across_the_pose(angle: float) -> None:
    T = se3.exp(twists(angle))
    xi = twists(0.3)[::-1]
    moved = (se3.adjoint(T) @ xi[..., None])[..., 0]
    np.testing.assert_allclose(
        T @ se3.exp(xi) @ se3.inverse(T), se3.exp(moved), rtol=0, atol=1e-12
    )


@angles
def test_adjoint_and_inverse_are_homomorphisms(angle: float) -> None:
    T, U = se3.exp(twists(angle)), se3.exp(twists(0.7)[::-1])
    np.testing.assert_allclose(
        se3.adjoint(T @ U), se3.adjoint(T) @ se3.adjoint(U), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        se3.adjoint(se3.inverse(T)), np.linalg.inv(se3.adjoint(T)), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        se3.inverse(T @ U), se3.inverse(U) @ se3.inverse(T), rtol=0, atol=1e-12
    )


@angles
def test_exp_of_a_multiple_is_a_power(angle: float) -> None:
    xi = twists(angle)
    np.testing.assert_allclose(
        se3.exp(0.3 * xi) @ se3.exp(0.7 * xi), se3.exp(xi), rtol=0, atol=1e-13
    )


def test_hat_is_the_cross_product() -> None:
    a, b = np.random.default_rng(1).standard_normal((2, 20, 3))
    np.testing.assert_allclose(
        (se3.hat(a) @ b[..., None])[..., 0], np.cross(a, b), rtol=0, atol=1e-14
    )


def test_batches_of_any_rank_equal_one_at_a_time() -> None:
    xi = twists(1.2, 6).reshape(2, 3, 6)
    T = se3.exp(xi)
    assert T.shape == (2, 3, 4, 4)
    assert se3.log(T).shape == (2, 3, 6)
    for i, j in np.ndindex(2, 3):
        np.testing.assert_array_equal(T[i, j], se3.exp(xi[i, j]))
        np.testing.assert_allclose(se3.log(T)[i, j], se3.log(T[i, j]), rtol=0, atol=1e-15)
        np.testing.assert_array_equal(se3.adjoint(T)[i, j], se3.adjoint(T[i, j]))
        np.testing.assert_array_equal(se3.inverse(T)[i, j], se3.inverse(T[i, j]))


def test_transform_of_points_is_the_homogeneous_product() -> None:
    T = se3.exp(twists(1.0, 1)[0])
    points = np.random.default_rng(2).standard_normal((9, 3))
    expected = (T @ np.c_[points, np.ones(9)].T).T[:, :3]
    np.testing.assert_allclose(se3.transform(T, points), expected, rtol=0, atol=1e-14)


@angles
def test_pose_and_quaternion_undo_each_other(angle: float) -> None:
    T = se3.exp(twists(angle))
    q = se3.quaternion(T)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(se3.pose(T[:, :3, 3], q), T, rtol=0, atol=1e-12)


def test_quaternion_is_ordered_x_y_z_w() -> None:
    T = se3.exp([0, 0, 0, 0, 0, np.pi / 2])
    np.testing.assert_allclose(
        se3.quaternion(T), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], rtol=0, atol=1e-15
    )


@angles
def test_interpolation_starts_and_ends_at_its_poses(angle: float) -> None:
    T0 = se3.exp(twists(0.4, 1)[0])
    T1 = T0 @ se3.exp(twists(angle, 1)[0])
    np.testing.assert_allclose(se3.interpolate(T0, T1, 0.0), T0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(T0, T1, 1.0), T1, rtol=0, atol=1e-9)


@angles
def test_interpolation_turns_and_moves_at_a_constant_rate(angle: float) -> None:
    T0 = se3.exp(twists(0.4, 1)[0])
    T1 = T0 @ se3.exp(twists(angle, 1)[0])
    shares = np.linspace(0, 1, 9)
    T = np.array([se3.interpolate(T0, T1, share) for share in shares])
    turns = se3.log(se3.inverse(T[:-1]) @ T[1:])[:, 3:]
    np.testing.assert_allclose(turns, np.tile(turns[0], (8, 1)), rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(turns[0]), angle / 8, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.diff(T[:, :3, 3], axis=0, n=2), 0, rtol=0, atol=1e-13)


def test_only_rigid_matrices_are_rigid() -> None:
    T = se3.exp(twists(1.0, 1)[0])
    assert se3.is_rigid(T)
    assert se3.is_rigid(np.eye(4))
    scaled, mirrored, projective, broken = T.copy(), T.copy(), T.copy(), T.copy()
    scaled[:3, :3] *= 1.001
    mirrored[:3, 0] *= -1
    projective[3, 0] = 0.01
    broken[0, 3] = np.nan
    for wrong in (scaled, mirrored, projective, broken, T[:3], np.zeros((4, 4))):
        assert not se3.is_rigid(wrong)
    assert se3.is_rigid(scaled, tolerance=1e-2)
