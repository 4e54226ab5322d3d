"""Closed-form predictors of ICP's covariance, from the associations at the registered pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from cello3d_ros.clouds.neighbors import Indices
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.se3 import Array, transform


class ClosedForm(NamedTuple):
    """Two cheap predictors, (6, 6), reading side, ordered (u, omega).

    hessian: ``H^-1``, the covariance for point-to-plane residuals of 1 m deviation;
    sandwich: ``H^-1 (sum_i g_i g_i^T) H^-1``, what redrawing the reading does to the result to
    first order, g_i being the gradient that one reading point adds.
    """

    hessian: Array
    sandwich: Array


def closed_form(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    distances2: Array,
    indices: Indices,
    config: IcpConfig,
) -> ClosedForm:
    """Compute both predictors from all points of two registered clouds.

    distances2, indices: (N, k), the reading's neighbours (``Overlap``).  H is the point-to-plane
    normal matrix of the associations that ICP's rules keep.  ICP draws
    n_reading_points of the reading's N points, so both are scaled by N / n_reading_points.
    Raises RegistrationError when the geometry leaves a direction free.
    """
    rank = min(int(distances2.size * config.trim_ratio), distances2.size - 1)
    limit = np.partition(distances2, rank, axis=None)[rank]
    H, G = _normal_matrices(
        reading.points,
        transform(T_ref_read, reading.points),
        reference.points,
        reference.normals,
        np.ascontiguousarray(T_ref_read[:3, :3]),
        distances2,
        indices,
        limit,
    )
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    if not eigenvalues[0] > 1e-10 * eigenvalues[-1]:
        raise RegistrationError(
            "the overlap leaves a direction free: the normal equations of ICP are singular"
        )
    inverse_H = np.outer(scale, scale) * ((vectors / eigenvalues) @ vectors.T)
    n = len(reading.points)
    drawn = n / min(n, config.n_reading_points)
    sandwich = drawn * inverse_H @ G @ inverse_H
    return ClosedForm(drawn * inverse_H, 0.5 * (sandwich + sandwich.T))


@njit(cache=True, nogil=True)
def _normal_matrices(
    reading: Array,
    moved: Array,
    points: Array,
    normals: Array,
    R: Array,
    distances2: Array,
    indices: Indices,
    limit: float,
) -> tuple[Array, Array]:
    """Return H = sum J^T J and G = sum_i g_i g_i^T, g_i = sum J^T r over one point's neighbours.

    The residual of ``T exp(xi) p`` has the Jacobian ``[m, p x m]``, m = R^T n: the reading side.
    """
    H, G = np.zeros((6, 6)), np.zeros((6, 6))
    J, g = np.empty(6), np.empty(6)
    for i in range(len(moved)):
        g[:] = 0.0
        x, y, z = reading[i, 0], reading[i, 1], reading[i, 2]
        for j in range(indices.shape[1]):
            if not distances2[i, j] <= limit:
                break
            q = indices[i, j]
            r = 0.0
            for a in range(3):
                J[a] = R[0, a] * normals[q, 0] + R[1, a] * normals[q, 1] + R[2, a] * normals[q, 2]
                r += (moved[i, a] - points[q, a]) * normals[q, a]
            J[3] = y * J[2] - z * J[1]
            J[4] = z * J[0] - x * J[2]
            J[5] = x * J[1] - y * J[0]
            for u in range(6):
                g[u] += J[u] * r
                for v in range(u + 1):
                    H[u, v] += J[u] * J[v]
        for u in range(6):
            for v in range(u + 1):
                G[u, v] += g[u] * g[v]
    for u in range(6):
        for v in range(u):
            H[v, u], G[v, u] = H[u, v], G[u, v]
    return H, G
