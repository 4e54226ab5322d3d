"""Gaussians on SE(3): sampling, change of side, compounding, divergence and distance.

A pose ``T`` with a covariance ``Y`` (6, 6), ordered (u, omega), is random on one of two sides:
right, ``T exp(xi)`` (frame of the moving cloud), or left, ``exp(xi) T`` (frame of the one that
stays), with ``xi ~ N(0, Y)``.  Everything is batched over leading axes.
Source: Barfoot & Furgale 2014, "Associating uncertainty with three-dimensional poses".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.geometry.se3 import Array, adjoint, inverse, log

_MARGIN = 1e-14  # smallest eigenvalue of a correlation matrix that rounding cannot have made
_CONDITION = 1e-13  # least ratio of eigenvalues that still is positive definite when rounded
_UNKNOWN = 1e12  # variance (m^2, rad^2) beyond which a chain does not grow
REFERENCE_SHARE = 0.4  # of the variance of registrations, that those to one reference share
_N_SUMMED = 50  # twists that a filter adds up, as of 5 s at 10 Hz
_RAD_PER_M = 0.35  # a turn that tells two registrations apart as a metre of way does
_ASYMMETRY = 1e-9  # largest difference of mirrored correlations that rounding can have made


class GaussianPose(NamedTuple):
    """A pose and the covariance of its perturbation.  T: (..., 4, 4); Y: (..., 6, 6)."""

    T: Array
    Y: Array


class Bias(NamedTuple):
    """What the errors of registrations that follow each other have in common.

    share: of their variance.  way_m: motion over which that falls by a factor e.
    """

    share: float = 0.15
    way_m: float = 1.0

    def kept(self, T_step: ArrayLike) -> float:
        """Return phi, how much of the bias of one registration is left in the next.

        ``exp(-(way + angle 1 m / 0.35 rad) / way_m)`` of the motion of the next: what is near sees
        the same surfaces in the same way.  T_step: (4, 4).
        """
        return float(np.exp(-motion_m(T_step) / self.way_m))

    def inflation(self, T_step: ArrayLike) -> float:
        """Return by how much the variance of the sum of 50 steps exceeds that of independent ones.

        ``1 + 2 s sum_k (1 - k / 50) phi^k``, k from 1 to 49, of steps like this one, which follow
        ``extended``.
        """
        k = np.arange(1, _N_SUMMED)
        left = (1.0 - k / _N_SUMMED) * self.kept(T_step) ** k
        return 1.0 + 2.0 * self.share * float(left.sum())


INDEPENDENT = Bias(share=0.0)


def motion_m(T: ArrayLike) -> float:
    """Return the way of a motion (4, 4) in metres, of which 0.35 rad of a turn is one."""
    u, omega = np.split(log(T), 2)
    return float(np.linalg.norm(u) + np.linalg.norm(omega) / _RAD_PER_M)


class Chained(NamedTuple):
    """The end of a chain of poses, and what its error shares with the bias of its last step.

    T: (4, 4); Y: (6, 6), right; shared: (6, 6), covariance of the error and of the bias b of
    ``extended``.
    """

    T: Array
    Y: Array
    shared: Array

    @classmethod
    def start(cls, T: Array) -> Chained:
        """Return a chain that begins at a pose without error."""
        return cls(T, np.zeros((6, 6)), np.zeros((6, 6)))

    @property
    def pose(self) -> GaussianPose:
        """The end of the chain."""
        return GaussianPose(self.T, self.Y)


def sampled_covariance(xi: ArrayLike, centre: ArrayLike | None = None) -> Array:
    """Return ``sum xi xi^T / (n - 1)`` about ``centre``, which is zero (ground truth) if None.

    xi: (..., n, d), n >= 2; centre: (..., d).  Returns (..., d, d).
    Source: Landry et al. 2019, Sec. IV-D: the truth is the mean, so a bias counts as spread.
    """
    xi = np.asarray(xi, dtype=np.float64)
    if xi.ndim < 2 or xi.shape[-2] < 2:
        raise ValueError(f"a covariance needs at least two samples: shape {xi.shape}")
    if centre is not None:
        xi = xi - np.asarray(centre, dtype=np.float64)[..., None, :]
    return symmetrized(_transposed(xi) @ xi / (xi.shape[-2] - 1))


def to_left(T: ArrayLike, Y: ArrayLike) -> Array:
    """Return ``Ad(T) Y Ad(T)^T``: the left covariance of a right one.  (..., 6, 6).

    ``to_left(inverse(T), Y)`` is the right covariance of a left one.
    """
    Ad = adjoint(T)
    return symmetrized(Ad @ np.asarray(Y, dtype=np.float64) @ _transposed(Ad))


def to_fixed_axes(R: ArrayLike, Y: ArrayLike) -> Array:
    """Return ``blkdiag(R, R) Y blkdiag(R, R)^T``: what ROS calls the covariance of a pose.

    That of the additive error of the position and of the rotation about fixed axes, both along
    the axes of the frame in which the pose is given, to first order; neither the left nor the
    right covariance.  R: (3, 3), rotation of the pose; Y: (6, 6), right.  ``to_fixed_axes(R.T,
    C)`` undoes it.
    """
    B = np.kron(np.eye(2), np.asarray(R, dtype=np.float64))
    return symmetrized(B @ np.asarray(Y, dtype=np.float64) @ B.T)


def rotation_first(Y: ArrayLike) -> Array:
    """Return a covariance ordered (u, omega) as (omega, u), which is GTSAM's order.  (6, 6)."""
    order = [3, 4, 5, 0, 1, 2]
    return np.asarray(Y, dtype=np.float64)[np.ix_(order, order)]


def compound_left(
    T1: ArrayLike, Y1: ArrayLike, T2: ArrayLike, Y2: ArrayLike, order: int = 4
) -> GaussianPose:
    """Return the pose ``T1 T2`` and its left covariance from two independent left covariances.

    With ``S = Ad(T1) Y2 Ad(T1)^T`` the second order is ``Y1 + S``; the fourth adds
    ``B/4 + (A1 S + S A1^T + A2 Y1 + Y1 A2^T)/12``.  The fourth order holds while rotations are
    below a radian or so; only the second is positive definite whatever the spread.
    T1, T2: (..., 4, 4); Y1, Y2: (..., 6, 6); order: 2 or 4.
    Source: Barfoot & Furgale 2014, eqs. 54-55.
    """
    if order not in (2, 4):
        raise ValueError(f"compounding is of order 2 or 4, not {order}")
    T1, T2 = np.asarray(T1, dtype=np.float64), np.asarray(T2, dtype=np.float64)
    Y1, S = np.asarray(Y1, dtype=np.float64), to_left(T1, Y2)
    Y = Y1 + S
    if order == 4:
        C = _a_matrix(Y1) @ S + _a_matrix(S) @ Y1
        Y = Y + _b_matrix(Y1, S) / 4 + (C + _transposed(C)) / 12
    return GaussianPose(T1 @ T2, symmetrized(Y))


def compound_right(
    T1: ArrayLike, Y1: ArrayLike, T2: ArrayLike, Y2: ArrayLike, order: int = 4
) -> GaussianPose:
    """Return the pose ``T1 T2`` and its right covariance from two independent right covariances.

    The inverse of ``T1 exp(xi1) T2 exp(xi2)`` is a product of left-perturbed poses, so this is
    the left form on (T2^-1, Y2), (T1^-1, Y1).  Shapes and order as in ``compound_left``.
    """
    Y = compound_left(inverse(T2), Y2, inverse(T1), Y1, order).Y
    return GaussianPose(np.asarray(T1, dtype=np.float64) @ np.asarray(T2, dtype=np.float64), Y)


def between(first: GaussianPose, second: GaussianPose, common: float = 0.0) -> GaussianPose:
    """Return a pose as seen from another, both registered to one reference; right covariances.

    common: correlation of the two errors, which cancels; 0 when they share nothing.
    """
    Ad = adjoint(inverse(second.T) @ first.T)
    shared = common * Ad @ np.linalg.cholesky(first.Y) @ np.linalg.cholesky(second.Y).T
    Y = second.Y + Ad @ first.Y @ Ad.T - shared - shared.T
    return GaussianPose(inverse(first.T) @ second.T, symmetrized(Y))


def extended(chain: Chained, step: GaussianPose, bias: Bias = INDEPENDENT) -> Chained:
    """Return a chain of poses that is one step longer, right covariances, as ``compound_right``.

    The error of a step is ``L (sqrt(s) b + sqrt(1 - s) n)``, ``L L^T`` its covariance, s the share
    of the bias, n noise that is new, b a bias that goes on from step to step: ``b_next = phi b +
    w``, a Gauss-Markov process of unit variance.  What the chain shares with it is added to first
    order.

    Of 4th order wherever that is positive definite, else of 2nd.  By simulation of 80 steps of
    0.5 m it is right to 2 % while the rotation of the chain is known to a radian, and too wide
    beyond; the 2nd order alone is far too small then, where a robot moves.  Variances stay below
    1e12, where nothing is known any more.
    """
    Ad, root = adjoint(inverse(step.T)), np.sqrt(bias.share) * np.linalg.cholesky(step.Y)
    before = bias.kept(step.T) * Ad @ chain.shared
    common = before @ root.T
    common = common + common.T
    T, Y = compound_right(chain.T, chain.Y, *step)
    if not is_positive_definite(Y + common):
        Y = compound_right(chain.T, chain.Y, *step, order=2).Y
    Y = Y + common
    shrink = np.sqrt(_UNKNOWN / np.maximum(np.diagonal(Y), _UNKNOWN))
    return Chained(T, shrink[:, None] * Y * shrink, shrink[:, None] * (before + root))


def kl(Y: ArrayLike, F: ArrayLike) -> Array:
    """Return ``KL(N(0, Y) | N(0, F)) = (tr(F^-1 Y) - d + ln det F - ln det Y) / 2``, in nats.

    Y, F: (..., d, d) positive definite, else numpy's LinAlgError.  Returns (...), never negative:
    with ``M = chol(F)^-1 chol(Y)`` it is a sum of squares below the diagonal of M and of
    ``exp(x) - 1 - x``, ``x = ln M_ii^2``, so no determinant is ever formed.
    """
    M = _solve_lower(
        np.linalg.cholesky(np.asarray(F, dtype=np.float64)),
        np.linalg.cholesky(np.asarray(Y, dtype=np.float64)),
    )
    x = 2 * np.log(np.diagonal(M, axis1=-2, axis2=-1))
    below = np.sum(np.tril(M, -1) ** 2, axis=(-2, -1))
    return np.asarray(0.5 * (below + np.maximum(np.expm1(x) - x, 0.0).sum(axis=-1)))


def mahalanobis(xi: ArrayLike, Y: ArrayLike) -> Array:
    """Return the distance ``sqrt(xi^T Y^-1 xi)``; its mean is 2.350 in 6 dof and 1.596 in 3.

    xi: (..., d); Y: (..., d, d) positive definite, else numpy's LinAlgError.  Returns (...).
    """
    xi = np.asarray(xi, dtype=np.float64)
    L = np.linalg.cholesky(np.asarray(Y, dtype=np.float64))
    white = _solve_lower(L, xi[..., None])[..., 0]
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", white, white)))


def is_positive_definite(Y: ArrayLike) -> NDArray[np.bool_]:
    """Return whether each matrix is finite, symmetric and positive definite beyond rounding.

    The verdict is on correlations, so that units and scales do not matter: a determinant of
    1e-40 is as good as any.  Y: (..., d, d).  Returns (...).
    """
    Y = np.asarray(Y, dtype=np.float64)
    variances = np.diagonal(Y, axis1=-2, axis2=-1)
    usable = np.isfinite(Y).all(axis=(-2, -1)) & (variances > 0).all(axis=-1)
    sane = np.where(usable[..., None, None], Y, np.eye(Y.shape[-1]))
    sigma = np.sqrt(np.diagonal(sane, axis1=-2, axis2=-1))
    C = sane / sigma[..., :, None] / sigma[..., None, :]
    usable &= np.abs(C - _transposed(C)).max(axis=(-2, -1)) <= _ASYMMETRY
    try:
        np.linalg.cholesky(C - _MARGIN * np.eye(Y.shape[-1]))
    except np.linalg.LinAlgError:
        usable &= np.linalg.eigvalsh(C)[..., 0] > _MARGIN
    return np.asarray(usable)


def symmetrized(Y: ArrayLike) -> Array:
    """Return ``(Y + Y^T) / 2``, symmetric to the last bit.  (..., d, d) -> (..., d, d)."""
    Y = np.asarray(Y, dtype=np.float64)
    return 0.5 * (Y + _transposed(Y))


def larger(A: ArrayLike, B: ArrayLike) -> Array:
    """Return the covariance that is as wide as the wider of A and B along every common axis.

    ``L V diag(max(1, l)) V^T L^T`` with ``A = L L^T`` and ``L^-1 B L^-T = V diag(l) V^T``: neither
    A nor B is larger than it in any direction, it is A or B where one is, and units do not matter.
    A: (d, d), positive definite; B: (d, d), positive semidefinite.
    """
    L = np.linalg.cholesky(np.asarray(A, dtype=np.float64))
    half = _solve_lower(L, np.asarray(B, dtype=np.float64))
    values, V = np.linalg.eigh(symmetrized(_solve_lower(L, half.T)))
    root = L @ V
    return symmetrized((root * np.maximum(values, 1.0)) @ root.T)


def bounded(C: Array, floor_sigma_m: float, floor_sigma_rad: float, ceiling: float) -> Array:
    """Return C between the floors D = diag(floor_sigma_m^2, floor_sigma_rad^2) and the ceiling.

    C: (6, 6), finite.  Returns a matrix that is exactly symmetric, positive definite, and
    ``D <= C <= ceiling I`` in the sense of positive semidefinite differences; C itself where it is
    so already.  A floor above the ceiling is lowered to it.
    """
    ceiling *= 1.0 - 1e-9  # so that rounding does not pass it
    unit = np.minimum(np.repeat([floor_sigma_m, floor_sigma_rad], 3), np.sqrt(0.999 * ceiling))
    C = _scaled(_clamped(_scaled(C, 1.0 / unit), 1.0, np.inf), unit)
    if np.linalg.norm(C, 2) > ceiling:
        D = np.diag(unit**2)
        room = np.sqrt(ceiling - unit**2)
        C = D + _scaled(_clamped(_scaled(C - D, 1.0 / room), 0.0, 1.0), room)
    return _clamped(C, _CONDITION * float(np.linalg.norm(C, 2)), np.inf)


def matrix_sqrt(S: ArrayLike) -> Array:
    """Return the symmetric R with ``R R = S``.  (..., d, d); LinAlgError if not positive."""
    return _power(S, 0.5)


def matrix_inverse_sqrt(S: ArrayLike) -> Array:
    """Return the symmetric R with ``R S R = I``.  (..., d, d); LinAlgError if not positive."""
    return _power(S, -0.5)


def _power(S: ArrayLike, exponent: float) -> Array:
    values, vectors = np.linalg.eigh(symmetrized(S))
    if not (values > 0).all():
        raise np.linalg.LinAlgError("matrix is not positive definite")
    return symmetrized((vectors * values[..., None, :] ** exponent) @ _transposed(vectors))


def _transposed(A: Array) -> Array:
    return np.swapaxes(A, -1, -2)


def _solve_lower(L: Array, B: Array) -> Array:
    """Return ``L^-1 B`` by forward substitution.  (..., d, d), (..., d, m)."""
    d = L.shape[-1]
    X = np.array(np.broadcast_to(B, np.broadcast_shapes(B.shape, (*L.shape[:-1], B.shape[-1]))))
    for i in range(d):
        X[..., i, :] -= (L[..., i : i + 1, :i] @ X[..., :i, :])[..., 0, :]
        X[..., i, :] /= L[..., i, i, None]
    return X


def _bracket(A: Array) -> Array:
    """Return ``<<A>> = -tr(A) I + A``.  (..., 3, 3)."""
    trace = np.einsum("...ii", A)
    return np.asarray(A - trace[..., None, None] * np.eye(3))


def _bracket2(A: Array, B: Array) -> Array:
    """Return ``<<A, B>> = <<A>> <<B>> + <<B A>>``.  (..., 3, 3)."""
    return _bracket(A) @ _bracket(B) + _bracket(B @ A)


def _a_matrix(Y: Array) -> Array:
    """Return A of one covariance.  Source: Barfoot & Furgale 2014, eq. 55."""
    A = np.zeros_like(Y)
    Yrp = Y[..., :3, 3:]
    A[..., :3, :3] = A[..., 3:, 3:] = _bracket(Y[..., 3:, 3:])
    A[..., :3, 3:] = _bracket(Yrp + _transposed(Yrp))
    return A


def _b_matrix(Y: Array, S: Array) -> Array:
    """Return B of two covariances (r translation, p rotation).  Source: the same, eq. 55."""
    Yrr, Yrp, Ypp = Y[..., :3, :3], Y[..., :3, 3:], Y[..., 3:, 3:]
    Srr, Srp, Spp = S[..., :3, :3], S[..., :3, 3:], S[..., 3:, 3:]
    Ypr, Spr = _transposed(Yrp), _transposed(Srp)
    B = np.zeros(np.broadcast_shapes(Y.shape, S.shape))
    B[..., :3, :3] = (
        _bracket2(Ypp, Srr) + _bracket2(Ypr, Srp) + _bracket2(Yrp, Spr) + _bracket2(Yrr, Spp)
    )
    B[..., :3, 3:] = _bracket2(Ypp, Spr) + _bracket2(Ypr, Spp)
    B[..., 3:, :3] = _transposed(B[..., :3, 3:])
    B[..., 3:, 3:] = _bracket2(Ypp, Spp)
    return B


def _scaled(C: Array, unit: Array) -> Array:
    """Return ``diag(unit) C diag(unit)``."""
    return np.asarray(unit[:, None] * C * unit)


def _clamped(A: Array, low: float, high: float) -> Array:
    """Return a symmetric matrix with its eigenvalues moved into [low, high]."""
    values, vectors = np.linalg.eigh(A)
    if low <= values[0] and values[-1] <= high:
        return symmetrized(A)
    return symmetrized((vectors * np.clip(values, low, high)) @ vectors.T)
