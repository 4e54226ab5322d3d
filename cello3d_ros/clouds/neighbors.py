"""Exact nearest neighbours of many queries, sixteen at a time.

They serve ICP and the overlap of two clouds.  Sixteen queries in a row look for their leaves
together, within a radius that is guessed from the queries before and verified (``gathering``).
Of equally far points the first in the order of the tree wins.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.gathering import FAR2, LEAST2, gather, make_room
from cello3d_ros.clouds.lanes import lanes_of, least_above, lowest_bit
from cello3d_ros.clouds.leaves import (
    WIDTH,
    Indices,
    Leaves,
    build_leaves,
    tree_order,
)
from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.threads import in_threads

__all__ = ["NO_TREE", "Indices", "KdTree", "any_within", "build_tree", "nearest", "search"]

_CHUNK = 4096  # queries of one task, a multiple of 16


class KdTree(NamedTuple):
    """A tree over N points.

    points: (N, 3) in tree order; order: (N,) their indices in the given array; lanes, boxes,
    children: the fields of ``Leaves``.
    """

    points: Array
    order: Indices
    lanes: Array
    boxes: Array
    children: Indices

    @property
    def leaves(self) -> Leaves:
        """The part that is searched."""
        return Leaves(self.lanes, self.boxes, self.children)


_NONE = np.empty(0, np.int64)
NO_TREE = KdTree(np.empty((0, 3)), _NONE, np.empty((0, 3, 16)), np.empty((0, 6, 16)), _NONE)


def build_tree(points: Array, n_threads: int = 1) -> KdTree:
    """Build a tree of (N, 3) finite points, N > 0."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    if len(points) == 0:
        raise ValueError("a k-d tree needs at least one point")
    order = tree_order(points, n_threads)
    ordered = points.take(order, axis=0)  # four times as fast as an index
    return KdTree(ordered, order, *build_leaves(ordered))


def nearest(
    tree: KdTree, queries: Array, k: int, n_threads: int = 1, max_distance2: float = np.inf
) -> tuple[Array, Indices]:
    """Return squared distances and tree-order indices of the k nearest points, closest first.

    queries: (M, 3), fastest when neighbours in order are near in space; max_distance2: points
    farther, squared, are left out.  Returns (M, k) and (M, k); infinite and -1 where there are
    fewer than k.
    """
    queries = np.ascontiguousarray(queries, dtype=np.float64)
    distances2 = np.empty((len(queries), k))
    indices = np.empty((len(queries), k), np.int64)

    def task(part: slice) -> None:
        search(tree.leaves, queries[part], max_distance2, distances2[part], indices[part])

    size = min(_CHUNK, WIDTH * math.ceil(len(queries) / (WIDTH * max(n_threads, 1)))) or 1
    parts = [slice(i, i + size) for i in range(0, len(queries), size)]
    in_threads(task, parts, n_threads)
    return distances2, indices


def any_within(
    tree: KdTree, queries: Array, radius: float, n_threads: int = 1
) -> NDArray[np.bool_]:
    """Return for each query (M, 3) whether a point of the tree is at most ``radius`` away."""
    _, indices = nearest(tree, queries, 1, n_threads, radius**2)
    return np.asarray(indices[:, 0] >= 0)


@kernel()
def search(
    leaves: Leaves, queries: Array, max2: float, distances2: Array, indices: Indices
) -> int:
    """Fill the k nearest points at most ``max2`` away, squared; return how many there are.

    queries: (M, 3); distances2, indices: (M, k), as ``nearest`` returns them.  The k nearest are
    taken from the distances to all candidates one by one, each the least that is left, which
    vectors find without a branch.
    """
    n, k = indices.shape
    max2 = min(max2, FAR2)
    room = make_room(len(leaves.points))
    box = np.empty(6)
    last2 = most2 = LEAST2  # the last k-th distance, squared; the greatest of the last sixteen
    total = 0
    for start in range(0, n, WIDTH):
        stop = min(start + WIDTH, n)
        _box_around(queries, start, stop, box)
        far2, most2, n_near = min(1.5 * most2, max2), LEAST2, -1
        for i in range(start, stop):
            n_rows, found, bound2, far2, n_near = gather(
                leaves,
                box,
                queries[i, 0],
                queries[i, 1],
                queries[i, 2],
                k,
                1.5 * last2,
                far2,
                max2,
                n_near,
                room,
            )
            rows = room.distances2
            j, value = 0, -1.0
            while j < min(found, k):
                value = least_above(rows, n_rows, value)
                for first in range(0, n_rows, 4):  # four rows have room in a mask
                    mask = 0
                    for row in range(first, min(first + 4, n_rows)):
                        mask |= lanes_of(rows, row, value) << (16 * (row - first))
                    while mask and j < k:
                        lane = lowest_bit(mask)
                        mask &= mask - 1
                        distances2[i, j] = value
                        indices[i, j] = 16 * room.found[first + (lane >> 4)] + (lane & 15)
                        j += 1
            last2 = max(value if found >= k else bound2, LEAST2)
            most2 = max(most2, last2)
            total += j
            while j < k:
                distances2[i, j], indices[i, j] = np.inf, -1
                j += 1
    return total


@kernel()
def _box_around(queries: Array, start: int, stop: int, box: Array) -> None:
    """Fill box, (6,), with the least and greatest coordinates of queries[start:stop]."""
    for a in range(3):
        box[a] = box[3 + a] = queries[start, a]
        for i in range(start + 1, stop):
            box[a] = min(box[a], queries[i, a])
            box[3 + a] = max(box[3 + a], queries[i, a])
