"""Gaussians on SE(3): checks 2 to 6 of the conventions, against closed forms and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from cello3d_ros.geometry import gaussian as g
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import (
    INDEPENDENT,
    Bias,
    Chained,
    GaussianPose,
    extended,
    is_positive_definite,
    mahalanobis,
    motion_m,
)
from cello3d_ros.geometry.se3 import Array

EYE = np.eye(6)

# Barfoot & Furgale's two poses with large covariances
T1 = se3.exp([0, 2, 0, np.pi / 6, 0, 0])
T2 = se3.exp([0, 0, 1, 0, np.pi / 4, 0])
S1 = np.diag([1, 0.5, 0.5, 0.05, 0.1, 0.05])
S2 = np.diag([0.5, 1, 0.5, 0.05, 0.05, 0.1])
LEFT = [1.88094, 1.41102, 1.33274, 0.10047, 0.16089, 0.13641]
RIGHT = [1.34602, 1.55995, 1.28091, 0.10063, 0.14854, 0.14854]


def covariances(n: int, rng: np.random.Generator, scale: float = 1.0) -> Array:
    """Return random well-conditioned covariances.  (n, 6, 6)."""
    A = rng.standard_normal((n, 6, 12))
    return g.symmetrized(scale * A @ np.swapaxes(A, 1, 2) / 12)


def poses(n: int, rng: np.random.Generator) -> Array:
    """Return random poses.  (n, 4, 4)."""
    return se3.exp(rng.standard_normal((n, 6)))


# --- sampling and sides ---------------------------------------------------------------------


def test_a_constant_offset_counts_as_spread_about_the_truth() -> None:
    n, b = 40, np.arange(1.0, 7.0)
    Y = g.sampled_covariance(np.tile(b, (n, 1)))
    np.testing.assert_allclose(Y, np.outer(b, b) * n / (n - 1), rtol=1e-14)
    np.testing.assert_array_equal(g.sampled_covariance(np.tile(b, (n, 1)), b), 0.0)


def test_about_its_mean_the_sampled_covariance_is_numpys() -> None:
    xi = np.random.default_rng(0).standard_normal((5, 30, 6)) + 3.0
    Y = g.sampled_covariance(xi, xi.mean(axis=1))
    expected = [np.cov(samples, rowvar=False) for samples in xi]
    np.testing.assert_allclose(Y, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("shape", [(6,), (0, 6), (1, 6)])
def test_one_sample_has_no_covariance(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="two samples"):
        g.sampled_covariance(np.zeros(shape))


def test_changing_sides_and_back_is_the_identity() -> None:
    rng = np.random.default_rng(1)
    T, Y = poses(50, rng), covariances(50, rng)
    back = g.to_left(se3.inverse(T), g.to_left(T, Y))
    np.testing.assert_allclose(back, Y, rtol=0, atol=1e-12 * np.abs(g.to_left(T, Y)).max())


def test_left_covariance_is_that_of_the_perturbation_seen_from_the_left() -> None:
    rng = np.random.default_rng(2)
    xi = 1e-3 * rng.standard_normal((500, 6)) * [1, 2, 3, 4, 5, 6]
    left = se3.log(T1 @ se3.exp(xi) @ se3.inverse(T1))
    np.testing.assert_allclose(
        g.to_left(T1, g.sampled_covariance(xi)), g.sampled_covariance(left), rtol=0, atol=1e-17
    )


def test_fixed_axes_are_the_additive_position_and_the_turn_before_the_pose() -> None:
    """Sigma points of Y, as additive position and rotation vector, have the covariance C."""
    rng = np.random.default_rng(44)
    T = poses(1, rng)[0]
    Y = covariances(1, rng, 1e-10)[0]
    xi = np.linalg.cholesky(Y).T
    moved = T @ se3.exp(xi)
    u = moved[:, :3, 3] - T[:3, 3]
    turns = np.zeros((6, 4, 4))
    turns[:, :3, :3] = moved[:, :3, :3] @ T[:3, :3].T
    turns[:, 3, 3] = 1.0
    errors = np.hstack([u, se3.log(turns)[:, 3:]])
    C = g.to_fixed_axes(T[:3, :3], Y)
    np.testing.assert_allclose(errors.T @ errors / 1e-10, C / 1e-10, atol=1e-3, rtol=0)
    np.testing.assert_allclose(g.to_fixed_axes(T[:3, :3].T, C), Y, atol=1e-24, rtol=0)


# --- compounding ----------------------------------------------------------------------------


def sampled_compound(side: str, n: int = 400_000) -> Array:
    """Return the covariance of T1 T2 by Monte Carlo, ``E[xi xi^T]`` of the exact product.

    The linear part of xi has a known covariance, so only the rest is left to chance.
    """
    rng = np.random.default_rng(3)
    x1 = rng.standard_normal((n, 6)) * np.sqrt(np.diag(S1))
    x2 = rng.standard_normal((n, 6)) * np.sqrt(np.diag(S2))
    mean_inverse = se3.inverse(T1 @ T2)
    if side == "left":
        xi = se3.log(se3.exp(x1) @ T1 @ se3.exp(x2) @ T2 @ mean_inverse)
        Ad = se3.adjoint(T1)
        linear, known = x1 + x2 @ Ad.T, S1 + Ad @ S2 @ Ad.T
    else:
        xi = se3.log(mean_inverse @ T1 @ se3.exp(x1) @ T2 @ se3.exp(x2))
        Ad = se3.adjoint(se3.inverse(T2))
        linear, known = x1 @ Ad.T + x2, Ad @ S1 @ Ad.T + S2
    return g.sampled_covariance(xi) - g.sampled_covariance(linear) + known


def relative_error(Y: Array, truth: Array) -> float:
    return float(np.linalg.norm(Y - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize(("side", "diagonal"), [("left", LEFT), ("right", RIGHT)])
def test_fourth_order_compounding_gives_the_published_diagonal(
    side: str, diagonal: list[float]
) -> None:
    compound = g.compound_left if side == "left" else g.compound_right
    T, Y = compound(T1, S1, T2, S2)
    np.testing.assert_allclose(np.diag(Y), diagonal, rtol=0, atol=6e-6)
    np.testing.assert_array_equal(T, T1 @ T2)
    np.testing.assert_array_equal(Y, Y.T)


@pytest.mark.parametrize("side", ["left", "right"])
def test_fourth_order_compounding_agrees_with_monte_carlo(side: str) -> None:
    compound = g.compound_left if side == "left" else g.compound_right
    truth = sampled_compound(side)
    assert relative_error(compound(T1, S1, T2, S2, 4).Y, truth) <= 0.002
    assert relative_error(compound(T1, S1, T2, S2, 2).Y, truth) == pytest.approx(0.0133, rel=0.15)


def generators() -> Array:
    """Return ad(e_i) of the six unit twists, ``ad(x) y`` the bracket of x and y.  (6, 6, 6)."""
    G = np.zeros((6, 6, 6))
    W = se3.hat(np.eye(3))
    G[:3, :3, 3:] = W
    G[3:, :3, :3] = G[3:, 3:, 3:] = W
    return G


def test_fourth_order_terms_are_the_moments_of_the_bracket_series() -> None:
    # xi = x + y + ad(x)y/2 + ad(x)ad(x)y/12 + ad(y)ad(y)x/12 + ..., moments taken term by term
    rng, G = np.random.default_rng(18), generators()
    Y1, Y2 = covariances(2, rng)
    S = g.to_left(T1, Y2)
    A1, A2 = (np.einsum("ij,iab,jbc->ac", C, G, G) for C in (Y1, S))
    B = np.einsum("ij,iab,bc,jdc->ad", Y1, G, S, G)
    C = A1 @ S + A2 @ Y1
    expected = Y1 + S + B / 4 + (C + C.T) / 12
    np.testing.assert_allclose(g.compound_left(T1, Y1, T2, Y2).Y, expected, rtol=0, atol=1e-12)


def test_compounding_at_the_identity_gives_the_closed_form() -> None:
    eye = np.eye(4)
    Y = g.compound_left(eye, EYE, eye, np.diag([3.0, 1, 1, 1, 1, 5])).Y
    np.testing.assert_allclose(
        Y, np.diag([4, 19 / 6, 17 / 6, 13 / 6, 13 / 6, 4.5]), rtol=0, atol=1e-14
    )


def test_right_and_left_compounding_are_the_same_to_second_order() -> None:
    rng = np.random.default_rng(4)
    (A, B), (Ya, Yb) = poses(2, rng), covariances(2, rng, 1e-2)
    right = g.compound_right(A, Ya, B, Yb, order=2).Y
    left = g.compound_left(A, g.to_left(A, Ya), B, g.to_left(B, Yb), order=2).Y
    np.testing.assert_allclose(g.to_left(A @ B, right), left, rtol=1e-10)


def test_compounding_with_a_certain_pose_only_moves_the_covariance() -> None:
    zero = np.zeros((6, 6))
    np.testing.assert_allclose(g.compound_right(T1, S1, np.eye(4), zero).Y, S1, rtol=0, atol=1e-15)
    np.testing.assert_allclose(g.compound_right(T1, zero, T2, S2).Y, S2, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        g.compound_left(T1, zero, T2, S2).Y, g.to_left(T1, S2), rtol=0, atol=1e-15
    )


def test_compounding_a_batch_equals_one_at_a_time_exactly_symmetric() -> None:
    rng = np.random.default_rng(5)
    A, B = poses(6, rng).reshape(2, 3, 4, 4), poses(3, rng)
    Ya, Yb = covariances(6, rng, 0.05).reshape(2, 3, 6, 6), covariances(3, rng, 0.05)
    T, Y = g.compound_right(A, Ya, B, Yb)
    assert T.shape == (2, 3, 4, 4)
    np.testing.assert_array_equal(Y, np.swapaxes(Y, -1, -2))
    for i, j in np.ndindex(2, 3):
        one = g.compound_right(A[i, j], Ya[i, j], B[j], Yb[j])
        np.testing.assert_allclose(T[i, j], one.T, rtol=0, atol=1e-14)
        np.testing.assert_allclose(Y[i, j], one.Y, rtol=1e-12, atol=1e-14)


def test_compounding_knows_two_orders() -> None:
    with pytest.raises(ValueError, match="order 2 or 4, not 3"):
        g.compound_left(T1, S1, T2, S2, order=3)


def test_a_chain_sampled_from_its_own_covariances_is_consistent() -> None:
    rng = np.random.default_rng(6)
    n_steps, n_runs = 35, 20_000
    steps = se3.exp([0.4, 0.05, 0, 0, 0.01, 0.05] + 0.05 * rng.standard_normal((n_steps, 6)))
    Ys = covariances(n_steps, rng) * np.outer(s := [0.01] * 3 + [0.004] * 3, s)
    truth, Y = np.eye(4), np.zeros((6, 6))
    runs = np.tile(np.eye(4), (n_runs, 1, 1))
    for T_step, Y_step in zip(steps, Ys, strict=True):
        truth, Y = g.compound_right(truth, Y, T_step, Y_step)
        noise = rng.standard_normal((n_runs, 6)) @ np.linalg.cholesky(Y_step).T
        runs = runs @ T_step @ se3.exp(noise)
    xi = se3.log(se3.inverse(truth) @ runs)
    joint = g.mahalanobis(xi, Y)
    translation = g.mahalanobis(xi[:, :3], Y[:3, :3])
    rotation = g.mahalanobis(xi[:, 3:], Y[3:, 3:])
    assert joint.mean() == pytest.approx(2.350, abs=0.02)
    assert translation.mean() == pytest.approx(1.596, abs=0.02)
    assert rotation.mean() == pytest.approx(1.596, abs=0.02)
    assert (translation <= joint + 1e-9).all()
    assert (rotation <= joint + 1e-9).all()


# --- divergence and distance ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "expected"),
    [(1, 0.0), (2, 0.579442), (0.5, 0.920558), (10, 4.207755), (0.1, 20.092245)],
)
def test_kl_of_scaled_identities(factor: float, expected: float) -> None:
    assert g.kl(EYE, factor * EYE) == pytest.approx(expected, abs=6e-7)


def test_kl_is_zero_only_between_equals_and_never_negative() -> None:
    Y = covariances(200, np.random.default_rng(8))
    np.testing.assert_array_equal(g.kl(Y, Y), 0.0)
    nearly = g.kl(Y, Y * (1 + 1e-9))
    assert (nearly >= 0).all()
    assert (nearly < 1e-14).all()
    assert (g.kl(Y[1:], Y[:-1]) > 0).all()


def test_kl_is_the_textbook_formula() -> None:
    Y, F = covariances(60, np.random.default_rng(9)).reshape(2, 30, 6, 6)
    trace = np.trace(np.linalg.solve(F, Y), axis1=1, axis2=2)
    expected = 0.5 * (trace - 6 + np.linalg.slogdet(F)[1] - np.linalg.slogdet(Y)[1])
    np.testing.assert_allclose(g.kl(Y, F), expected, rtol=1e-10)


def test_kl_is_invariant_under_a_change_of_frame() -> None:
    rng = np.random.default_rng(10)
    Y, F = covariances(60, rng).reshape(2, 30, 6, 6)
    A = rng.standard_normal((30, 6, 6)) + 3 * EYE
    At = np.swapaxes(A, 1, 2)
    moved = g.kl(g.symmetrized(A @ Y @ At), g.symmetrized(A @ F @ At))
    np.testing.assert_allclose(moved, g.kl(Y, F), rtol=1e-7)


def test_kl_holds_at_a_determinant_of_1e_40_and_far_below() -> None:
    Y, F = covariances(2, np.random.default_rng(11))
    for scale in (10 ** (-40 / 6), 1e-40, 1e40):
        assert g.kl(scale * Y, scale * F) == pytest.approx(float(g.kl(Y, F)), rel=1e-12)
    units = np.outer(s := [1e-2] * 3 + [1e-12] * 3, s)
    assert g.kl(units * Y, units * F) == pytest.approx(float(g.kl(Y, F)), rel=1e-12)


@pytest.mark.parametrize(
    ("n", "trials", "floor"), [(65, 400, 0.168), (500, 200, 0.021), (5000, 60, 0.0021)]
)
def test_kl_of_sampled_against_true_covariance_has_a_known_floor(
    n: int, trials: int, floor: float
) -> None:
    rng = np.random.default_rng(12)
    L = np.linalg.cholesky(covariances(1, rng, 1e-4)[0])
    Y = g.sampled_covariance(rng.standard_normal((trials, n, 6)) @ L.T)
    assert g.kl(Y, L @ L.T).mean() == pytest.approx(floor, rel=0.2)


def test_kl_refuses_a_singular_matrix() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        g.kl(EYE, np.diag([1.0, 1, 1, 1, 1, 0]))


def test_mahalanobis_counts_standard_deviations() -> None:
    assert g.mahalanobis([0, 0, 3.0, 0, 0, 0], np.diag([1, 1, 4.0, 1, 1, 1])) == 1.5
    rng = np.random.default_rng(13)
    Y, xi = covariances(40, rng), rng.standard_normal((40, 6))
    expected = [np.sqrt(x @ np.linalg.inv(C) @ x) for x, C in zip(xi, Y, strict=True)]
    np.testing.assert_allclose(g.mahalanobis(xi, Y), expected, rtol=1e-10)
    A = rng.standard_normal((6, 6))
    moved = g.mahalanobis(xi @ A.T, g.symmetrized(A @ Y @ A.T))
    np.testing.assert_allclose(moved, expected, rtol=1e-7)


def test_mahalanobis_broadcasts_samples_against_covariances() -> None:
    rng = np.random.default_rng(14)
    Y, xi = covariances(3, rng), rng.standard_normal((10, 1, 6))
    assert g.mahalanobis(xi, Y).shape == (10, 3)
    assert g.mahalanobis(xi[:, 0], Y[0]).shape == (10,)
    np.testing.assert_allclose(g.mahalanobis(xi, Y)[:, 1], g.mahalanobis(xi[:, 0], Y[1]))


# --- matrices -------------------------------------------------------------------------------


def test_positive_definite_is_judged_without_units() -> None:
    Y = covariances(30, np.random.default_rng(15))
    units = np.outer(s := [1e-3] * 3 + [1e-15] * 3, s)
    assert g.is_positive_definite(Y).all()
    assert g.is_positive_definite(1e-40 * Y).all()
    assert g.is_positive_definite(units * Y).all()


def test_what_is_not_positive_definite_is_found_in_its_place() -> None:
    indefinite = EYE.copy()
    indefinite[0, 1] = indefinite[1, 0] = 1.0 + 1e-12
    singular = EYE + np.outer([1, 1, 0, 0, 0, 0], [1, 1, 0, 0, 0, 0])
    singular[:2, :2] = 1.0
    lopsided = EYE.copy()
    lopsided[0, 1] = 1e-6
    nan, negative = EYE.copy(), np.diag([1.0, 1, 1, 1, 1, -1])
    nan[2, 2] = np.nan
    batch = np.array(
        [
            EYE,
            indefinite,
            singular,
            lopsided,
            nan,
            negative,
            0 * EYE,
            np.full((6, 6), np.inf),
            2 * EYE,
        ]
    )
    expected = [True, *[False] * 7, True]
    np.testing.assert_array_equal(g.is_positive_definite(batch), expected)
    for Y, fine in zip(batch, expected, strict=True):
        assert bool(g.is_positive_definite(Y)) is fine


def test_roots_multiply_back_and_are_symmetric() -> None:
    S = covariances(20, np.random.default_rng(16), 1e-6)
    R, R_inv = g.matrix_sqrt(S), g.matrix_inverse_sqrt(S)
    np.testing.assert_allclose(R @ R, S, rtol=0, atol=1e-18)
    np.testing.assert_allclose(
        R_inv @ S @ R_inv, np.broadcast_to(EYE, S.shape), rtol=0, atol=1e-10
    )
    np.testing.assert_array_equal(R, np.swapaxes(R, 1, 2))
    with pytest.raises(np.linalg.LinAlgError):
        g.matrix_sqrt(-EYE)


@pytest.mark.parametrize("seed", range(5))
def test_the_larger_of_two_covariances_is_above_both_and_no_more_than_their_sum(seed) -> None:
    A, B = covariances(2, np.random.default_rng(seed), 1e-4)
    larger = g.larger(A, B)
    scale = np.linalg.norm(larger, 2)
    for other in (larger - A, larger - B, A + B - larger):
        assert np.linalg.eigvalsh(other)[0] >= -1e-12 * scale
    np.testing.assert_allclose(larger, g.larger(B, A), atol=1e-12 * scale)
    np.testing.assert_array_equal(larger, larger.T)


def test_the_larger_of_two_covariances_is_one_of_them_where_one_is_larger() -> None:
    A, B = covariances(2, np.random.default_rng(18), 1e-4)
    np.testing.assert_allclose(g.larger(A, A + B), A + B, rtol=0, atol=1e-18)
    np.testing.assert_allclose(g.larger(A + B, A), A + B, rtol=0, atol=1e-18)
    np.testing.assert_allclose(g.larger(A, 0 * B), A, rtol=0, atol=1e-18)


def test_the_larger_of_two_covariances_does_not_depend_on_units_or_axes() -> None:
    rng = np.random.default_rng(19)
    A, B = covariances(2, rng)
    M = rng.standard_normal((6, 6))
    np.testing.assert_allclose(
        g.larger(M @ A @ M.T, M @ B @ M.T), M @ g.larger(A, B) @ M.T, rtol=1e-9, atol=1e-9
    )


def test_arguments_stay_as_they_were() -> None:
    rng = np.random.default_rng(17)
    A, B, Ya, Yb = T1.copy(), T2.copy(), *covariances(2, rng, 0.01)
    xi = rng.standard_normal((9, 6))
    before = [a.copy() for a in (A, B, Ya, Yb, xi)]
    g.compound_right(A, Ya, B, Yb)
    g.kl(Ya, Yb), g.mahalanobis(xi, Ya), g.sampled_covariance(xi, xi[0]), g.matrix_sqrt(Ya)
    for array, copy in zip((A, B, Ya, Yb, xi), before, strict=True):
        np.testing.assert_array_equal(array, copy)


STRAIGHT, CURVE = [0.5, 0, 0, 0, 0, 0], [0.3, 0.1, 0, 0.1, 0.2, 0.6]


@pytest.mark.parametrize("motion", [STRAIGHT, CURVE])
@pytest.mark.parametrize("turn_rad", [0.03, 0.1, 0.3])
def test_a_long_chain_covers_sampled_chains(motion: list[float], turn_rad: float) -> None:
    """80 steps: right to 5 % while rotation is known to a radian, never too small beyond.

    A chain that falls back to the 2nd order at a radian claims 1/45 of the squared error here.
    """
    rng = np.random.default_rng(0)
    step = GaussianPose(se3.exp(motion), np.diag(np.repeat([0.02**2, turn_rad**2], 3)))
    chain, T_true, n = Chained.start(np.eye(4)), np.eye(4), 4000
    T = np.tile(np.eye(4), (n, 1, 1))
    for _ in range(80):
        chain, T_true = extended(chain, step), T_true @ step.T
        noise = rng.normal(size=(n, 6)) * np.sqrt(np.diag(step.Y))
        T = T @ step.T @ se3.exp(noise)
    assert is_positive_definite(chain.Y)
    share = np.mean(mahalanobis(se3.log(se3.inverse(T_true) @ T), chain.Y) ** 2) / 6
    assert 0.95 < share < 1.05 if turn_rad < 0.2 else 0.2 < share < 1.05


@pytest.mark.parametrize("scale", [1e-6, 0.3, 1.0, 1e3, 1e12])
def test_a_chain_stays_finite_and_never_knows_more_than_its_steps_together(scale: float) -> None:
    chain = Chained.start(np.eye(4))
    for _ in range(400):
        chain = extended(chain, GaussianPose(np.eye(4), scale * np.eye(6)))
    assert is_positive_definite(chain.Y)
    assert min(399 * scale, 0.99e12) < chain.Y[0, 0] <= 1.01e12


def chained(steps: list[GaussianPose], bias: Bias) -> Chained:
    chain = Chained.start(np.eye(4))
    for step in steps:
        chain = extended(chain, step, bias)
    return chain


def random_steps(n: int, sigma: float = 0.01) -> list[GaussianPose]:
    rng = np.random.default_rng(11)
    roots = sigma * rng.normal(size=(n, 6, 6))
    return [GaussianPose(se3.exp(rng.normal(scale=0.2, size=6)), R @ R.T) for R in roots]


def test_steps_that_keep_no_bias_compound_as_independent_ones() -> None:
    T, Y = np.eye(4), np.zeros((6, 6))
    steps = random_steps(12)
    for step in steps:
        T, Y = g.compound_right(T, Y, *step)
    for bias in (INDEPENDENT, Bias(1.0, 1e-6)):  # it shares nothing, and it loses all
        np.testing.assert_array_equal(chained(steps, bias).T, T)
        np.testing.assert_allclose(chained(steps, bias).Y, Y, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [2, 10])
def test_a_bias_that_is_kept_grows_in_proportion_to_the_number_of_steps(n) -> None:
    """All of it shared: n times the standard deviation; a share s: n + s n (n - 1) times Y."""
    Y = random_steps(1, 1e-4)[0].Y  # so small that the 4th order adds nothing
    steps = [GaussianPose(np.eye(4), Y)] * n
    for share in (0.15, 1.0):
        expected = (n + share * n * (n - 1)) * Y
        found = chained(steps, Bias(share, 1.0)).Y
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * Y.max())


@pytest.mark.parametrize("way_m", [1.0, 10.0, 1e9])
def test_a_chain_with_a_bias_covers_sampled_chains(way_m: float) -> None:
    """Errors that are drawn as ``extended`` says, over steps that turn; the share is large."""
    share, n = 0.6, 4000
    rng, steps = np.random.default_rng(1), random_steps(30, 0.002)
    T_true, T, b = np.eye(4), np.tile(np.eye(4), (n, 1, 1)), rng.normal(size=(n, 6))
    for step in steps:
        z = np.sqrt(share) * b + np.sqrt(1 - share) * rng.normal(size=(n, 6))
        T = T @ step.T @ se3.exp(z @ np.linalg.cholesky(step.Y).T)
        T_true = T_true @ step.T
        kept = np.exp(-motion_m(step.T) / way_m)
        b = kept * b + np.sqrt(1 - kept**2) * rng.normal(size=(n, 6))
    chain = chained(steps, Bias(share, way_m))
    d2 = mahalanobis(se3.log(se3.inverse(T_true) @ T), chain.Y) ** 2
    assert np.mean(d2) / 6 == pytest.approx(1.0, abs=0.05)
    if way_m > 1.0:  # and independent steps would not
        d2 = mahalanobis(se3.log(se3.inverse(T_true) @ T), chained(steps, INDEPENDENT).Y) ** 2
        assert np.mean(d2) > 9


def test_a_chain_that_keeps_all_of_its_bias_stays_positive_definite() -> None:
    wide = GaussianPose(se3.exp([0.1, 0, 0, 0, 0, 0.5]), np.diag([1.0, 1, 1, 0.5, 0.5, 0.5]))
    chain = Chained.start(np.eye(4))
    for _ in range(100):
        chain = extended(chain, wide, Bias(1.0, 1e9))
        assert is_positive_definite(chain.Y)


def test_the_sum_of_50_steps_varies_as_inflated_independent_ones() -> None:
    Y = 1e-8 * np.eye(6)
    for way_m in (1.0, 64.0):
        bias, step = Bias(0.3, way_m), se3.exp([0.1, 0, 0, 0, 0, 0])
        total = chained([GaussianPose(step, Y)] * 50, bias).Y
        np.testing.assert_allclose(total[3, 3] / 50, bias.inflation(step) * 1e-8, rtol=1e-6)
    assert INDEPENDENT.inflation(step) == 1.0
    assert bias.inflation(np.eye(4)) == pytest.approx(1.0 + 0.3 * 49)  # all of it is kept


def test_bias_is_kept_at_rest_and_lost_over_a_way_or_a_turn() -> None:
    bias = Bias(way_m=2.0)
    assert bias.kept(np.eye(4)) == 1.0
    assert bias.kept(se3.exp([2.0, 0, 0, 0, 0, 0])) == pytest.approx(np.exp(-1.0))
    assert bias.kept(se3.exp([0, 0, 0, 0, 0, 0.7])) == pytest.approx(np.exp(-1.0))


@pytest.mark.parametrize("common", [0.0, 0.4, 1.0])
def test_a_pose_between_two_of_one_reference_loses_what_their_errors_share(common: float) -> None:
    rng, n = np.random.default_rng(2), 20_000
    first, second = random_steps(2, 0.002)
    b = rng.normal(size=(n, 6))

    def sampled(pose: GaussianPose) -> np.ndarray:
        z = np.sqrt(common) * b + np.sqrt(1 - common) * rng.normal(size=(n, 6))
        return pose.T @ se3.exp(z @ np.linalg.cholesky(pose.Y).T)

    T, Y = g.between(first, second, common)
    np.testing.assert_allclose(T, se3.inverse(first.T) @ second.T, atol=1e-15)
    xi = se3.log(se3.inverse(T) @ se3.inverse(sampled(first)) @ sampled(second))
    assert np.mean(mahalanobis(xi, Y) ** 2) / 6 == pytest.approx(1.0, abs=0.03)
    same = g.between(first, GaussianPose(first.T, first.Y), 1.0)
    np.testing.assert_allclose(same.Y, np.zeros((6, 6)), atol=1e-15)
