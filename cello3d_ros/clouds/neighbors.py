"""Exact nearest neighbours: a balanced k-d tree of boxes, in compiled kernels.

They serve the local shape of a cloud and the overlap of two, hence this lowest room; ICP has a
search of its own (``registration/search.py``).  The tree is implicit: node i has the children
2i + 1 and 2i + 2, and each half of a node's points goes to one child, so that only the nodes'
bounding boxes and the leaves' ranges of points are stored.  A box is pruned when its distance is
not below that of the k-th neighbour found so far: exact.  Kernels release the GIL, so that threads
can share a tree.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cello3d_ros.geometry.se3 import Array

Indices = NDArray[np.int64]

_LEAF = 12  # most points of a leaf; larger leaves scan more, smaller ones descend more
_CHUNK = 4096  # queries of one task


class KdTree(NamedTuple):
    """A tree over N points.

    points: (N, 3) in tree order; order: (N,) their indices in the given array; boxes: (2L - 1, 6)
    least and greatest coordinates of each node; leaves: (L + 1,) where each leaf's points start.
    """

    points: Array
    order: Indices
    boxes: Array
    leaves: Indices


def build_tree(points: Array) -> KdTree:
    """Build a k-d tree of (N, 3) finite points, N > 0."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    if len(points) == 0:
        raise ValueError("a k-d tree needs at least one point")
    order = np.arange(len(points))
    boxes, leaves = _build(points, order)
    return KdTree(points[order], order, boxes, leaves)


def nearest(tree: KdTree, queries: Array, k: int) -> tuple[Array, Indices]:
    """Return squared distances and tree-order indices of the k nearest points, closest first.

    queries: (M, 3).  Returns (M, k) and (M, k); infinite and -1 where the tree has fewer than k.
    """
    distances2 = np.empty((len(queries), k))
    indices = np.empty((len(queries), k), np.int64)

    def task(part: slice) -> None:
        _nearest_many(tree, queries[part], distances2[part], indices[part])

    in_chunks(task, len(queries))
    return distances2, indices


def any_within(tree: KdTree, queries: Array, radius: float) -> NDArray[np.bool_]:
    """Return for each query (M, 3) whether a point of the tree is at most ``radius`` away."""
    found = np.empty(len(queries), np.bool_)

    def task(part: slice) -> None:
        _any_within_many(tree, queries[part], radius**2, found[part])

    in_chunks(task, len(queries))
    return found


def in_chunks(task: Callable[[slice], Any], n: int) -> None:
    """Run ``task`` on slices that cover range(n), in threads; their results never overlap."""
    parts = [slice(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]
    n_threads = min(len(parts), os.cpu_count() or 1)
    if n_threads <= 1:
        for part in parts:
            task(part)
        return
    with ThreadPoolExecutor(n_threads) as pool:
        list(pool.map(task, parts))


@njit(cache=True, nogil=True)
def _build(points: Array, order: Indices) -> tuple[Array, Indices]:
    """Sort ``order`` into tree order, level by level; return the boxes and the leaves."""
    n_leaves = 1
    while n_leaves * _LEAF < len(points):
        n_leaves *= 2
    boxes = np.empty((2 * n_leaves - 1, 6))
    starts = np.empty(n_leaves + 1, np.int64)
    starts[0] = 0
    starts[1] = len(points)
    n_nodes = 1
    while True:
        level = boxes[n_nodes - 1 : 2 * n_nodes - 1]
        for i in range(n_nodes):
            _bound(points, order, starts[i], starts[i + 1], level[i])
        if n_nodes == n_leaves:
            return boxes, starts
        for i in range(n_nodes, 0, -1):  # halve each range, in place, from the last
            starts[2 * i] = starts[i]
            starts[2 * i - 1] = (starts[i - 1] + starts[i]) // 2
        for i in range(n_nodes):
            axis = int(np.argmax(level[i, 3:] - level[i, :3]))
            select(points, order, starts[2 * i], starts[2 * i + 2] - 1, starts[2 * i + 1], axis)
        n_nodes *= 2


@njit(cache=True, nogil=True)
def _bound(points: Array, order: Indices, lo: int, hi: int, box: Array) -> None:
    """Fill ``box`` with the least and greatest coordinates of a range."""
    for a in range(3):
        least = np.inf
        greatest = -np.inf
        for j in range(lo, hi):
            value = points[order[j], a]
            least = min(least, value)
            greatest = max(greatest, value)
        box[a] = least
        box[3 + a] = greatest


@njit(cache=True, nogil=True)
def select(points: Array, order: Indices, lo: int, hi: int, middle: int, axis: int) -> None:
    """Partition order[lo..hi] so that order[middle] is where sorting by ``axis`` would put it."""
    while lo < hi:
        pivot = points[order[(lo + hi) // 2], axis]
        i = lo
        j = hi
        while i <= j:
            while points[order[i], axis] < pivot:
                i += 1
            while points[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            hi = j
        elif middle >= i:
            lo = i
        else:
            return


@njit(cache=True, nogil=True, inline="always")
def _box_distance2(box: Array, x: float, y: float, z: float) -> float:
    """Return the squared distance from a point to a box, 0 inside."""
    dx = max(max(box[0] - x, x - box[3]), 0.0)
    dy = max(max(box[1] - y, y - box[4]), 0.0)
    dz = max(max(box[2] - z, z - box[5]), 0.0)
    return float(dx * dx + dy * dy + dz * dz)


@njit(cache=True, nogil=True)
def nearest_one(
    tree: KdTree,
    x: float,
    y: float,
    z: float,
    bound2: float,
    enough2: float,
    distances2: Array,
    indices: Indices,
    stack: Array,
) -> int:
    """Fill the neighbours of one query that are nearer than ``bound2``, squared; count them.

    The search ends early once the farthest neighbour is at most ``enough2`` away, squared.
    distances2, indices: (k,), closest first; infinite and -1 where fewer are found.  stack:
    (64, 2) scratch of (node, squared distance of its box).
    """
    points, _, boxes, leaves = tree
    k = len(distances2)
    distances2[:] = np.inf
    indices[:] = -1
    worst = bound2
    n_inner = len(leaves) - 2
    top = n_found = 0
    node = 0
    node2 = _box_distance2(boxes[0], x, y, z)
    while True:
        while node2 < worst and node < n_inner:  # to the nearer child; remember the other
            left = 2 * node + 1
            left2 = _box_distance2(boxes[left], x, y, z)
            right2 = _box_distance2(boxes[left + 1], x, y, z)
            left_first = left2 <= right2
            node = left if left_first else left + 1
            node2 = left2 if left_first else right2
            far2 = right2 if left_first else left2
            if far2 < worst:
                stack[top, 0] = 2 * left + 1 - node
                stack[top, 1] = far2
                top += 1
        if node2 < worst:
            for p in range(leaves[node - n_inner], leaves[node - n_inner + 1]):
                dx = points[p, 0] - x
                dy = points[p, 1] - y
                dz = points[p, 2] - z
                d2 = dx * dx + dy * dy + dz * dz
                if d2 < worst:
                    n_found = min(n_found + 1, k)
                    j = k - 1
                    while j > 0 and distances2[j - 1] > d2:
                        distances2[j] = distances2[j - 1]
                        indices[j] = indices[j - 1]
                        j -= 1
                    distances2[j] = d2
                    indices[j] = p
                    worst = min(worst, distances2[k - 1])
        if top == 0 or worst <= enough2:
            return n_found
        top -= 1
        node = int(stack[top, 0])
        node2 = stack[top, 1]


@njit(cache=True, nogil=True)
def _nearest_many(tree: KdTree, queries: Array, distances2: Array, indices: Indices) -> None:
    stack = np.empty((64, 2))
    for q in range(len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        nearest_one(tree, x, y, z, np.inf, -1.0, distances2[q], indices[q], stack)


@njit(cache=True, nogil=True)
def _any_within_many(
    tree: KdTree, queries: Array, radius2: float, found: NDArray[np.bool_]
) -> None:
    stack = np.empty((64, 2))
    distance2 = np.empty(1)
    index = np.empty(1, np.int64)
    bound2 = np.nextafter(radius2, np.inf)  # a point at the radius itself is within
    for q in range(len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        found[q] = nearest_one(tree, x, y, z, bound2, radius2, distance2, index, stack) > 0
