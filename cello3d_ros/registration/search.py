"""The nearest neighbours of ICP for one registration: eight queries share a walk down the tree.

The tree is that of ``clouds/leaves.py``.  A box or a point is left out only when it is beyond a
distance that is known to hold k points: for most queries that to the farthest of the neighbours
found by the search before.  Of equally far points the first in the order they were given in wins,
so that the answer does not depend on the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from cello3d_ros.clouds.leaves import (
    Indices,
    Leaves,
    boxes_near,
    boxes_near_box,
    lowest_bit,
    points_near,
)
from cello3d_ros.geometry.se3 import Array

_FAR2 = 1.7e308  # no finite squared distance is searched for beyond


class Ranked(NamedTuple):
    """A tree and the rank, (N,), of its points where they are equally far."""

    leaves: Leaves
    order: Indices


@njit(cache=True, nogil=True)
def search(moved: Array, index: Ranked, cap2: float, distances2: Array, indices: Indices) -> int:
    """Fill the k nearest points that are at most ``cap2`` away, squared; return how many.

    moved: (M, 3), neighbours in order near in space; distances2, indices: (M, k), closest first,
    infinite and -1 where there are fewer.  On entry ``indices`` holds the neighbours found by the
    search before, or -1: k points as good as any, the k-th neighbour cannot be farther than the
    farthest of them is now.  Eight queries in a row look for their leaves together: a leaf
    farther from the box around them than the farthest bound of them all concerns none of them.
    Each of them then compares itself with those leaves only, not with the tree.
    """
    (points, boxes, children), order = index
    n, k = indices.shape
    n_leaves = len(points)
    near = np.empty(n_leaves, np.int64)  # the leaves near eight queries, and their boxes
    near_boxes = np.empty((n_leaves // 16 + 1, 6, 16))
    stack = np.empty(256, np.int64)
    bounds2 = np.empty(8)
    last = np.arange(k)  # some k points, to bound the distance of queries that have no bound
    cap2 = min(cap2, _FAR2)
    total = 0
    for start in range(0, n, 8):
        stop = min(start + 8, n)
        x0 = y0 = z0 = np.inf
        x1 = y1 = z1 = -np.inf
        far2 = 0.0
        for i in range(start, stop):
            x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
            bound2 = 0.0
            if indices[i, k - 1] >= 0:
                for j in range(k):
                    p = indices[i, j]
                    bound2 = max(bound2, _distance2(points, p >> 4, p & 15, x, y, z))
            elif cap2 < _FAR2:
                bound2 = cap2
            else:
                for j in range(k):
                    p = last[j]
                    bound2 = max(bound2, _distance2(points, p >> 4, p & 15, x, y, z))
            bounds2[i - start] = min(bound2, cap2)
            far2 = max(far2, bounds2[i - start])
        n_near, top = 0, 1
        stack[0] = len(boxes) - 1
        while top > 0:
            top -= 1
            node = stack[top]
            mask = boxes_near_box(boxes, node, x0, y0, z0, x1, y1, z1, far2)
            while mask:
                lane = lowest_bit(mask)
                mask &= mask - 1
                child = children[node] + lane
                if child >= n_leaves:
                    stack[top] = child - n_leaves
                    top += 1
                    continue
                near[n_near] = child
                for a in range(6):
                    near_boxes[n_near >> 4, a, n_near & 15] = boxes[node, a, lane]
                n_near += 1
        n_blocks = (n_near + 15) >> 4
        for lane in range(n_near, 16 * n_blocks):
            for a in range(6):
                near_boxes[lane >> 4, a, lane & 15] = np.inf
        for i in range(start, stop):
            x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
            bound2 = bounds2[i - start]
            for j in range(k):
                distances2[i, j] = np.inf
                indices[i, j] = -1
            for block in range(n_blocks):
                mask = boxes_near(near_boxes, block, x, y, z, bound2)
                while mask:
                    leaf = near[16 * block + lowest_bit(mask)]
                    mask &= mask - 1
                    hits = points_near(points, leaf, x, y, z, bound2)
                    while hits:
                        lane = lowest_bit(hits)
                        hits &= hits - 1
                        d2 = _distance2(points, leaf, lane, x, y, z)
                        _insert(distances2, indices, i, d2, 16 * leaf + lane, order)
                    bound2 = min(bound2, distances2[i, k - 1])
            for j in range(k):
                total += indices[i, j] >= 0
            if indices[i, k - 1] >= 0:
                for j in range(k):
                    last[j] = indices[i, j]
    return total


@njit(cache=True, nogil=True, inline="always")
def _distance2(points: Array, leaf: int, lane: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point, rounded as in ``points_near``."""
    dx, dy, dz = points[leaf, 0, lane] - x, points[leaf, 1, lane] - y, points[leaf, 2, lane] - z
    return float(dx * dx + dy * dy + dz * dz)


@njit(cache=True, nogil=True, inline="always")
def _insert(
    distances2: Array, indices: Indices, i: int, d2: float, p: int, order: Indices
) -> None:
    """Put a point in its place among the neighbours of query i, the farthest falls out."""
    j = distances2.shape[1] - 1
    if d2 > distances2[i, j] or (d2 == distances2[i, j] and order[p] > order[indices[i, j]]):
        return
    while j > 0 and (
        d2 < distances2[i, j - 1]
        or (d2 == distances2[i, j - 1] and order[p] < order[indices[i, j - 1]])
    ):
        distances2[i, j], indices[i, j] = distances2[i, j - 1], indices[i, j - 1]
        j -= 1
    distances2[i, j], indices[i, j] = d2, p
