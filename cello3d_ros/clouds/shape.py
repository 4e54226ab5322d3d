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
    for i in range(stop - start):
        x, y, z = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        nearest_one(tree, x, y, z, np.inf, -1.0, distances2, indices, stack)
        xx, yy, zz, xy, xz, yz = _covariance(points, indices, x, y, z)
        largest, middle, least, normal = _eigen(xx, yy, zz, xy, xz, yz)
        s1, s2, s3 = math.sqrt(largest), math.sqrt(middle), math.sqrt(least)
        normals[i, 0], normals[i, 1], normals[i, 2] = normal
        planarity[i] = (s2 - s3) / s1 if s1 > 0.0 else 0.0
        cylindricality[i] = (s1 - s2) / s1 if s1 > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _covariance(
    points: Array, indices: Indices, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """Return xx, yy, zz, xy, xz, yz of the points at ``indices``, taken relative to (x, y, z)."""
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
    return (
        xx / n - mx * mx,
        yy / n - my * my,
        zz / n - mz * mz,
        xy / n - mx * my,
        xz / n - mx * mz,
        yz / n - my * mz,
    )


@njit(cache=True, nogil=True)
def _eigen(
    xx: float, yy: float, zz: float, xy: float, xz: float, yz: float
) -> tuple[float, float, float, tuple[float, float, float]]:
    """Return the eigenvalues of a covariance, descending, and the direction of the least.

    Cyclic Jacobi rotations, until what is left off the diagonal moves nothing in double precision:
    it enters the eigenvalues squared.
    """
    ax, ay, az = 1.0, 0.0, 0.0  # the directions a, b, c that become the eigenvectors of xx, yy, zz
    bx, by, bz = 0.0, 1.0, 0.0
    cx, cy, cz = 0.0, 0.0, 1.0
    small = 1e-24 * (xx + yy + zz) ** 2
    for _ in range(30):
        if xy * xy + xz * xz + yz * yz <= small:
            break
        xx, yy, xz, yz, c, s = _rotated(xx, yy, xy, xz, yz)
        xy = 0.0
        ax, bx = c * ax - s * bx, s * ax + c * bx
        ay, by = c * ay - s * by, s * ay + c * by
        az, bz = c * az - s * bz, s * az + c * bz
        xx, zz, xy, yz, c, s = _rotated(xx, zz, xz, xy, yz)
        xz = 0.0
        ax, cx = c * ax - s * cx, s * ax + c * cx
        ay, cy = c * ay - s * cy, s * ay + c * cy
        az, cz = c * az - s * cz, s * az + c * cz
        yy, zz, xy, xz, c, s = _rotated(yy, zz, yz, xy, xz)
        yz = 0.0
        bx, cx = c * bx - s * cx, s * bx + c * cx
        by, cy = c * by - s * cy, s * by + c * cy
        bz, cz = c * bz - s * cz, s * bz + c * cz
    least, normal = xx, (ax, ay, az)
    if yy < least:
        least, normal = yy, (bx, by, bz)
    if zz < least:
        least, normal = zz, (cx, cy, cz)
    largest = max(xx, yy, zz)
    middle = max(min(xx, yy), min(max(xx, yy), zz))
    return max(largest, 0.0), max(middle, 0.0), max(least, 0.0), normal


@njit(cache=True, nogil=True, inline="always")
def _rotated(
    pp: float, qq: float, pq: float, pr: float, qr: float
) -> tuple[float, float, float, float, float, float]:
    """Return pp, qq, pr, qr after the rotation in the plane of p and q that makes pq 0: (c, s)."""
    if pq == 0.0:
        return pp, qq, pr, qr, 1.0, 0.0
    theta = 0.5 * (qq - pp) / pq
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    return pp - t * pq, qq + t * pq, c * pr - s * qr, s * pr + c * qr, c, s
