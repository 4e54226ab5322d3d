"""Local shape of a cloud: normals, planarity and cylindricality of each point."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.covariances import covariances
from cello3d_ros.clouds.filters import crop_range, is_planar, limit_density
from cello3d_ros.clouds.leaves import WIDTH
from cello3d_ros.clouds.neighbors import NO_TREE, KdTree, build_tree
from cello3d_ros.clouds.particles import without_particles
from cello3d_ros.compiled import kernel
from cello3d_ros.config import CloudConfig
from cello3d_ros.errors import CloudError, PlanarCloudError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.threads import in_threads

_CHUNK = 256  # leaves of one task
WIDENINGS = (1, 2, 3)  # times the neighbours that are tried until they are not on a line


class Cloud(NamedTuple):
    """A filtered scan with its local shape, computed once and used in both roles.

    points: (N, 3), metres, sensor frame; normals: (N, 3), unit, sign arbitrary, 0 where there is
    no plane; planarity, cylindricality: (N,), in [0, 1]; tree: k-d tree of the points.  All but
    the points are empty before ``with_shape``, which brings the points into the order of the tree,
    so that neighbours in space are near in memory.
    """

    points: Array
    normals: Array
    planarity: Array
    cylindricality: Array
    tree: KdTree


def prepare(
    points: Array, config: CloudConfig, rng: np.random.Generator, n_threads: int = 1
) -> Cloud:
    """Filter a scan and compute its local shape.

    points: (N, 3) finite, sensor frame; the result does not depend on n_threads.  Raises
    CloudError when fewer than ``n_neighbors`` are left after the filters.
    """
    return with_shape(filtered(points, config, rng), config, n_threads)


def filtered(points: Array, config: CloudConfig, rng: np.random.Generator) -> Cloud:
    """Do the first part of ``prepare``: a cloud without tree and local shape, in given order."""
    cropped = crop_range(points, config.min_range_m, config.max_range_m)
    if config.min_support > 0.0:
        cropped = without_particles(cropped, config.min_support)
    kept = limit_density(cropped, config.voxel_m, config.max_points_per_voxel, rng)
    if len(kept) < config.n_neighbors:
        raise CloudError(
            f"{len(kept)} of {len(points)} points are left between {config.min_range_m:g} m and "
            f"{config.max_range_m:g} m, need at least {config.n_neighbors}"
        )
    if is_planar(kept):
        raise PlanarCloudError(
            "the cloud is a 2-D scan, all its points lie in one plane with the sensor: it leaves "
            "height, roll and pitch free; a 3-D lidar is needed"
        )
    return Cloud(kept, np.empty((0, 3)), np.empty(0), np.empty(0), NO_TREE)


def with_shape(cloud: Cloud, config: CloudConfig, n_threads: int = 1) -> Cloud:
    """Do the second part of ``prepare``, unless it has been done."""
    if has_shape(cloud):
        return cloud
    tree = build_tree(cloud.points, n_threads)
    shape = local_shape(tree, config.n_neighbors, n_threads, config.min_spread)
    return Cloud(tree.points, *shape, tree._replace(order=np.arange(len(tree.points))))


def has_shape(cloud: Cloud) -> bool:
    """Return whether the local shape of a cloud is known."""
    return len(cloud.normals) == len(cloud.points)


def local_shape(
    tree: KdTree, k: int, n_threads: int = 1, min_spread: float = 0.0
) -> tuple[Array, Array, Array]:
    """Return normals (N, 3), planarity (N,) and cylindricality (N,) of the points of a tree.

    Of the covariance of the k nearest points (the point itself among them), s1 >= s2 >= s3 being
    the square roots of its eigenvalues: the normal is the direction of s3, planarity is
    (s2 - s3) / s1 and cylindricality (s1 - s2) / s1; both are 0 where all neighbours coincide.
    Source: Demantke et al. 2011.

    Points on a line have no plane: where s2 / s1 is below ``min_spread``, as in one ring of a
    lidar, 2 k and 3 k neighbours are tried, and the normal is 0 if they are on a line as well.
    """
    n = len(tree.points)
    normals, planarity, cylindricality = np.empty((n, 3)), np.empty(n), np.empty(n)
    wanted = np.ones(n, np.bool_)

    def task(first: int, k: int) -> None:
        stop = min(first + _CHUNK, len(tree.lanes))
        part = slice(WIDTH * first, WIDTH * stop)
        if not wanted[part].any():
            return
        near = np.empty((stop - first, 6, WIDTH))
        covariances(tree.leaves, n, k, first, stop, wanted, near)
        _shape(near, wanted[part], normals[part], planarity[part], cylindricality[part])

    for factor in WIDENINGS if min_spread > 0.0 else WIDENINGS[:1]:
        starts = range(0, len(tree.lanes), _CHUNK)
        in_threads(partial(task, k=factor * k), starts, n_threads)
        wanted &= cylindricality > 1.0 - min_spread
    normals[wanted & (min_spread > 0.0)] = 0.0
    return normals, planarity, cylindricality


@kernel(error_model="numpy")
def _shape(
    near: Array,
    wanted: NDArray[np.bool_],
    normals: Array,
    planarity: Array,
    cylindricality: Array,
) -> None:
    """Fill the shape of each covariance of near, (L, 6, 16), that is wanted.

    Cyclic Jacobi rotations of sixteen matrices at a time, until what is left off the diagonal
    moves nothing in double precision: it enters the eigenvalues squared.  w holds the rows xx, yy,
    zz, xy, xz, yz, the directions a, b, c that become the eigenvectors of xx, yy, zz, and what is
    small beside the matrix.
    """
    w = np.empty(16 * 16)
    for g in range(len(near)):
        if not wanted[WIDTH * g : WIDTH * g + WIDTH].any():
            continue
        for lane in range(16):  # by element: an array set at once takes 2 s to compile
            for row in range(6):
                w[16 * row + lane] = near[g, row, lane]
            for row in range(6, 15):
                w[16 * row + lane] = 1.0 if row in (6, 10, 14) else 0.0
            w[15 * 16 + lane] = 1e-24 * (w[lane] + w[16 + lane] + w[32 + lane]) ** 2
        for _ in range(30):
            n_left = 0
            for lane in range(16):
                xy, xz, yz = w[48 + lane], w[64 + lane], w[80 + lane]
                n_left += xy * xy + xz * xz + yz * yz > w[240 + lane]
            if n_left == 0:
                break
            _sweep(w)
        _write(w, WIDTH * g, wanted, normals, planarity, cylindricality)


@kernel(error_model="numpy")
def _sweep(w: Array) -> None:
    """Rotate each matrix of w in the planes of x and y, x and z, y and z, if it needs it yet."""
    for lane in range(16):
        xx, yy, zz = w[lane], w[16 + lane], w[32 + lane]
        xy, xz, yz = w[48 + lane], w[64 + lane], w[80 + lane]
        ax, ay, az = w[96 + lane], w[112 + lane], w[128 + lane]
        bx, by, bz = w[144 + lane], w[160 + lane], w[176 + lane]
        cx, cy, cz = w[192 + lane], w[208 + lane], w[224 + lane]
        live = xy * xy + xz * xz + yz * yz > w[240 + lane]
        c, s, t = _rotation(xx, yy, xy, live)
        xx, yy, xz, yz = xx - t * xy, yy + t * xy, c * xz - s * yz, s * xz + c * yz
        xy = 0.0 if live else xy
        ax, bx = c * ax - s * bx, s * ax + c * bx
        ay, by = c * ay - s * by, s * ay + c * by
        az, bz = c * az - s * bz, s * az + c * bz
        c, s, t = _rotation(xx, zz, xz, live)
        xx, zz, xy, yz = xx - t * xz, zz + t * xz, c * xy - s * yz, s * xy + c * yz
        xz = 0.0 if live else xz
        ax, cx = c * ax - s * cx, s * ax + c * cx
        ay, cy = c * ay - s * cy, s * ay + c * cy
        az, cz = c * az - s * cz, s * az + c * cz
        c, s, t = _rotation(yy, zz, yz, live)
        yy, zz, xy, xz = yy - t * yz, zz + t * yz, c * xy - s * xz, s * xy + c * xz
        yz = 0.0 if live else yz
        bx, cx = c * bx - s * cx, s * bx + c * cx
        by, cy = c * by - s * cy, s * by + c * cy
        bz, cz = c * bz - s * cz, s * bz + c * cz
        w[lane], w[16 + lane], w[32 + lane] = xx, yy, zz
        w[48 + lane], w[64 + lane], w[80 + lane] = xy, xz, yz
        w[96 + lane], w[112 + lane], w[128 + lane] = ax, ay, az
        w[144 + lane], w[160 + lane], w[176 + lane] = bx, by, bz
        w[192 + lane], w[208 + lane], w[224 + lane] = cx, cy, cz


@kernel(inline="always", error_model="numpy")
def _rotation(pp: float, qq: float, pq: float, live: bool) -> tuple[float, float, float]:
    """Return cosine, sine and tangent of the rotation that makes pq 0; none if it is not live."""
    theta = 0.5 * (qq - pp) / pq
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    t = -t if theta < 0.0 else t
    t = t if live and pq != 0.0 else 0.0
    c = 1.0 / math.sqrt(t * t + 1.0)
    return c, t * c, t


@kernel(error_model="numpy")
def _write(
    w: Array,
    first: int,
    wanted: NDArray[np.bool_],
    normals: Array,
    planarity: Array,
    cylindricality: Array,
) -> None:
    """Write the wanted shapes of the diagonal matrices of w, from point ``first`` on."""
    for lane in range(min(16, len(normals) - first)):
        i = first + lane
        if not wanted[i]:
            continue
        xx, yy, zz = w[lane], w[16 + lane], w[32 + lane]
        axis = 6
        if yy < xx:
            axis = 9
        if zz < min(xx, yy):
            axis = 12
        for a in range(3):
            normals[i, a] = w[16 * (axis + a) + lane]
        largest, least = max(max(xx, yy), zz), min(min(xx, yy), zz)
        middle = max(min(xx, yy), min(max(xx, yy), zz))
        s1, s2 = math.sqrt(max(largest, 0.0)), math.sqrt(max(middle, 0.0))
        s3 = math.sqrt(max(least, 0.0))
        planarity[i] = (s2 - s3) / s1 if s1 > 0.0 else 0.0
        cylindricality[i] = (s1 - s2) / s1 if s1 > 0.0 else 0.0
