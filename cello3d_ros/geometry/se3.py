"""SE(3): exponential, logarithm, adjoint; batched over leading axes.

A twist is ``xi = (u, omega)``, translation first; a pose is a 4x4 matrix.
Source: Barfoot & Furgale 2014, "Associating uncertainty with three-dimensional poses".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_SMALL_RAD = 1e-2  # below this angle the coefficients come from their series


def hat(omega: ArrayLike) -> Array:
    """Return the skew matrix for which ``hat(a) @ b = cross(a, b)``.  (..., 3) -> (..., 3, 3)."""
    w = np.asarray(omega, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def exp(xi: ArrayLike) -> Array:
    """Return the pose of a twist.  (..., 6) -> (..., 4, 4)."""
    xi = np.asarray(xi, dtype=np.float64)
    u, omega = xi[..., :3], xi[..., 3:]
    W = hat(omega)
    W2 = W @ W
    angle2 = np.einsum("...i,...i->...", omega, omega)
    a, b, c = (f[..., None, None] for f in _coefficients(angle2))
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * W + b * W2
    T[..., :3, 3] = ((np.eye(3) + b * W + c * W2) @ u[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log(T: ArrayLike) -> Array:
    """Return the twist of a pose, rotation angle in [0, pi].  (..., 4, 4) -> (..., 6)."""
    T = np.asarray(T, dtype=np.float64)
    shape = T.shape[:-2]
    R = T[..., :3, :3].reshape(-1, 3, 3)
    omega = Rotation.from_matrix(R).as_rotvec().reshape(*shape, 3)
    W = hat(omega)
    angle2 = np.einsum("...i,...i->...", omega, omega)
    a, b, _ = _coefficients(angle2)
    # V^-1 = I - W/2 + d W^2 with d = (1 - a / (2 b)) / angle^2, 1/12 at zero
    small = angle2 < _SMALL_RAD**2
    safe = np.where(small, 1.0, angle2)
    d = np.where(small, 1 / 12 + angle2 / 720 + angle2**2 / 30240, (1 - a / (2 * b)) / safe)
    V_inv = np.eye(3) - 0.5 * W + d[..., None, None] * (W @ W)
    u = (V_inv @ T[..., :3, 3, None])[..., 0]
    return np.concatenate([u, omega], axis=-1)


def inverse(T: ArrayLike) -> Array:
    """Return the inverse pose.  (..., 4, 4) -> (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: ArrayLike) -> Array:
    """Return Ad(T), for which ``T exp(xi) = exp(Ad(T) xi) T``.

    T: (..., 4, 4).  Returns (..., 6, 6), ordered (u, omega).
    Source: Barfoot & Furgale 2014, eq. 101.
    """
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return out


def transform(T: ArrayLike, points: ArrayLike) -> Array:
    """Return the points moved by one pose.  (4, 4), (N, 3) -> (N, 3)."""
    T = np.asarray(T, dtype=np.float64)
    return np.asarray(np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3])


def pose(translation: ArrayLike, quaternion: ArrayLike) -> Array:
    """Return the pose of a translation and a quaternion (x, y, z, w).  (..., 3), (..., 4)."""
    translation = np.asarray(translation, dtype=np.float64)
    T = np.zeros((*translation.shape[:-1], 4, 4))
    T[..., :3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def quaternion(T: ArrayLike) -> Array:
    """Return the quaternion (x, y, z, w), w >= 0, of a pose.  (..., 4, 4) -> (..., 4)."""
    R = np.asarray(T, dtype=np.float64)[..., :3, :3]
    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True))


def interpolate(T0: ArrayLike, T1: ArrayLike, share: float) -> Array:
    """Return the pose at ``share`` of the way: SLERP in rotation, a line in translation."""
    T0, T1 = np.asarray(T0, dtype=np.float64), np.asarray(T1, dtype=np.float64)
    T = np.eye(4)
    turn = Rotation.from_matrix(T0[:3, :3].T @ T1[:3, :3]).as_rotvec()
    T[:3, :3] = T0[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    T[:3, 3] = (1.0 - share) * T0[:3, 3] + share * T1[:3, 3]
    return T


def is_rigid(T: ArrayLike, tolerance: float = 1e-3) -> bool:
    """Return whether a 4x4 matrix is finite and a rotation and translation to ``tolerance``."""
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(
        np.abs(R.T @ R - np.eye(3)).max() <= tolerance
        and np.linalg.det(R) > 0
        and np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() <= tolerance
    )


def _coefficients(angle2: Array) -> tuple[Array, Array, Array]:
    """Return sin(t)/t, (1 - cos t)/t^2, (t - sin t)/t^3 for t^2 = ``angle2``."""
    small = angle2 < _SMALL_RAD**2
    safe2 = np.where(small, 1.0, angle2)
    t = np.sqrt(safe2)
    x = np.where(small, angle2, 0.0)
    a = np.where(small, 1 - x / 6 * (1 - x / 20 * (1 - x / 42)), np.sin(t) / t)
    half = np.sin(0.5 * t) / t
    b = np.where(small, 0.5 - x / 24 * (1 - x / 30 * (1 - x / 56)), 2 * half * half)
    c = np.where(
        small, 1 / 6 - x / 120 * (1 - x / 42 * (1 - x / 72)), (t - np.sin(t)) / (safe2 * t)
    )
    return a, b, c
