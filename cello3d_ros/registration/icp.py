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
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.leaves import Indices, tree_order
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.candidates import (
    Candidates,
    Places,
    make_candidates,
    make_room,
    nearest,
)
from cello3d_ros.registration.search import Tree, build_tree, search

REASONS = ("", "max_iterations", "singular", "too_few_points")
_SLACK = 1.2  # search beyond the last trim limit, in squared distance
_MANY = 50  # registrations of one thread, from which on lists of candidates pay
_LARGEST_M = 1e6  # coordinate of the reference, so that float32 holds all distances
_N_BINS = 2048  # of the trim limit's histogram
_CONVERGED, _MAX_ITERATIONS, _SINGULAR, _TOO_FEW_POINTS = range(4)


class Registration(NamedTuple):
    """What one run of ICP found.

    T_ref_read: (4, 4), p_ref = T_ref_read p_read; n_iterations: steps taken; converged: whether
    the steps became small; reason: why not ("" or one of ``REASONS``); residual_rms_m: root mean
    square of the kept associations' errors at the last step; n_associations: how many were kept.
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


class _Pair(NamedTuple):
    """Two sets of points as the kernels want them: about the reference's mean."""

    reading: Array
    reference: Array
    normals: Array
    near: Tree | Places
    mean: Array


def icp(
    reading: Array, reference: Array, normals: Array, T_init: Array, config: IcpConfig
) -> Registration:
    """Register all the given points.

    reading: (M, 3); reference, normals: (N, 3); T_init: (4, 4), the first guess of T_ref_read.
    Never raises on geometry: a registration without an answer keeps the last pose it had and
    says why.
    """
    reading = np.ascontiguousarray(reading)
    return _icp_in_order(reading[tree_order(reading)], reference, normals, T_init, config)


def register(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    config: IcpConfig,
    rng: np.random.Generator,
) -> Registration:
    """Register random subsamples of two clouds, drawn anew: they are part of ICP's noise."""
    read = subsample(len(reading.points), config.n_reading_points, rng)
    ref = subsample(len(reference.points), config.n_reference_points, rng)
    points, normals = (rows.take(ref, axis=0) for rows in (reference.points, reference.normals))
    return _icp_in_order(reading.points.take(read, axis=0), points, normals, T_init, config)


def register_many(
    reading: Cloud,
    reference: Cloud,
    T_inits: Array,
    seeds: Sequence[Sequence[int]],
    config: IcpConfig,
    n_threads: int = 1,
) -> list[Registration]:
    """Register from many starts, each with subsamples of its own, as ``register`` does.

    T_inits: (n, 4, 4); seeds: n seeds of numpy's default generator.  Each result depends on its
    own start and seed only, hence not on the number of threads.  Where each draws the whole
    reference, many registrations share lists of candidates, which each thread makes for itself.
    """
    n, n_threads = len(T_inits), max(n_threads, 1)
    mean = reference.points.mean(axis=0)
    points = reference.points - mean
    is_shared = n >= _MANY * n_threads and _can_share(points, config)
    rooms: SimpleQueue[Candidates | None] = SimpleQueue()
    for _ in range(n_threads):
        rooms.put(make_candidates(points, config.n_neighbors) if is_shared else None)

    def one(i: int) -> Registration:
        rng, candidates = np.random.default_rng(seeds[i]), rooms.get()
        try:
            if candidates is None:
                return register(reading, reference, T_inits[i], config, rng)
            make_room(candidates)
            read = subsample(len(reading.points), config.n_reading_points, rng)
            index = Places(candidates, np.zeros(len(read), np.int32))
            pair = _Pair(reading.points.take(read, axis=0), points, reference.normals, index, mean)
            return _register_pair(pair, T_inits[i], config)
        finally:
            rooms.put(candidates)

    if n_threads == 1:
        return [one(i) for i in range(n)]
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(one, range(n)))


def _can_share(points: Array, config: IcpConfig) -> bool:
    """Return whether lists of candidates serve all registrations of a reference, and its size."""
    return bool(
        16 * config.n_neighbors <= len(points) <= config.n_reference_points
        and config.n_neighbors <= 16
        and np.abs(points).max() < _LARGEST_M
    )


def _icp_in_order(
    reading: Array, reference: Array, normals: Array, T_init: Array, config: IcpConfig
) -> Registration:
    """Register points, those of the reading in an order in which neighbours are near in space."""
    if len(reading) == 0 or len(reference) < config.n_neighbors:
        return _too_few(T_init)
    mean = reference.mean(axis=0)
    tree = build_tree(reference - mean)
    pair = _Pair(reading, tree.points, normals.take(tree.order, axis=0), tree, mean)
    return _register_pair(pair, T_init, config)


def _too_few(T_init: Array) -> Registration:
    return Registration(T_init.copy(), 0, False, REASONS[_TOO_FEW_POINTS], math.nan, 0)


def _register_pair(pair: _Pair, T_init: Array, config: IcpConfig) -> Registration:
    if len(pair.reading) == 0:
        return _too_few(T_init)
    T = T_init.copy()
    T[:3, 3] -= pair.mean
    status, n_iterations, rms, n_kept = _icp(
        pair.reading,
        pair.reference,
        pair.normals,
        pair.near,
        T,
        config.n_neighbors,
        config.trim_ratio,
        config.error_metric == "point_to_plane",
        config.max_iterations,
        config.n_smoothed,
        config.rotation_epsilon_rad,
        config.translation_epsilon_m,
    )
    T[:3, 3] += pair.mean
    return Registration(T, n_iterations, status == _CONVERGED, REASONS[status], rms, n_kept)


def _find(
    moved: Array, index: Tree | Places, cap2: float, distances2: Array, indices: Indices
) -> int:
    """Fill the k nearest points at most ``cap2`` away, squared, by one index or the other."""
    find: Callable[..., int] = search if isinstance(index, Tree) else nearest
    return find(moved, index, cap2, distances2, indices)


@overload(_find, strict=False)
def _find_compiled(
    moved: Any, index: Any, cap2: Any, distances2: Any, indices: Any
) -> Callable[..., int]:
    find = search if index.instance_class is Tree else nearest
    return lambda moved, index, cap2, distances2, indices: find(
        moved, index, cap2, distances2, indices
    )


@njit(cache=True, nogil=True)
def _icp(
    reading: Array,
    reference: Array,
    normals: Array,
    index: Tree | Places,
    T: Array,
    k: int,
    trim_ratio: float,
    to_plane: bool,
    max_iterations: int,
    n_smoothed: int,
    rotation_epsilon: float,
    translation_epsilon: float,
) -> tuple[int, int, float, int]:
    """Run ICP and move T in place; return status, iterations, residual RMS and kept count."""
    n = len(reading)
    R_start, t_start = T[:3, :3].copy(), T[:3, 3].copy()
    start = reading @ R_start.T + t_start  # steps are measured on the reading as it starts
    R, t = np.eye(3), np.zeros(3)
    distances2 = np.empty((n, k))
    indices = np.full((n, k), -1)
    rotation_steps = np.zeros(max_iterations)
    translation_steps = np.zeros(max_iterations)
    rms, n_kept, limit = np.nan, 0, np.inf
    for iteration in range(max_iterations):
        moved = start @ R.T + t
        limit = _associate(moved, index, trim_ratio, limit, distances2, indices)
        if to_plane:
            ok, dR, dt, rms, n_kept = _plane_step(
                moved, reference, normals, distances2, indices, limit
            )
        else:
            ok, dR, dt, rms, n_kept = _point_step(moved, reference, distances2, indices, limit)
        if not ok:
            return _SINGULAR, iteration, rms, n_kept
        t_new = dR @ t + dt
        rotation_steps[iteration] = _angle(dR)
        translation_steps[iteration] = np.linalg.norm(t_new - t)
        R, t = dR @ R, t_new
        T[:3, :3] = R @ R_start
        T[:3, 3] = R @ t_start + t
        if iteration + 1 >= n_smoothed:
            last = slice(iteration + 1 - n_smoothed, iteration + 1)
            if (
                rotation_steps[last].mean() < rotation_epsilon
                and translation_steps[last].mean() < translation_epsilon
            ):
                return _CONVERGED, iteration + 1, rms, n_kept
    return _MAX_ITERATIONS, max_iterations, rms, n_kept


@njit(cache=True, nogil=True)
def _associate(
    moved: Array,
    index: Tree | Places,
    trim_ratio: float,
    last_limit: float,
    distances2: Array,
    indices: Indices,
) -> float:
    """Fill the neighbours of each point up to the trim limit, and return that limit.

    The limit is the squared distance of rank ``int(k N trim_ratio)``.  Associations beyond it are
    dropped, so they are not searched for: the search stops a little beyond the last limit and
    leaves them infinite.  When enough are found, the found ones are the smallest of all, and the
    rank among them is exact; when not, the search is done again without that bound.
    """
    rank = min(int(distances2.size * trim_ratio), distances2.size - 1)
    cap2 = _SLACK * last_limit
    if _find(moved, index, cap2, distances2, indices) <= rank:
        cap2 = np.inf
        _find(moved, index, cap2, distances2, indices)
    return _of_rank(distances2.ravel(), rank, cap2)


@njit(cache=True, nogil=True)
def _of_rank(values: Array, rank: int, most: float) -> float:
    """Return the value that sorting would put at ``rank``, itself at most ``most``.

    The values, not negative, are counted into bins of equal width, and only those of the one bin
    that holds the rank are sorted.  Rounding cannot misplace any: a greater value never falls
    into a lower bin.
    """
    scale = _N_BINS / most if most > 0.0 else np.inf
    if not 0.0 < scale < np.inf:
        return float(np.partition(values, rank)[rank])
    counts = np.zeros(_N_BINS + 1, np.int64)
    for value in values:
        counts[int(min(value * scale, float(_N_BINS)))] += 1
    chosen, before = 0, 0
    while before + counts[chosen] <= rank:
        before += counts[chosen]
        chosen += 1
    inside = np.empty(counts[chosen])
    n_inside = 0
    for value in values:
        if int(min(value * scale, float(_N_BINS))) == chosen:
            inside[n_inside] = value
            n_inside += 1
    return float(np.partition(inside, rank - before)[rank - before])


@njit(cache=True, nogil=True)
def _plane_step(
    moved: Array,
    points: Array,
    normals: Array,
    distances2: Array,
    indices: Indices,
    limit: float,
) -> tuple[bool, Array, Array, float, int]:
    """Solve the point-to-plane normal equations: ok, rotation, translation, RMS, count.

    A row is (c, n), c = p x n, its error r.  The sums stay in registers, one name each.
    """
    c00 = c10 = c11 = c20 = c21 = c22 = 0.0
    n00 = n01 = n02 = n10 = n11 = n12 = n20 = n21 = n22 = 0.0
    m00 = m10 = m11 = m20 = m21 = m22 = 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = sum2 = 0.0
    n_kept = 0
    for i in range(len(moved)):
        x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
        for j in range(indices.shape[1]):
            if not distances2[i, j] <= limit:
                break
            p = indices[i, j]
            nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
            cx, cy, cz = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            r = (x - points[p, 0]) * nx + (y - points[p, 1]) * ny + (z - points[p, 2]) * nz
            c00, c10, c20 = c00 + cx * cx, c10 + cy * cx, c20 + cz * cx
            c11, c21, c22 = c11 + cy * cy, c21 + cz * cy, c22 + cz * cz
            n00, n01, n02 = n00 + nx * cx, n01 + nx * cy, n02 + nx * cz
            n10, n11, n12 = n10 + ny * cx, n11 + ny * cy, n12 + ny * cz
            n20, n21, n22 = n20 + nz * cx, n21 + nz * cy, n22 + nz * cz
            m00, m10, m20 = m00 + nx * nx, m10 + ny * nx, m20 + nz * nx
            m11, m21, m22 = m11 + ny * ny, m21 + nz * ny, m22 + nz * nz
            b0, b1, b2 = b0 - cx * r, b1 - cy * r, b2 - cz * r
            b3, b4, b5 = b3 - nx * r, b4 - ny * r, b5 - nz * r
            sum2 += r * r
            n_kept += 1
    A = np.array(  # the lower triangle is enough
        [
            [c00, 0.0, 0.0, 0.0, 0.0, 0.0],
            [c10, c11, 0.0, 0.0, 0.0, 0.0],
            [c20, c21, c22, 0.0, 0.0, 0.0],
            [n00, n01, n02, m00, 0.0, 0.0],
            [n10, n11, n12, m10, m11, 0.0],
            [n20, n21, n22, m20, m21, m22],
        ]
    )
    b = np.array([b0, b1, b2, b3, b4, b5])
    rms = math.sqrt(sum2 / max(n_kept, 1))
    ok = _solve(A, b)
    return ok, _rotation(b[:3]), b[3:], rms, n_kept


@njit(cache=True, nogil=True)
def _point_step(
    moved: Array, points: Array, distances2: Array, indices: Indices, limit: float
) -> tuple[bool, Array, Array, float, int]:
    """Return the rigid motion that best moves the kept points onto theirs (Umeyama 1991)."""
    from_mean, to_mean = np.zeros(3), np.zeros(3)
    n_kept = 0
    for i in range(len(moved)):
        for j in range(indices.shape[1]):
            if distances2[i, j] <= limit:
                from_mean += moved[i]
                to_mean += points[indices[i, j]]
                n_kept += 1
    from_mean /= max(n_kept, 1)
    to_mean /= max(n_kept, 1)
    H = np.zeros((3, 3))
    sum2 = 0.0
    for i in range(len(moved)):
        for j in range(indices.shape[1]):
            if distances2[i, j] <= limit:
                a = moved[i] - from_mean
                b = points[indices[i, j]] - to_mean
                sum2 += distances2[i, j]
                for u in range(3):
                    for v in range(3):
                        H[u, v] += a[u] * b[v]
    U, s, Vt = np.linalg.svd(H)
    R = Vt.T @ U.T
    if np.linalg.det(R) < 0.0:
        Vt[2] *= -1.0
        R = Vt.T @ U.T
    rms = math.sqrt(sum2 / max(n_kept, 1))
    ok = s[1] > 1e-12 * s[0]  # points on one line leave the turn about it free
    return ok, R, to_mean - R @ from_mean, rms, n_kept


@njit(cache=True, nogil=True)
def _solve(A: Array, b: Array) -> bool:
    """Solve A x = b in place by Cholesky from the lower triangle; False when singular.

    A is scaled to a unit diagonal first, so that the test of the pivots has no units.
    """
    n = len(b)
    scale = np.empty(n)
    for u in range(n):
        if not (A[u, u] > 0.0 and np.isfinite(A[u, u])):
            return False
        scale[u] = 1.0 / math.sqrt(A[u, u])
    for u in range(n):
        for v in range(u + 1):
            A[u, v] *= scale[u] * scale[v]
    for u in range(n):
        for v in range(u + 1):
            total = A[u, v]
            for w in range(v):
                total -= A[u, w] * A[v, w]
            if u != v:
                A[u, v] = total / A[v, v]
            elif total > 1e-12:
                A[u, u] = math.sqrt(total)
            else:
                return False
    for u in range(n):
        b[u] *= scale[u]
        for w in range(u):
            b[u] -= A[u, w] * b[w]
        b[u] /= A[u, u]
    for u in range(n - 1, -1, -1):
        for w in range(u + 1, n):
            b[u] -= A[w, u] * b[w]
        b[u] /= A[u, u]
    b *= scale
    return bool(np.isfinite(b).all())


@njit(cache=True, nogil=True)
def _rotation(omega: Array) -> Array:
    """Return the rotation by the angle |omega| about the axis omega."""
    angle = math.sqrt(omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2)
    K = np.array(
        [
            [0.0, -omega[2], omega[1]],
            [omega[2], 0.0, -omega[0]],
            [-omega[1], omega[0], 0.0],
        ]
    )
    if angle < 1e-150:
        return np.eye(3)
    s = math.sin(angle) / angle
    c = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    R: Array = np.eye(3) + s * K + c * (K @ K)
    return R


@njit(cache=True, nogil=True)
def _angle(R: Array) -> float:
    """Return the angle of a rotation, accurate near zero."""
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    return math.atan2(math.sqrt(x * x + y * y + z * z), R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
