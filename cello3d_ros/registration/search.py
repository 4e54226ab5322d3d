"""The nearest neighbours of ICP: eight queries share a walk down the tree, then no branches.

The tree is that of ``clouds/leaves.py``.  Each query compares itself with the points of all leaves
that may hold a neighbour, sixteen at a time in single precision (``lanes.py``), and picks the
least; the winners are compared in double precision.  A comparison costs much less than a branch
that the processor cannot foresee, so that nothing is decided point by point.

Why the answers are exact:

- *Leaves.*  A box is left out only when it is beyond a distance that is known to hold k points:
  for most queries that to the farthest of the neighbours found by the search before.
- *Single precision.*  Points and queries are scaled by a power of two, so that no coordinate of a
  point is above 1.  With Q the greatest of a query, coordinates are wrong by 2^-24 of themselves
  and distances d by less than e = 2^-22 (1 + Q); keys lack ten bits, 2^-13 of d^2.  So whoever is
  as near as the k-th, at d, has a key below (d + e)^2 (1 + 2^-12) < d^2 (1 + 2^-11) + 2^13 e^2.
  All of these are put in order in double precision.

Of equally far points the first in the order they were given in wins, so that the answer does not
depend on the tree.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cello3d_ros.clouds.lanes import boxes_near, lowest_bit
from cello3d_ros.clouds.leaves import Indices, Leaves, build_leaves, leaves_near, tree_order
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.lanes import lane_keys, least_key_above

_GROUP = 8  # queries that walk together
_ROWS = 64  # leaves that are compared at a time, as many as six bits can number
_ABSENT = 0x7F800000  # keys from here on are of no point
_FAR2 = 1.7e308  # no finite squared distance is searched for beyond
_FARTHEST = 1e15  # coordinate of a query, scaled, for which float32 holds all distances


class Tree(NamedTuple):
    """N points and what finds the nearest of them.

    order: (N,), the tree's order of the points as they were given; points: (N, 3) in that order;
    lanes: (L, 3, 16), its leaves times ``scale``.
    """

    order: Indices
    points: Array
    lanes: NDArray[np.float32]
    scale: float
    leaves: Leaves


def build_tree(points: Array) -> Tree:
    """Build the tree of (N, 3) points, N > 0."""
    order = tree_order(points)
    points = points.take(order, axis=0)
    leaves = build_leaves(points)
    scale = 2.0 ** -math.frexp(float(np.abs(points).max()))[1]
    return Tree(order, points, (leaves.points * scale).astype(np.float32), scale, leaves)


@njit(cache=True, nogil=True)
def search(moved: Array, tree: Tree, cap2: float, distances2: Array, indices: Indices) -> int:
    """Fill the k nearest points that are at most ``cap2`` away, squared; return how many.

    moved: (M, 3), neighbours in order near in space; distances2, indices: (M, k), closest first,
    infinite and -1 where there are fewer; indices are those of ``tree.points``.  On entry they
    hold the neighbours found by the search before, or -1: k points as good as any, the k-th
    neighbour cannot be farther than the farthest of them is now.  Eight queries in a row look for
    their leaves together: a leaf farther from the box around them than the farthest bound of them
    all concerns none of them.  (Functions that take arrays would cost more here than they do.)
    """
    order, points, lanes, scale, leaves = tree
    n, k = indices.shape
    n_leaves = len(lanes)
    near = np.empty(n_leaves, np.int64)  # the leaves near eight queries, and their boxes
    near_boxes = np.empty((n_leaves // 16 + 1, 6, 16))
    stack, box = np.empty(256, np.int64), np.empty(6)
    bounds2 = np.empty(_GROUP)
    keys, rows = np.empty((_ROWS, 16), np.int32), np.empty(_ROWS, np.int64)
    last = np.arange(k)  # some k points, to bound the distance of queries that have no bound
    cap2 = min(cap2, _FAR2)
    total = 0
    for start in range(0, n, _GROUP):
        stop = min(start + _GROUP, n)
        for a in range(3):
            box[a], box[3 + a] = np.inf, -np.inf
        far2 = 0.0
        for i in range(start, stop):
            x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
            for a in range(3):
                box[a], box[3 + a] = min(box[a], moved[i, a]), max(box[3 + a], moved[i, a])
            has_bound = indices[i, k - 1] >= 0
            bound2 = cap2
            if has_bound or (cap2 == _FAR2 and k <= len(points)):
                bound2 = 0.0
                for j in range(k):
                    p = indices[i, j] if has_bound else last[j]
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    bound2 = max(bound2, dx * dx + dy * dy + dz * dz)
            bounds2[i - start] = min(bound2, cap2)
            far2 = max(far2, bounds2[i - start])
        n_near = leaves_near(leaves, box, far2, stack, near, near_boxes)
        n_blocks = (n_near + 15) >> 4
        for i in range(start, stop):
            x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
            bound2 = bounds2[i - start]
            size = max(abs(x), abs(y), abs(z)) * scale
            if not size < _FARTHEST:
                total += _search_all(points, order, x, y, z, cap2, distances2[i], indices[i])
                continue
            xs, ys, zs = np.float32(x * scale), np.float32(y * scale), np.float32(z * scale)
            error2 = 2.0**-31 * (1.0 + size) ** 2
            n_found = block = mask = 0
            while mask or block < n_blocks:  # once, but where more than 64 leaves are near
                n_rows = 0
                while n_rows < _ROWS and (mask or block < n_blocks):
                    if not mask:
                        mask = boxes_near(near_boxes, block, x, y, z, bound2)
                        block += 1
                        continue
                    leaf = near[16 * block - 16 + lowest_bit(mask)]
                    mask &= mask - 1
                    lane_keys(lanes, leaf, xs, ys, zs, n_rows, keys)
                    rows[n_rows] = leaf
                    n_rows += 1
                most = np.int32(_ABSENT - 1)
                key = least_key_above(keys, n_rows, np.int32(-1))
                while key <= most:
                    p = 16 * rows[np.int64(key >> 4 & 63)] + np.int64(key & 15)
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    d2 = dx * dx + dy * dy + dz * dz
                    if n_found == k and not _is_before(
                        d2, order[p], distances2[i, k - 1], order[indices[i, k - 1]]
                    ):
                        key = least_key_above(keys, n_rows, key)
                        continue
                    n_found = min(n_found + 1, k)
                    j = n_found - 1
                    while j > 0:
                        other2, other = distances2[i, j - 1], indices[i, j - 1]
                        if not _is_before(d2, order[p], other2, order[other]):
                            break
                        distances2[i, j], indices[i, j] = other2, other
                        j -= 1
                    distances2[i, j], indices[i, j] = d2, p
                    if n_found == k:
                        bound2 = min(bound2, distances2[i, k - 1])
                        top2 = distances2[i, k - 1] * scale * scale * (1.0 + 2.0**-11) + error2
                        most = np.int32(np.float32(top2).view(np.int32) | 1023)
                    key = least_key_above(keys, n_rows, key)
            if n_found == k:
                for j in range(k):
                    last[j] = indices[i, j]
            for j in range(k):
                is_near = j < n_found and distances2[i, j] <= cap2
                total += is_near
                distances2[i, j] = distances2[i, j] if is_near else np.inf
                indices[i, j] = indices[i, j] if is_near else -1
    return total


@njit(cache=True, nogil=True)
def _search_all(
    points: Array,
    order: Indices,
    x: float,
    y: float,
    z: float,
    cap2: float,
    distances2: Array,
    indices: Indices,
) -> int:
    """Fill the neighbours of one query, looking at all points in double precision."""
    n_found = 0
    for p in range(len(points)):
        d2 = (points[p, 0] - x) ** 2 + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2
        if not d2 <= cap2:
            continue
        j = min(n_found, len(indices) - 1)
        if n_found == len(indices) and not _is_before(
            d2, order[p], distances2[j], order[indices[j]]
        ):
            continue
        n_found = min(n_found + 1, len(indices))
        while j > 0 and _is_before(d2, order[p], distances2[j - 1], order[indices[j - 1]]):
            distances2[j], indices[j] = distances2[j - 1], indices[j - 1]
            j -= 1
        distances2[j], indices[j] = d2, p
    distances2[n_found:], indices[n_found:] = np.inf, -1
    return n_found


@njit(cache=True, nogil=True, inline="always")
def _is_before(d2: float, rank: int, other2: float, other: int) -> bool:
    return bool(d2 < other2 or (d2 == other2 and rank < other))
