"""The nearest neighbours of ICP: sixteen boxes or points at a time, in one search for neighbours.

Branches that a processor cannot foresee cost more here than arithmetic, so the tree has sixteen
children a node and sixteen points a leaf, and one comparison of sixteen lanes says which of them
are near enough: a bit mask, walked bit by bit.  Points are first sorted like those of a k-d tree:
each run of sixteen is a leaf, each run of sixteen boxes a node.

Why the answers are exact: a box or a point is left out only when it is beyond a distance that is
known to hold k points.  Box distances are rounded like point distances and every operation is
monotone, so that a box is never farther than a point in it.  Of equally far points the first in
the order they were given in wins, so that the answer does not depend on the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from cello3d_ros.clouds.neighbors import Indices, select
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.lanes import lowest_bit

_WIDTH = 16  # children of a node, points of a leaf
_FAR2 = 1.7e308  # below infinity, so that empty lanes are never near


class Leaves(NamedTuple):
    """A tree over N points, sixteen children a node.

    points: (L, 3, 16), point p being lane p % 16 of leaf p // 16, empty lanes infinite; boxes:
    (B, 6, 16), least and greatest coordinates of each node's children, the root last; children:
    (B,), each node's first child: a leaf below L, node c - L otherwise; order: (N,) the points'
    rank where they are equally far.
    """

    points: Array
    boxes: Array
    children: Indices
    order: Indices


@njit(cache=True, nogil=True)
def tree_order(points: Array) -> Indices:
    """Return an order of (N, 3) points in which each aligned run of 16, 256, ... is compact.

    Ranges are halved across their longest side, at a multiple of the greatest power of sixteen
    below their size, so that leaves and nodes never straddle a cut.
    """
    n = len(points)
    order = np.arange(n)
    stack = np.empty((128, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, n
    top = 1
    while top > 0:
        top -= 1
        lo, hi = stack[top, 0], stack[top, 1]
        size = hi - lo
        if size <= _WIDTH:
            continue
        unit = _WIDTH
        while unit * _WIDTH < size:
            unit *= _WIDTH
        middle = lo + unit * max(1, (size // 2 + unit // 2) // unit)
        x0 = y0 = z0 = np.inf
        x1 = y1 = z1 = -np.inf
        for i in range(lo, hi):
            x, y, z = points[order[i], 0], points[order[i], 1], points[order[i], 2]
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
        axis = 0
        if y1 - y0 > x1 - x0:
            axis = 1
        if z1 - z0 > max(x1 - x0, y1 - y0):
            axis = 2
        select(points, order, lo, hi - 1, middle, axis)
        stack[top, 0], stack[top, 1] = lo, middle
        stack[top + 1, 0], stack[top + 1, 1] = middle, hi
        top += 2
    return order


@njit(cache=True, nogil=True)
def build_leaves(points: Array, order: Indices) -> Leaves:
    """Build the tree of (N, 3) points, N > 0, given in their ``tree_order``."""
    n = len(points)
    n_leaves = (n + _WIDTH - 1) // _WIDTH
    lanes = np.full((n_leaves, 3, _WIDTH), np.inf)
    n_nodes = size = (n_leaves + _WIDTH - 1) // _WIDTH
    while size > 1:
        size = (size + _WIDTH - 1) // _WIDTH
        n_nodes += size
    boxes = np.empty((n_nodes, 6, _WIDTH))
    boxes[:, :3] = np.inf
    boxes[:, 3:] = -np.inf
    for i in range(n):
        g, lane = i // _WIDTH, i % _WIDTH
        for a in range(3):
            value = points[i, a]
            lanes[g, a, lane] = value
            node, child = g // _WIDTH, g % _WIDTH
            boxes[node, a, child] = min(boxes[node, a, child], value)
            boxes[node, 3 + a, child] = max(boxes[node, 3 + a, child], value)
    children = np.empty(n_nodes, np.int64)
    below, start, size = 0, 0, (n_leaves + _WIDTH - 1) // _WIDTH  # of one level
    while True:
        for i in range(size):
            children[start + i] = below + _WIDTH * i
        if size == 1:
            return Leaves(lanes, boxes, children, order)
        for i in range(size):
            node, child = start + size + i // _WIDTH, i % _WIDTH
            for a in range(3):
                boxes[node, a, child] = boxes[start + i, a].min()
                boxes[node, 3 + a, child] = boxes[start + i, 3 + a].max()
        below, start, size = n_leaves + start, start + size, (size + _WIDTH - 1) // _WIDTH


@njit(cache=True, nogil=True)
def search(moved: Array, leaves: Leaves, cap2: float, distances2: Array, indices: Indices) -> int:
    """Fill the k nearest points that are at most ``cap2`` away, squared; return how many.

    moved: (M, 3), neighbours in order near in space; distances2, indices: (M, k), closest first,
    infinite and -1 where there are fewer.  On entry ``indices`` holds the neighbours found by the
    search before, or -1: k points as good as any, the k-th neighbour cannot be farther than the
    farthest of them is now.  Eight queries in a row look for their leaves together: a leaf
    farther from the box around them than the farthest bound of them all concerns none of them.
    Each of them then compares itself with those leaves only, not with the tree.
    """
    points, boxes, children, order = leaves
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
            mask = _boxes_near_box(boxes, node, x0, y0, z0, x1, y1, z1, far2)
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
                mask = _boxes_near_point(near_boxes, block, x, y, z, bound2)
                while mask:
                    leaf = near[16 * block + lowest_bit(mask)]
                    mask &= mask - 1
                    hits = _points_near(points, leaf, x, y, z, bound2)
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
    """Return the squared distance of a point, rounded as in ``_points_near``."""
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


@njit(cache=True, nogil=True)
def _boxes_near_box(
    boxes: Array,
    node: int,
    x0: float,
    y0: float,
    z0: float,
    x1: float,
    y1: float,
    z1: float,
    far2: float,
) -> int:
    """Return a mask of the node's boxes at most ``far2`` from the box (x0..x1, ...), squared."""
    block = boxes[node]
    mask = 0
    for lane in range(16):
        dx = max(max(block[0, lane] - x1, x0 - block[3, lane]), 0.0)
        dy = max(max(block[1, lane] - y1, y0 - block[4, lane]), 0.0)
        dz = max(max(block[2, lane] - z1, z0 - block[5, lane]), 0.0)
        if dx * dx + dy * dy + dz * dz <= far2:
            mask |= 1 << lane
    return mask


@njit(cache=True, nogil=True)
def _boxes_near_point(boxes: Array, node: int, x: float, y: float, z: float, far2: float) -> int:
    """Return a mask of the node's boxes at most ``far2`` from a point, squared."""
    block = boxes[node]
    mask = 0
    for lane in range(16):
        dx = max(max(block[0, lane] - x, x - block[3, lane]), 0.0)
        dy = max(max(block[1, lane] - y, y - block[4, lane]), 0.0)
        dz = max(max(block[2, lane] - z, z - block[5, lane]), 0.0)
        if dx * dx + dy * dy + dz * dz <= far2:
            mask |= 1 << lane
    return mask


@njit(cache=True, nogil=True)
def _points_near(points: Array, leaf: int, x: float, y: float, z: float, far2: float) -> int:
    """Return a mask of the leaf's points at most ``far2`` away, squared.

    The limit from below changes no difference: it makes the compiler use vectors.
    """
    block = points[leaf]
    mask = 0
    for lane in range(16):
        dx = max(block[0, lane] - x, -_FAR2)
        dy = max(block[1, lane] - y, -_FAR2)
        dz = max(block[2, lane] - z, -_FAR2)
        if dx * dx + dy * dy + dz * dz <= far2:
            mask |= 1 << lane
    return mask
