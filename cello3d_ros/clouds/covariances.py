"""Covariance of the neighbourhood of every point of a tree, in one compiled search.

Only which points are among the k nearest matters, not their order, so that no list is kept
sorted: the distances to all candidates are computed as vectors, then a threshold is looked for
that k of them do not exceed (``gathering`` collects them).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.gathering import FAR2, LEAST2, gather, make_room
from cello3d_ros.clouds.lanes import count_row, least_above
from cello3d_ros.clouds.leaves import WIDTH, Indices, Leaves
from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array

_FEW = 4  # distances left to go through one by one
_TRIES = 12  # thresholds tried before that


@kernel()
def covariances(
    leaves: Leaves,
    n: int,
    k: int,
    first: int,
    stop: int,
    wanted: NDArray[np.bool_],
    out: Array,
) -> None:
    """Fill out[g - first], (6, 16), for the wanted points of leaf g: xx, yy, zz, xy, xz, yz.

    n: points of the tree; k: neighbours, the point itself among them; all n where there are
    fewer; wanted: (n,).  Of equally far points the first in order are taken.  Lanes of points
    that are not wanted are zero.
    """
    points = leaves.points
    k = min(k, n)
    room = make_room(len(points))
    chosen = np.empty(16 * len(points) + 1, np.int64)
    box = np.empty(6)
    guess2 = most2 = LEAST2  # the last threshold; the greatest of the last leaf
    for g in range(first, stop):
        size = min(WIDTH, n - WIDTH * g)
        if not wanted[WIDTH * g : WIDTH * g + size].any():  # the guesses wait for the next leaf
            out[g - first] = 0.0
            continue
        for a in range(3):
            box[a], box[3 + a] = np.inf, -np.inf
            for lane in range(size):
                box[a] = min(box[a], points[g, a, lane])
                box[3 + a] = max(box[3 + a], points[g, a, lane])
        far2, most2, n_near = min(1.5 * most2, FAR2), LEAST2, -1
        out[g - first, :, size:] = 0.0
        for lane in range(size):
            if not wanted[WIDTH * g + lane]:
                out[g - first, :, lane] = 0.0
                continue
            x, y, z = points[g, 0, lane], points[g, 1, lane], points[g, 2, lane]
            n_rows, found, bound2, far2, n_near = gather(
                leaves, box, x, y, z, k, 1.3 * guess2, far2, FAR2, n_near, room
            )
            threshold2 = bound2
            if found > k:
                threshold2 = _threshold(room.distances2, n_rows, k, guess2, bound2, found)
            n_chosen = _choose(room.distances2, n_rows, k, threshold2, chosen)
            _covariance(points, room.found, chosen, n_chosen, x, y, z, out, g - first, lane)
            guess2 = max(threshold2, LEAST2)
            most2 = max(most2, guess2)


@kernel()
def _count(distances2: Array, n_rows: int, most2: float) -> int:
    n = 0
    for row in range(n_rows):
        n += count_row(distances2, row, most2)
    return n


@kernel()
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


@kernel()
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


@kernel(inline="always")
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
