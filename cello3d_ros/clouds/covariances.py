"""Covariance of the neighbourhood of every point of a tree, in one compiled search.

Only which points are among the k nearest matters, not their order, so that no list is kept
sorted: the distances to all candidates are computed as vectors, then a threshold is looked for
that k of them do not exceed.  The radius within which candidates are collected is guessed from the
point before, and verified (``neighbors``).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from cello3d_ros.clouds.lanes import boxes_near, count_row, distances_of, least_above, lowest_bit
from cello3d_ros.clouds.leaves import WIDTH, Indices, Leaves, leaves_near
from cello3d_ros.geometry.se3 import Array

_FAR2 = 1.7e308  # no finite squared distance is searched for beyond
_LEAST2 = 1e-290  # from where a radius grows that was guessed to be nothing
_FEW = 4  # distances left to go through one by one
_TRIES = 12  # thresholds tried before that


@njit(cache=True, nogil=True)
def covariances(leaves: Leaves, n: int, k: int, first: int, stop: int, out: Array) -> None:
    """Fill out[g - first], (6, 16), for the points of leaf g: xx, yy, zz, xy, xz, yz.

    n: points of the tree; k: neighbours, the point itself among them; all n where there are
    fewer.  Of equally far points the first in order are taken.  Lanes beyond the last point are
    zero.
    """
    points = leaves.points
    k = min(k, n)
    near = np.empty(len(points), np.int64)
    near_boxes = np.empty((len(points) // 16 + 1, 6, 16))
    stack = np.empty(256, np.int64)
    candidates = np.empty(len(points), np.int64)  # leaves, and the distances to their points
    distances2 = np.empty(16 * len(points))
    chosen = np.empty(16 * len(points) + 1, np.int64)
    box = np.empty(6)
    guess2 = most2 = _LEAST2  # the last threshold; the greatest of the last leaf
    for g in range(first, stop):
        size = min(WIDTH, n - WIDTH * g)
        for a in range(3):
            box[a], box[3 + a] = np.inf, -np.inf
            for lane in range(size):
                box[a] = min(box[a], points[g, a, lane])
                box[3 + a] = max(box[3 + a], points[g, a, lane])
        far2 = min(1.5 * most2, _FAR2)
        growth, most2, lane, n_near = 2.0, _LEAST2, 0, -1
        out[g - first, :, size:] = 0.0
        while lane < size:
            if n_near < 0:
                n_near = leaves_near(leaves, box, far2, stack, near, near_boxes)
            x, y, z = points[g, 0, lane], points[g, 1, lane], points[g, 2, lane]
            bound2 = min(1.3 * guess2, far2)
            n_candidates, found = _candidates(
                points, near, near_boxes, n_near, x, y, z, bound2, candidates, distances2
            )
            while found < k and bound2 < far2:
                bound2 = min(2.0 * bound2, far2)
                n_candidates, found = _candidates(
                    points, near, near_boxes, n_near, x, y, z, bound2, candidates, distances2
                )
            if found < k and far2 < _FAR2:
                far2 = min(growth * far2, _FAR2)
                growth, guess2, n_near = 2.0 * growth, far2, -1
                continue
            threshold2 = bound2
            if found > k:
                threshold2 = _threshold(distances2, n_candidates, k, guess2, bound2, found)
            n_chosen = _choose(distances2, n_candidates, k, threshold2, chosen)
            _covariance(points, candidates, chosen, n_chosen, x, y, z, out, g - first, lane)
            guess2 = max(threshold2, _LEAST2)
            most2 = max(most2, guess2)
            lane += 1


@njit(cache=True, nogil=True)
def _candidates(
    points: Array,
    near: Indices,
    near_boxes: Array,
    n_near: int,
    x: float,
    y: float,
    z: float,
    bound2: float,
    candidates: Indices,
    distances2: Array,
) -> tuple[int, int]:
    """Fill the leaves at most ``bound2`` away and the distances to their points, squared.

    Returns how many leaves, and how many of the points are within the bound.
    """
    n = found = 0
    for block in range((n_near + 15) >> 4):
        mask = boxes_near(near_boxes, block, x, y, z, bound2)
        while mask:
            leaf = near[16 * block + lowest_bit(mask)]
            mask &= mask - 1
            candidates[n] = leaf
            found += distances_of(points, leaf, x, y, z, bound2, distances2, n)
            n += 1
    return n, found


@njit(cache=True, nogil=True)
def _count(distances2: Array, n_rows: int, most2: float) -> int:
    n = 0
    for row in range(n_rows):
        n += count_row(distances2, row, most2)
    return n


@njit(cache=True, nogil=True)
def _threshold(
    distances2: Array, n_rows: int, k: int, guess2: float, high: float, n_high: int
) -> float:
    """Return a threshold that k distances do not exceed; more only where they are equal to it.

    n_high > k distances are at most ``high``.  Between a threshold with too few and one with too
    many, the next is interpolated, until one has k or few are left between: then one by one.
    """
    low, n_low = 0.0, 0
    middle = guess2 if 0.0 < guess2 < high else high * k / n_high
    for _ in range(_TRIES):
        if n_high - n_low <= _FEW or not low < middle < high:
            break
        n_middle = _count(distances2, n_rows, middle)
        if n_middle == k:
            return middle
        if n_middle < k:
            low, n_low = middle, n_middle
        else:
            high, n_high = middle, n_middle
        share = (k - n_low + 0.5) / (n_high - n_low + 1.0)
        middle = low + (high - low) * share
    threshold2 = low if n_low > 0 else -1.0  # nothing is known of those at 0
    while n_low < k:
        threshold2 = least_above(distances2, n_rows, threshold2)
        n_low = _count(distances2, n_rows, threshold2)
    return threshold2


@njit(cache=True, nogil=True)
def _choose(distances2: Array, n_rows: int, k: int, threshold2: float, chosen: Indices) -> int:
    """Fill the first k candidates within the threshold, all below it before any equal to it."""
    n = 0
    for c in range(16 * n_rows):
        chosen[n] = c
        n += distances2[c] <= threshold2
    if n <= k:
        return n
    n_below = _count(distances2, n_rows, np.nextafter(threshold2, -1.0))
    n_equal = k - n_below  # to be taken of the equal
    n = 0
    for c in range(16 * n_rows):
        chosen[n] = c
        n += distances2[c] < threshold2
        if distances2[c] == threshold2 and n_equal > 0:
            n += 1
            n_equal -= 1
    return n


@njit(cache=True, nogil=True, inline="always")
def _covariance(
    points: Array,
    candidates: Indices,
    chosen: Indices,
    n: int,
    x: float,
    y: float,
    z: float,
    out: Array,
    g: int,
    lane: int,
) -> None:
    """Fill out[g, :, lane] with the covariance of the chosen, taken relative to (x, y, z)."""
    mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
    for j in range(n):
        leaf, at = candidates[chosen[j] >> 4], chosen[j] & 15
        dx, dy, dz = points[leaf, 0, at] - x, points[leaf, 1, at] - y, points[leaf, 2, at] - z
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
    out[g, 0, lane] = xx / n - mx * mx
    out[g, 1, lane] = yy / n - my * my
    out[g, 2, lane] = zz / n - mz * mz
    out[g, 3, lane] = xy / n - mx * my
    out[g, 4, lane] = xz / n - mx * mz
    out[g, 5, lane] = yz / n - my * mz
