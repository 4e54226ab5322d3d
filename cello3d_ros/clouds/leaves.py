"""A tree of points for exact searches, sixteen boxes or points at a time.

Branches that a processor cannot foresee cost more here than arithmetic, so the tree has sixteen
children a node and sixteen points a leaf, and one comparison of sixteen lanes says which of them
are near enough: a bit mask, walked bit by bit.  Points are first sorted like those of a k-d tree:
each run of sixteen is a leaf, each run of sixteen boxes a node.

Why the answers are exact: a box or a point is left out only when it is beyond a distance within
which the points that are wanted were found.  Box distances are rounded like point distances and
every operation is monotone, so that a box is never farther than a point in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.lanes import boxes_near_box, lowest_bit
from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.threads import in_threads

Indices = NDArray[np.int64]

WIDTH = 16  # children of a node, points of a leaf


class Leaves(NamedTuple):
    """A tree over N points, sixteen children a node.

    points: (L, 3, 16), point p being lane p % 16 of leaf p // 16, empty lanes infinite; boxes:
    (B, 6, 16), least and greatest coordinates of each node's children, the root last; children:
    (B,), each node's first child: a leaf below L, node c - L otherwise.
    """

    points: Array
    boxes: Array
    children: Indices


def tree_order(points: Array, n_threads: int = 1) -> Indices:
    """Return an order of (N, 3) points in which each aligned run of 16, 256, ... is compact.

    Ranges are halved across their longest side, at a multiple of the greatest power of sixteen
    below their size, so that leaves and nodes never straddle a cut.  The cuts, hence the order, do
    not depend on the number of threads: each sorts a range of its own.
    """
    n = len(points)
    order, keys = np.arange(n), np.empty(n)
    ranges = [(0, n)]
    while len(ranges) < n_threads and n > WIDTH**3:
        halves = [(lo, hi, _halve(points, order, keys, lo, hi)) for lo, hi in ranges]
        ranges = [cut for lo, hi, middle in halves for cut in ((lo, middle), (middle, hi))]
    in_threads(lambda part: _sort_range(points, order, keys, *part), ranges, n_threads)
    return order


@kernel()
def _sort_range(points: Array, order: Indices, keys: Array, lo: int, hi: int) -> None:
    """Put order[lo:hi] into tree order; keys: scratch."""
    stack = np.empty((128, 2), np.int64)
    stack[0, 0], stack[0, 1] = lo, hi
    top = 1
    while top > 0:
        top -= 1
        lo, hi = stack[top, 0], stack[top, 1]
        if hi - lo <= WIDTH:
            continue
        middle = _halve(points, order, keys, lo, hi)
        stack[top, 0], stack[top, 1] = lo, middle
        stack[top + 1, 0], stack[top + 1, 1] = middle, hi
        top += 2


@kernel()
def _halve(points: Array, order: Indices, keys: Array, lo: int, hi: int) -> int:
    """Cut order[lo:hi] across the longest side of its box; return where."""
    if hi - lo <= WIDTH:
        return hi
    unit = WIDTH
    while unit * WIDTH < hi - lo:
        unit *= WIDTH
    middle = lo + unit * max(1, ((hi - lo) // 2 + unit // 2) // unit)
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
    for i in range(lo, hi):
        keys[i] = points[order[i], axis]
    select(keys, order, lo, hi, middle)
    return middle


@kernel()
def select(keys: Array, order: Indices, lo: int, hi: int, middle: int) -> None:
    """Partition keys[lo:hi], and order with them, so that sorting would cut them at ``middle``.

    One pass moves all keys below the pivot to the front without a branch.  When there are none,
    a pass moves those equal to it, so that every round ends with a shorter range.
    """
    while hi - lo > 1:
        a, b, c = keys[lo], keys[(lo + hi) // 2], keys[hi - 1]
        pivot = max(min(a, b), min(max(a, b), c))
        cut = lo
        for i in range(lo, hi):
            key, index = keys[i], order[i]
            keys[i], order[i] = keys[cut], order[cut]
            keys[cut], order[cut] = key, index
            cut += key < pivot
        if middle < cut:
            hi = cut
            continue
        if cut > lo:
            lo = cut
            continue
        for i in range(lo, hi):
            key, index = keys[i], order[i]
            keys[i], order[i] = keys[cut], order[cut]
            keys[cut], order[cut] = key, index
            cut += key <= pivot
        if middle < cut:
            return
        lo = cut


@kernel()
def build_leaves(points: Array) -> Leaves:
    """Build the tree of (N, 3) points, N > 0, given in ``tree_order``."""
    n = len(points)
    n_leaves = (n + WIDTH - 1) // WIDTH
    lanes = np.full((n_leaves, 3, WIDTH), np.inf)
    n_nodes = size = (n_leaves + WIDTH - 1) // WIDTH
    while size > 1:
        size = (size + WIDTH - 1) // WIDTH
        n_nodes += size
    boxes = np.empty((n_nodes, 6, WIDTH))
    boxes[:, :3] = np.inf
    boxes[:, 3:] = -np.inf
    for i in range(n):
        g, lane = i // WIDTH, i % WIDTH
        for a in range(3):
            value = points[i, a]
            lanes[g, a, lane] = value
            node, child = g // WIDTH, g % WIDTH
            boxes[node, a, child] = min(boxes[node, a, child], value)
            boxes[node, 3 + a, child] = max(boxes[node, 3 + a, child], value)
    children = np.empty(n_nodes, np.int64)
    below, start, size = 0, 0, (n_leaves + WIDTH - 1) // WIDTH  # of one level
    while True:
        for i in range(size):
            children[start + i] = below + WIDTH * i
        if size == 1:
            return Leaves(lanes, boxes, children)
        for i in range(size):
            node, child = start + size + i // WIDTH, i % WIDTH
            for a in range(3):
                boxes[node, a, child] = boxes[start + i, a].min()
                boxes[node, 3 + a, child] = boxes[start + i, 3 + a].max()
        below, start, size = n_leaves + start, start + size, (size + WIDTH - 1) // WIDTH


@kernel()
def leaves_near(
    leaves: Leaves,
    box: Array,
    far2: float,
    stack: Indices,
    near: Indices,
    near_boxes: Array,
) -> int:
    """Find the leaves at most ``far2``, squared, from a box; return how many, in order.

    box: (6,), least and greatest coordinates.  near: (>= L,), filled with the leaves' numbers,
    increasing; near_boxes: (>= L / 16, 6, 16), filled with their boxes, the empty lanes of the
    last block infinite; stack: (256,), scratch.
    """
    points, boxes, children = leaves
    n_leaves = len(points)
    x0, y0, z0, x1, y1, z1 = box
    n_near, top = 0, 1
    stack[0] = len(boxes) - 1
    while top > 0:
        top -= 1
        node = stack[top]
        mask = boxes_near_box(boxes, node, x0, y0, z0, x1, y1, z1, far2)
        if children[node] >= n_leaves:
            for lane in range(WIDTH - 1, -1, -1):  # the first ends on top
                if mask >> lane & 1:
                    stack[top] = children[node] + lane - n_leaves
                    top += 1
            continue
        while mask:
            lane = lowest_bit(mask)
            mask &= mask - 1
            near[n_near] = children[node] + lane
            for a in range(6):
                near_boxes[n_near >> 4, a, n_near & 15] = boxes[node, a, lane]
            n_near += 1
    for lane in range(n_near, (n_near + 15) & ~15):
        for a in range(6):
            near_boxes[lane >> 4, a, lane & 15] = np.inf
    return n_near
