"""Sweeps: each scan registered to all its neighbours at once, again and again."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import cell_means
from cello3d_ros.clouds.neighbors import KdTree, build_tree, nearest
from cello3d_ros.clouds.shape import WIDENINGS, Cloud
from cello3d_ros.config import CloudConfig, IcpConfig, Pipeline
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, transform
from cello3d_ros.learning.align_chain import MIN_SHARE, share_on_surfaces
from cello3d_ros.learning.align_scans import ScanStore, ShapedScan, without_motion
from cello3d_ros.registration.icp import register

N_BEFORE = 8  # neighbours of a scan on either side
_N_POINTS = 8000  # of the reading
_EVERY = 0  # reference points: all
_CELL_M = 0.1  # side of the cells whose means make normals: docs/align.md
_MAX_MOVE_M, _MAX_MOVE_RAD = 1.0, 0.3  # a scan that a sweep moves farther does not hold


class AlignSettings(NamedTuple):
    """How scans are registered; n_threads changes no bit."""

    pipeline: Pipeline = Pipeline()
    seed: int = 0
    n_threads: int = 1


class Visit(NamedTuple):
    """What one scan's registration to its neighbours gave.

    T: (4, 4), its pose; moved: (6,), how it moved; share: of its points on their surfaces; holds:
    whether there was an answer; halves: (6,), between the registrations to either half of the
    neighbours, zeros if not asked for; shaped: the scan without its own motion, with normals of
    all scans.
    """

    T: Array
    moved: Array
    share: float
    holds: bool
    halves: Array
    shaped: ShapedScan


def sweep_icp(icp: IcpConfig) -> IcpConfig:
    """Return the settings of ICP in a sweep: those of the pipeline, to the end, of all points."""
    return replace(
        icp,
        backend="icp",
        error_metric="point_to_plane",
        rotation_epsilon_rad=1e-5,
        translation_epsilon_m=1e-4,
        max_iterations=40,
        n_reading_points=_N_POINTS,
        n_reference_points=_EVERY,
    )


def neighbors_of(k: int, keyframes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the keyframes around scan k: up to 8 before and 8 after it, itself left out."""
    before, after = np.searchsorted(keyframes, [k, k + 1])
    return np.concatenate(
        [keyframes[max(0, before - N_BEFORE) : before], keyframes[after : after + N_BEFORE]]
    )


def visit(
    k: int,
    poses: Array,
    neighbors: dict[int, ShapedScan],
    own: Array,
    settings: AlignSettings,
    wants_halves: bool,
) -> Visit:
    """Register scan k to the union of its neighbours, and find the normals of its points.

    poses: (n, 4, 4).  neighbors: scan -> its points.  own: (N, 3), points of scan k.
    The normals are those of all scans together, from the means of their points in cells.  The
    nearest of all points would do worse: those of scans a few cm apart are on one band of rings,
    as thick by noise as it is wide.
    """
    if not neighbors:
        alone = ShapedScan(own, np.zeros_like(own))
        return Visit(poses[k], np.zeros(6), 0.0, False, np.zeros(6), alone)
    pipeline, seed, n_threads = settings
    reading, union = cloud_of(own), gathered(poses[k], poses, neighbors)
    rng = np.random.default_rng([seed, k])
    found = register(reading, union, np.eye(4), sweep_icp(pipeline.icp), rng)
    moved = log(found.T_ref_read)
    share = share_on_surfaces(reading, union, found.T_ref_read, rng)
    is_near = np.linalg.norm(moved[:3]) < _MAX_MOVE_M and np.linalg.norm(moved[3:]) < _MAX_MOVE_RAD
    holds = found.has_answer and share >= MIN_SHARE and bool(is_near)
    step = exp(moved) if holds else np.eye(4)
    halves = np.zeros(6)
    if wants_halves and holds and len(neighbors) >= 2:
        halves = _halves(k, poses, neighbors, reading, step, settings)
    points = transform(step, reading.points)
    surface = build_tree(cell_means(np.concatenate([points, union.points]), _CELL_M))
    normals = common_normals(surface, points, pipeline.cloud, n_threads)
    shaped = ShapedScan(reading.points, normals @ step[:3, :3])
    return Visit(poses[k] @ step, moved, share, holds, halves, shaped)


def gathered(T_world: Array, poses: Array, scans: dict[int, ShapedScan]) -> Cloud:
    """Return the points and normals of scans as one cloud in the frame of a pose."""
    T = inverse(T_world) @ poses[list(scans)]
    points = np.concatenate([transform(M, s.points) for M, s in zip(T, scans.values())])
    normals = np.concatenate([s.normals @ M[:3, :3].T for M, s in zip(T, scans.values())])
    return cloud_of(points, normals)


def common_normals(tree: KdTree, points: Array, config: CloudConfig, n_threads: int = 1) -> Array:
    """Return the normals (N, 3) of points from their nearest neighbours in a tree.

    As in ``local_shape``: where the neighbours are on a line, two and three times as many are
    tried, and the normal is 0 if they are on a line as well.
    """
    normals, left = np.zeros(points.shape), np.arange(len(points))
    for factor in WIDENINGS:
        k = min(factor * config.n_neighbors, len(tree.points))
        near = tree.points[nearest(tree, points[left], k, n_threads)[1]]
        near -= near.mean(axis=1, keepdims=True)
        squares, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
        is_plane = squares[:, 1] >= config.min_spread**2 * squares[:, 2]
        normals[left[is_plane]] = axes[is_plane, :, 0]
        left = left[~is_plane]
    return normals


def _halves(
    k: int,
    poses: Array,
    neighbors: dict[int, ShapedScan],
    reading: Cloud,
    start: Array,
    settings: AlignSettings,
) -> Array:
    """Return ``log(T_a^-1 T_b)`` of the registrations to every other neighbour and to the rest."""
    found, icp = [], sweep_icp(settings.pipeline.icp)
    for part in (0, 1):
        some = dict(list(neighbors.items())[part::2])
        rng = np.random.default_rng([settings.seed, k, part])
        found.append(register(reading, gathered(poses[k], poses, some), start, icp, rng))
    return np.asarray(log(inverse(found[0].T_ref_read) @ found[1].T_ref_read))


def cloud_of(points: Array, normals: Array | None = None) -> Cloud:
    """Return points in the order of their tree."""
    tree = build_tree(points)
    normals = np.empty((0, 3)) if normals is None else normals.take(tree.order, axis=0)
    tree = tree._replace(order=np.arange(len(points)))
    return Cloud(tree.points, normals, np.empty(0), np.empty(0), tree)


def motion_of(
    k: int, poses: Array, stamps_ns: NDArray[np.int64], members: NDArray[np.int64]
) -> Array:
    """Return the velocity (6,) of scan k between its neighbours in time among the members."""
    at = int(np.searchsorted(members, k))
    i, j = int(members[max(0, at - 1)]), int(members[min(len(members) - 1, at + 1)])
    dt_s = 1e-9 * float(stamps_ns[j] - stamps_ns[i])
    return log(inverse(poses[i]) @ poses[j]) / dt_s if dt_s > 0.0 else np.zeros(6)


def own_points(store: ScanStore, k: int, velocity: Array) -> Array:
    """Return the points of scan k without the motion within it."""
    return without_motion(store.raw(k), velocity)
