"""ICP of the paper's Table I: k nearest neighbours, one trim quantile, point-to-plane.

The rules are those of libpointmatcher, so that results can be compared number by number:

1. work in the frame of the reference, moved to the mean of its points;
2. associate each reading point with its k nearest reference points, exactly;
3. keep the associations whose squared distance is at most that of rank ``int(k N trim_ratio)``
   over all of them together; each kept one is an equation of weight 1;
4. point_to_plane: solve the 6x6 normal equations, take the rotation by angle and axis and the
   translation as it is; point_to_point: the rigid motion of least squares (Umeyama 1991);
   the step multiplies on the left;
5. stop when the mean rotation and the mean translation of the last steps are both below their
   limits, or after ``max_iterations``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.leaves import tree_order
from cello3d_ros.clouds.neighbors import Indices, KdTree, build_tree, nearest
from cello3d_ros.clouds.shape import Cloud, has_shape
from cello3d_ros.config import IcpConfig
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.kernels import (
    begin,
    compound,
    finish,
    move,
    plane_step,
    point_step,
    trim_limit,
)

_SLACK = 1.2  # search beyond the last trim limit, in squared distance


class Registration(NamedTuple):
    """What one run of ICP found.

    T_ref_read: (4, 4), p_ref = T_ref_read p_read; n_iterations: steps taken; converged: whether
    the steps became small; reason: why not ("max_iterations", "singular", "too_few_points" or "");
    residual_rms_m: root mean square of the kept associations' errors at the last step;
    n_associations: how many were kept.
    """

    T_ref_read: Array
    n_iterations: int
    converged: bool
    reason: str
    residual_rms_m: float
    n_associations: int

    @property
    def has_answer(self) -> bool:
        """Whether the pose means anything: one that ran out of iterations still does."""
        return self.reason in ("", "max_iterations")


def icp(
    reading: Array, reference: Array, normals: Array, T_init: Array, config: IcpConfig
) -> Registration:
    """Register all the given points.

    reading: (M, 3); reference, normals: (N, 3); T_init: (4, 4), the first guess of T_ref_read.
    Never raises on geometry: a registration without an answer keeps the last pose it had and
    says why.
    """
    reading = np.ascontiguousarray(reading, dtype=np.float64)
    if len(reading) == 0 or len(reference) == 0:
        return _too_few(T_init)
    tree = build_tree(reference)
    reading = reading.take(tree_order(reading), axis=0)
    return _register(reading, tree, normals.take(tree.order, axis=0), T_init, config)


def register(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    config: IcpConfig,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Registration:
    """Register random subsamples of two clouds, drawn anew: they are part of ICP's noise.

    The whole reference is searched by the tree that it has; a part of it has one built.
    n_threads changes no bit of the result.
    """
    read = subsample(len(reading.points), config.n_reading_points, rng)
    ref = subsample(len(reference.points), config.n_reference_points, rng)
    if len(read) == 0 or len(ref) == 0:
        return _too_few(T_init)
    tree, normals = reference.tree, reference.normals
    if len(ref) < len(reference.points):
        tree = build_tree(reference.points.take(ref, axis=0))
        normals = normals.take(ref.take(tree.order), axis=0)
    points = reading.points.take(read, axis=0)
    if not has_shape(reading):  # then it is in no order yet
        points = points.take(tree_order(points), axis=0)
    return _register(points, tree, normals, T_init, config, n_threads)


def _register(
    reading: Array,
    tree: KdTree,
    normals: Array,
    T_init: Array,
    config: IcpConfig,
    n_threads: int = 1,
) -> Registration:
    """Register points, those of the reading in an order in which neighbours are near in space.

    normals: (N, 3), in the order of the tree.
    """
    if len(tree.points) < config.n_neighbors:
        return _too_few(T_init)
    T = np.array(T_init, np.float64, order="C")
    mean = np.einsum("ij->j", tree.points) / len(tree.points)  # faster than numpy's mean
    start, motion = begin(T, reading, mean), np.eye(4)  # about the mean
    moved, queries = np.empty_like(start), np.empty_like(start)
    steps: list[tuple[float, float]] = []  # rotation and translation
    reason, rms, n_kept, limit2 = "max_iterations", math.nan, 0, math.inf
    while len(steps) < config.max_iterations and reason == "max_iterations":
        move(motion, start, mean, moved, queries)
        associations = _associate(tree, queries, limit2, config, n_threads)
        limit2 = associations[2]
        if config.error_metric == "point_to_plane":
            found = plane_step(moved, queries, tree.points, normals, *associations)
        else:
            found = point_step(moved, mean, tree.points, *associations)
        ok, step, rms, n_kept = found
        if not ok:
            reason = "singular"
            continue
        steps.append(compound(step, motion))
        if len(steps) >= config.n_smoothed and _is_still(steps[-config.n_smoothed :], config):
            reason = ""
    finish(motion, T, mean)
    return Registration(T, len(steps), reason == "", reason, rms, n_kept)


def _associate(
    tree: KdTree, queries: Array, last_limit2: float, config: IcpConfig, n_threads: int
) -> tuple[Array, Indices, float]:
    """Return the neighbours of each point up to the trim limit, and that limit, squared.

    The limit is the squared distance of rank ``int(k N trim_ratio)``.  Associations beyond it are
    dropped, so they are not searched for: the search stops a little beyond the last limit and
    leaves them infinite.  When enough are found, the found ones are the smallest of all, and the
    rank among them is exact; when not, the search is done again without that bound.
    """
    k = config.n_neighbors
    rank = min(int(k * len(queries) * config.trim_ratio), k * len(queries) - 1)
    distances2, indices = nearest(tree, queries, k, n_threads, _SLACK * last_limit2)
    limit2 = trim_limit(distances2, rank)
    if not limit2 < math.inf:
        distances2, indices = nearest(tree, queries, k, n_threads)
        limit2 = trim_limit(distances2, rank)
    return distances2, indices, limit2


def _is_still(steps: list[tuple[float, float]], config: IcpConfig) -> bool:
    """Return whether the mean of the steps is below both limits."""
    rotation = sum(step[0] / len(steps) for step in steps)
    translation = sum(step[1] / len(steps) for step in steps)
    return rotation < config.rotation_epsilon_rad and translation < config.translation_epsilon_m


def _too_few(T_init: Array) -> Registration:
    return Registration(T_init.copy(), 0, False, "too_few_points", math.nan, 0)
