"""Local shape of a cloud: normals, planarity and cylindricality of each point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from cello3d_ros.clouds.filters import crop_range, limit_density
from cello3d_ros.clouds.neighbors import (
    Indices,
    KdTree,
    build_tree,
    in_chunks,
    nearest_one,
)
from cello3d_ros.config import CloudConfig
from cello3d_ros.errors import CloudError
from cello3d_ros.geometry.se3 import Array


class Cloud(NamedTuple):
    """A filtered scan with its local shape, computed once and used in both roles.

    points: (N, 3), metres, sensor frame, in the order of the tree, so that neighbours in space
    are near in memory; normals: (N, 3), unit, sign arbitrary; planarity, cylindricality: (N,), in
    [0, 1]; tree: k-d tree of the points.
    """

    points: Array
    normals: Array
    planarity: Array
    cylindricality: Array
    tree: KdTree


def prepare(points: Array, config: CloudConfig, rng: np.random.Generator) -> Cloud:
    """Filter a scan and compute its local shape.

    points: (N, 3) finite, sensor frame.  Raises CloudError when fewer than ``n_neighbors`` are
    left after the filters.
    """
    cropped = crop_range(points, config.min_range_m, config.max_range_m)
    kept = limit_density(cropped, config.voxel_m, config.max_points_per_voxel, rng)
    if len(kept) < config.n_neighbors:
        raise CloudError(
            f"{len(kept)} of {len(points)} points are left between {config.min_range_m:g} m and "
            f"{config.max_range_m:g} m, need at least {config.n_neighbors}"
        )
    tree = build_tree(kept)
    tree = tree._replace(order=np.arange(len(kept)))
    return Cloud(tree.points, *local_shape(tree, config.n_neighbors), tree)


def local_shape(tree: KdTree, k: int) -> tuple[Array, Array, Array]:
    """Return normals (N, 3), planarity (N,) and cylindricality (N,) of the points of a tree.

    Of the covariance of the k nearest points (the point itself among them), s1 >= s2 >= s3 being
    the square roots of its eigenvalues: the normal is the direction of s3, planarity is
    (s2 - s3) / s1 and cylindricality (s1 - s2) / s1; both are 0 where all neighbours coincide.
    Source: Demantke et al. 2011.
    """
    n = len(tree.points)
    normals, planarity, cylindricality = np.empty((n, 3)), np.empty(n), np.empty(n)

    def task(part: slice) -> None:
        _local_shape(
            tree, k, part.start, part.stop, normals[part], planarity[part], cylindricality[part]
        )

    in_chunks(task, n)
    return normals, planarity, cylindricality


@njit(cache=True, nogil=True)
def _local_shape(
    tree: KdTree,
    k: int,
    start: int,
    stop: int,
    normals: Array,
    planarity: Array,
    cylindricality: Array,
) -> None:
    points = tree.points
    stack = np.empty((64, 2))
    distances2 = np.empty(k)
    indices = np.empty(k, np.int64)
    covariance = np.empty((3, 3))
    vectors = np.empty((3, 3))
    for i in range(stop - start):
        x, y, z = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        nearest_one(tree, x, y, z, np.inf, -1.0, distances2, indices, stack)
        _covariance(points, indices, x, y, z, covariance)
        _eigen(covariance, vectors)
        first, second, third = _descending(covariance)
        s1 = math.sqrt(max(covariance[first, first], 0.0))
        s2 = math.sqrt(max(covariance[second, second], 0.0))
        s3 = math.sqrt(max(covariance[third, third], 0.0))
        normals[i] = vectors[:, third]
        planarity[i] = (s2 - s3) / s1 if s1 > 0.0 else 0.0
        cylindricality[i] = (s1 - s2) / s1 if s1 > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _covariance(
    points: Array, indices: Indices, x: float, y: float, z: float, covariance: Array
) -> None:
    """Fill the 3x3 covariance of the points at ``indices``, taken relative to (x, y, z)."""
    n = 0
    mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
    for index in indices:
        if index < 0:
            break
        dx, dy, dz = points[index, 0] - x, points[index, 1] - y, points[index, 2] - z
        n += 1
        mx += dx
        my += dy
        mz += dz
        xx += dx * dx
        xy += dx * dy
        xz += dx * dz
        yy += dy * dy
        yz += dy * dz
        zz += dz * dz
    mx, my, mz = mx / n, my / n, mz / n
    covariance[0, 0] = xx / n - mx * mx
    covariance[1, 1] = yy / n - my * my
    covariance[2, 2] = zz / n - mz * mz
    covariance[0, 1] = covariance[1, 0] = xy / n - mx * my
    covariance[0, 2] = covariance[2, 0] = xz / n - mx * mz
    covariance[1, 2] = covariance[2, 1] = yz / n - my * mz


@njit(cache=True, nogil=True)
def _eigen(matrix: Array, vectors: Array) -> None:
    """Diagonalise a symmetric 3x3 matrix in place by cyclic Jacobi rotations.

    The eigenvalues end on the diagonal, unsorted, their vectors in the columns of ``vectors``.
    """
    vectors[:] = np.eye(3)
    scale = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    for _ in range(30):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off <= 1e-16 * scale:
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                t = math.copysign(1.0, theta) / (abs(theta) + math.hypot(theta, 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for i in range(3):
                    a, b = matrix[i, p], matrix[i, q]
                    matrix[i, p], matrix[i, q] = c * a - s * b, s * a + c * b
                for i in range(3):
                    a, b = matrix[p, i], matrix[q, i]
                    matrix[p, i], matrix[q, i] = c * a - s * b, s * a + c * b
                    a, b = vectors[i, p], vectors[i, q]
                    vectors[i, p], vectors[i, q] = c * a - s * b, s * a + c * b


@njit(cache=True, nogil=True, inline="always")
def _descending(matrix: Array) -> tuple[int, int, int]:
    """Return the places of the diagonal's greatest, middle and least number."""
    a, b, c = 0, 1, 2
    if matrix[a, a] < matrix[b, b]:
        a, b = b, a
    if matrix[b, b] < matrix[c, c]:
        b, c = c, b
    if matrix[a, a] < matrix[b, b]:
        a, b = b, a
    return a, b, c
