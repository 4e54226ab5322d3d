"""Exact nearest neighbours of many queries, sixteen at a time.

They serve the local shape of a cloud and the overlap of two, hence this lowest room; ICP has a
search of its own (``registration/search.py``).  Sixteen queries in a row look for their leaves
together, within a radius that is guessed from the queries before.  The guess is verified: where
it holds fewer than k points the search is done again with a greater one, so that the answers are
exact whatever the guess, and do not depend on how the queries are shared among threads.  Of
equally far points the first in the order of the tree wins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cello3d_ros.clouds.lanes import (
    boxes_near,
    distances_of,
    lanes_of,
    least_above,
    lowest_bit,
)
from cello3d_ros.clouds.leaves import (
    WIDTH,
    Indices,
    Leaves,
    build_leaves,
    in_threads,
    leaves_near,
    tree_order,
)
from cello3d_ros.geometry.se3 import Array

__all__ = ["Indices", "KdTree", "any_within", "build_tree", "nearest"]

_FAR2 = 1.7e308  # no finite squared distance is searched for beyond
_CHUNK = 4096  # queries of one task, a multiple of 16
_LEAST2 = 1e-290  # from where a radius grows that was guessed to be nothing


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
        _nearest(tree.leaves, queries[part], max_distance2, distances2[part], indices[part])

    parts = [slice(i, i + _CHUNK) for i in range(0, len(queries), _CHUNK)]
    in_threads(task, parts, n_threads)
    return distances2, indices


def any_within(
    tree: KdTree, queries: Array, radius: float, n_threads: int = 1
) -> NDArray[np.bool_]:
    """Return for each query (M, 3) whether a point of the tree is at most ``radius`` away."""
    _, indices = nearest(tree, queries, 1, n_threads, radius**2)
    return np.asarray(indices[:, 0] >= 0)


@njit(cache=True, nogil=True)
def _nearest(
    leaves: Leaves, queries: Array, max2: float, distances2: Array, indices: Indices
) -> None:
    """Fill the neighbours of the queries, closest first.

    far2 is the search radius of the sixteen, squared, guess2 that of one: at most far2, less
    where the neighbours of the query before say so.  Both grow until k are found within.  The
    nearest are then taken from the distances to all candidates one by one, each the least that is
    left, which vectors find without a branch.  One function, for calls with arrays cost as much
    here as the search.
    """
    points = leaves.points
    n, k = indices.shape
    max2 = min(max2, _FAR2)
    near = np.empty(len(points), np.int64)
    near_boxes = np.empty((len(points) // 16 + 1, 6, 16))
    stack = np.empty(256, np.int64)
    candidates = np.empty(len(points), np.int64)  # leaves, and the distances to their points
    rows = np.empty(16 * len(points))
    box = np.empty(6)
    last2 = most2 = _LEAST2  # the last k-th distance, squared; the greatest of the last sixteen
    for start in range(0, n, WIDTH):
        stop = min(start + WIDTH, n)
        _box_around(queries, start, stop, box)
        far2 = min(1.5 * most2, max2)
        growth, most2, i, n_near = 2.0, _LEAST2, start, -1
        guess2 = min(1.5 * last2, far2)
        while i < stop:
            if n_near < 0:
                n_near = leaves_near(leaves, box, far2, stack, near, near_boxes)
            x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
            n_rows = found = 0
            for block in range((n_near + 15) >> 4):
                mask = boxes_near(near_boxes, block, x, y, z, guess2)
                while mask:
                    leaf = near[16 * block + lowest_bit(mask)]
                    mask &= mask - 1
                    candidates[n_rows] = leaf
                    found += distances_of(points, leaf, x, y, z, guess2, rows, n_rows)
                    n_rows += 1
            if found < k and guess2 < far2:
                guess2 = min(4.0 * guess2, far2)
                continue
            if found < k and far2 < max2:
                far2 = min(growth * far2, max2)
                growth, guess2, n_near = 2.0 * growth, far2, -1
                continue
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
                        indices[i, j] = 16 * candidates[first + (lane >> 4)] + (lane & 15)
                        j += 1
            last2 = max(value if found >= k else guess2, _LEAST2)
            guess2 = min(1.5 * last2, far2)
            most2 = max(most2, last2)
            while j < k:
                distances2[i, j], indices[i, j] = np.inf, -1
                j += 1
            i += 1


@njit(cache=True, nogil=True)
def _box_around(queries: Array, start: int, stop: int, box: Array) -> None:
    """Fill box, (6,), with the least and greatest coordinates of queries[start:stop]."""
    for a in range(3):
        box[a] = box[3 + a] = queries[start, a]
        for i in range(start + 1, stop):
            box[a] = min(box[a], queries[i, a])
            box[3 + a] = max(box[3 + a], queries[i, a])
