"""Closed-form predictors of ICP's covariance, from the associations at the registered pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import n_drawn
from cello3d_ros.clouds.neighbors import Indices
from cello3d_ros.clouds.shape import Cloud, has_shape
from cello3d_ros.compiled import kernel
from cello3d_ros.config import IcpConfig
from cello3d_ros.errors import FreeDirectionError
from cello3d_ros.geometry.gaussian import symmetrized
from cello3d_ros.geometry.se3 import Array, hat, transform
from cello3d_ros.registration.overlap import Overlap

_N_NEIGHBORS = 20  # of a normal
HELD = 2.0  # least information of a direction against what errors of normals make of it
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


class ClosedForm(NamedTuple):
    """Two cheap predictors, (6, 6), reading side, ordered (u, omega), and what they came from.

    inverse_H: ``H^-1``, the covariance for point-to-plane residuals of 1 m deviation;
    sandwich: ``H^-1 (sum_i g_i g_i^T) H^-1``, what redrawing the reading does to the result to
    first order, g_i being the gradient that one reading point adds; trim_m: the distance up to
    which ICP's rules keep associations; residual_rms_m: root mean square of their point-to-plane
    residuals; n_associations: how many all of the reading has; normal_variance: mean variance of
    their normals about either axis of the plane, rad^2; held: least information of a direction
    against what errors of the normals alone make of it; free: the directions of the sensor that
    no plane holds, names of ``x y z roll pitch yaw``: along them both are too small.
    """

    inverse_H: Array
    sandwich: Array
    trim_m: float
    residual_rms_m: float
    n_associations: float
    normal_variance: float
    held: float
    free: tuple[str, ...] = ()


def closed_form(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    overlap: Overlap,
    config: IcpConfig,
) -> ClosedForm:
    """Compute both predictors from the associations of two registered clouds.

    H is the point-to-plane normal matrix of those that ICP's rules keep.  ICP draws
    n_reading_points of the reading, so both are scaled by N / n_reading_points where N of its
    points were associated.  Raises FreeDirectionError where H is singular.
    """
    assert has_shape(reference)
    limit2 = _trim_limit(overlap.distances2, config)
    H, G, W, sum2, n = _normal_matrices(
        overlap.points,
        transform(T_ref_read, overlap.points),
        reference.points,
        reference.normals,
        reference.planarity,
        reference.cylindricality,
        np.ascontiguousarray(T_ref_read[:3, :3]),
        overlap.distances2,
        overlap.indices,
        limit2,
    )
    inverse_H = _inverse(H)
    drawn = _drawn(reading, overlap, config)
    held, free = _held(H, _tilted(W))
    return ClosedForm(
        drawn * inverse_H,
        symmetrized(drawn * inverse_H @ G @ inverse_H),
        np.sqrt(limit2),
        np.sqrt(sum2 / max(n, 1)),
        n * len(reading.points) / len(overlap.points),
        W[3, 3] / max(n, 1),
        held,
        free,
    )


def censi(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    overlap: Overlap,
    config: IcpConfig,
    sigma_m: float,
) -> Array:
    """Return what sensor noise does to the minimum of ICP's objective J.  (6, 6), reading side.

    ``Y = J_xx^-1 J_xz cov(z) J_xz^T J_xx^-1``, the implicit function's derivative, z being the
    points of both clouds with noise of deviation sigma_m along every axis, x = xi of
    ``T exp(xi)``; normals and associations stay.  Scaled and refused like ``closed_form``.
    Source: Prakhya et al. 2015, after Censi 2007, for the point-to-plane error.
    """
    kept = overlap.distances2 <= _trim_limit(overlap.distances2, config)
    found = _implicit_derivative(overlap.points, reference, T_ref_read, overlap.indices, kept)
    (J_xx, spread), drawn = found, _drawn(reading, overlap, config)
    inverse = _inverse(J_xx)
    return symmetrized(drawn * sigma_m**2 * inverse @ spread @ inverse)


def common_bias(reference: Cloud, T_ref_read: Array, overlap: Overlap, config: IcpConfig) -> Array:
    """Return ``b = H^-1 sum J``: how far a bias of 1 m of all ranges moves ICP.  (6,), xi.

    The bias is along the normals, turned towards the reference's sensor.
    Source: Brossard et al. 2020, the correlated part of the sensor noise.
    """
    kept = overlap.distances2 <= _trim_limit(overlap.distances2, config)
    J, _ = _jacobians(overlap.points, reference, T_ref_read, overlap.indices)
    towards = np.einsum("mi,mi->m", reference.normals, reference.points) < 0.0
    signs = np.where(towards, 1.0, -1.0)[overlap.indices] * kept
    H = np.einsum("nku,nkv->uv", J * kept[..., None], J, optimize=True)
    return np.asarray(_inverse(H) @ np.einsum("nku,nk->u", J, signs))


def _jacobians(
    points: Array, reference: Cloud, T_ref_read: Array, indices: Indices
) -> tuple[Array, Array]:
    """Return ``J = [m, p x m]``, (N, k, 6), and ``m = R^T n``, (N, k, 3), of all associations."""
    m = reference.normals[indices] @ T_ref_read[:3, :3]
    return np.concatenate([m, np.cross(points[:, None], m)], axis=2), m


def _implicit_derivative(
    p: Array,
    reference: Cloud,
    T_ref_read: Array,
    indices: Indices,
    kept: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Return J_xx and ``J_xz J_xz^T`` of ``J = 1/2 sum r^2``, r = n . (T exp(xi) p - q).

    With ``exp(xi) p = p + u + w x p + (w x u + w x (w x p)) / 2 + ...`` the second derivative of r
    is ``[[0, hat(m)/2], [-hat(m)/2, (m p^T + p m^T)/2 - (m . p) I]]``.
    """
    J, m = _jacobians(p, reference, T_ref_read, indices)
    moved = transform(T_ref_read, p)[:, None] - reference.points[indices]
    r = np.einsum("nki,nki->nk", moved, reference.normals[indices]) * kept
    J = J * kept[..., None]
    rm = np.einsum("nk,nki->ni", r, m)
    mixed = rm.T @ p
    J_xx = np.einsum("nku,nkv->uv", J, J, optimize=True)
    J_xx[:3, 3:] += 0.5 * hat(rm.sum(axis=0))
    J_xx[3:, :3] -= 0.5 * hat(rm.sum(axis=0))
    J_xx[3:, 3:] += 0.5 * (mixed + mixed.T) - np.trace(mixed) * np.eye(3)
    by_reading = np.einsum("nku,nkv->nuv", J, m)  # d(J r)/dp
    by_reading[:, 3:] -= hat(rm)
    flat = by_reading.transpose(1, 0, 2).reshape(6, -1)
    by_reference = np.zeros((len(reference.points), 6))  # times -n^T, a unit vector
    np.add.at(by_reference, indices.ravel(), J.reshape(-1, 6))
    return symmetrized(J_xx), flat @ flat.T + by_reference.T @ by_reference


def _trim_limit(distances2: Array, config: IcpConfig) -> float:
    """Return the squared distance up to which ICP keeps associations."""
    rank = min(int(distances2.size * config.trim_ratio), distances2.size - 1)
    return float(np.partition(distances2, rank, axis=None)[rank])


def _drawn(reading: Cloud, overlap: Overlap, config: IcpConfig) -> float:
    """Return how many times fewer points of the reading ICP draws than were associated."""
    return len(overlap.points) / n_drawn(len(reading.points), config.n_reading_points)


def _inverse(H: Array) -> Array:
    """Return ``H^-1``.  Raises FreeDirectionError if it is singular, whatever the units."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    free = ~(eigenvalues > 1e-10 * eigenvalues[-1])
    if free.any():
        raise free_error(_named(vectors[:, free]))
    return np.asarray(np.outer(scale, scale) * ((vectors / eigenvalues) @ vectors.T))


def _tilted(W: Array) -> Array:
    """Return the part of H that errors of the normals alone would make.  (6, 6).

    ``sum w A A^T``, A = [I; hat(p)], from ``W = sum w [p; 1] [p; 1]^T``, w being the variances of
    the normals at one point.
    """
    N = np.zeros((6, 6))
    N[:3, :3] = W[3, 3] * np.eye(3)
    N[3:, :3], N[:3, 3:] = hat(W[:3, 3]), -hat(W[:3, 3])
    N[3:, 3:] = np.trace(W[:3, :3]) * np.eye(3) - W[:3, :3]
    return N


def _held(H: Array, N: Array) -> tuple[float, tuple[str, ...]]:
    """Return how well the least held direction is held, and the names of those that are free.

    H, N: (6, 6), the normal matrix and the part of it that errors of the normals would make.  A
    direction v is held by ``v^T H v / v^T N v`` and free below HELD: about ``N / H`` of a motion
    along it is not seen.
    """
    arm = np.sqrt(np.trace(H[3:, 3:]) / max(np.trace(H[:3, :3]), 1e-300))  # radians to metres
    unit = np.array([1.0, 1.0, 1.0, arm, arm, arm]) if arm > 0.0 else np.ones(6)
    per_metre = 1.0 / np.outer(unit, unit)
    H, N = H * per_metre, N * per_metre
    least = 1e-12 * np.trace(H + N) + 1e-300
    root = np.linalg.inv(np.linalg.cholesky(N + least * np.eye(6)))
    held, vectors = np.linalg.eigh(root @ H @ root.T)
    free = held < HELD
    if not free.any():
        return float(held[0]), ()
    directions, _ = np.linalg.qr(root.T @ vectors[:, free])
    return float(held[0]), _named(directions)


def free_error(directions: tuple[str, ...]) -> FreeDirectionError:
    """Return the error that names what is free."""
    named = ", ".join(directions)
    return FreeDirectionError(f"no plane of the overlap holds {named} of the sensor: free here")


def _named(directions: Array) -> tuple[str, ...]:
    """Name the axes that take part in orthonormal directions, (6, n)."""
    shares = (directions**2).sum(axis=1)
    return tuple(name for name, share in zip(_AXES, shares) if share > 0.25)


@kernel()
def _normal_matrices(
    reading: Array,
    moved: Array,
    points: Array,
    normals: Array,
    planarity: Array,
    cylindricality: Array,
    R: Array,
    distances2: Array,
    indices: Indices,
    limit: float,
) -> tuple[Array, Array, Array, float, int]:
    """Return H = sum J^T J, G = sum_i g_i g_i^T and W = sum_i w_i [p_i; 1] [p_i; 1]^T.

    Over one point's neighbours g_i is the sum of J^T r, w_i that of the normals' variances about
    either axis of their planes, rad^2, each that of a line's slope: ``s3^2`` of the points about
    it over ``k s2^2``.  The fourth is sum r^2, the fifth how many associations these sum over.

    The residual of ``T exp(xi) p`` has the Jacobian ``[m, p x m]``, m = R^T n: the reading side.
    All of one point's are ``A m`` with the same ``A = [I; hat(p)]``, so that it adds
    ``A M A^T`` to H, M = sum m m^T, and ``g = A sum m r``.
    """
    H, G, W = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((4, 4))
    M, B, g, p = np.empty((3, 3)), np.empty((3, 3)), np.empty(6), np.ones(4)
    sum2, n = 0.0, 0
    for i in range(len(moved)):
        xx = yy = zz = xy = xz = yz = a = b = c = w = 0.0
        for j in range(indices.shape[1]):
            if not distances2[i, j] <= limit:
                break
            q = indices[i, j]
            nx, ny, nz = normals[q, 0], normals[q, 1], normals[q, 2]
            r = (moved[i, 0] - points[q, 0]) * nx
            r += (moved[i, 1] - points[q, 1]) * ny
            r += (moved[i, 2] - points[q, 2]) * nz
            if nx == 0.0 and ny == 0.0 and nz == 0.0:
                continue
            sum2 += r * r
            n += 1
            spread = max(1.0 - cylindricality[q], 1e-9)  # s2 / s1
            w += (1.0 - planarity[q] / spread) ** 2 / _N_NEIGHBORS
            x = R[0, 0] * nx + R[1, 0] * ny + R[2, 0] * nz
            y = R[0, 1] * nx + R[1, 1] * ny + R[2, 1] * nz
            z = R[0, 2] * nx + R[1, 2] * ny + R[2, 2] * nz
            xx, yy, zz = xx + x * x, yy + y * y, zz + z * z
            xy, xz, yz = xy + x * y, xz + x * z, yz + y * z
            a, b, c = a + x * r, b + y * r, c + z * r
        if xx + yy + zz == 0.0:
            continue
        M[0, 0], M[0, 1], M[0, 2] = xx, xy, xz
        M[1, 0], M[1, 1], M[1, 2] = xy, yy, yz
        M[2, 0], M[2, 1], M[2, 2] = xz, yz, zz
        x, y, z = reading[i, 0], reading[i, 1], reading[i, 2]
        p[0], p[1], p[2] = x, y, z
        for u in range(4):
            for v in range(4):
                W[u, v] += w * p[u] * p[v]
        for u in range(3):  # hat(p) M, M being symmetric: row by row its transpose
            B[u, 0] = y * M[u, 2] - z * M[u, 1]
            B[u, 1] = z * M[u, 0] - x * M[u, 2]
            B[u, 2] = x * M[u, 1] - y * M[u, 0]
        for u in range(3):
            H[3 + u, 3] += y * B[2, u] - z * B[1, u]
            H[3 + u, 4] += z * B[0, u] - x * B[2, u]
            H[3 + u, 5] += x * B[1, u] - y * B[0, u]
            for v in range(3):
                H[u, v] += M[u, v]
                H[3 + v, u] += B[u, v]
        g[0], g[1], g[2] = a, b, c
        g[3], g[4], g[5] = y * c - z * b, z * a - x * c, x * b - y * a
        for u in range(6):
            for v in range(u + 1):
                G[u, v] += g[u] * g[v]
    for u in range(6):
        for v in range(u):
            H[v, u], G[v, u] = H[u, v], G[u, v]
    return H, G, W, sum2, n
