"""Candidates for the nearest neighbours: the part that all searches of a tree share.

A search guesses a radius from the queries before it.  The guess is verified: where it holds too
few points the candidates are collected again with a greater one, so that the answers are exact
whatever the guess, and do not depend on how queries are shared among threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.lanes import boxes_near, distances_of, lowest_bit
from cello3d_ros.clouds.leaves import Indices, Leaves, leaves_near
from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array

FAR2 = 1.7e308  # no finite squared distance is searched for beyond
LEAST2 = 1e-290  # from where a radius grows that was guessed to be nothing


class Room(NamedTuple):
    """Where a search over L leaves works.

    found: (L,), the leaves whose points are candidates; distances2: (16 L,), a row of sixteen
    for each of them; the rest is scratch of ``leaves_near``.
    """

    near: Indices
    near_boxes: Array
    stack: Indices
    found: Indices
    distances2: Array


@kernel()
def make_room(n_leaves: int) -> Room:
    """Return the room for a search; what of it is not used takes no memory."""
    return Room(
        np.empty(n_leaves, np.int64),
        np.empty((n_leaves // 16 + 1, 6, 16)),
        np.empty(256, np.int64),
        np.empty(n_leaves, np.int64),
        np.empty(16 * n_leaves),
    )


@kernel(inline="always")
def gather(
    leaves: Leaves,
    box: Array,
    x: float,
    y: float,
    z: float,
    k: int,
    bound2: float,
    far2: float,
    max2: float,
    n_near: int,
    room: Room,
) -> tuple[int, int, float, float, int]:
    """Collect candidates around (x, y, z) until k are found or ``max2`` is reached.

    box: around all queries that share the leaves near, within ``far2``; n_near: how many these
    are, -1 before they are looked for; bound2: the radius that is tried first.  All are squared.
    Returns how many leaves have candidates, how many points are within bound2, bound2, far2 and
    n_near.  (Inlined: a call with so many arrays costs as much as the work.)
    """
    growth, bound2 = 2.0, min(bound2, far2)
    n_rows = n_found = 0
    searching = True
    while searching:
        if n_near < 0:
            n_near = leaves_near(leaves, box, far2, room.stack, room.near, room.near_boxes)
        n_rows = n_found = 0
        for block in range((n_near + 15) >> 4):
            mask = boxes_near(room.near_boxes, block, x, y, z, bound2)
            while mask:
                leaf = room.near[16 * block + lowest_bit(mask)]
                mask &= mask - 1
                room.found[n_rows] = leaf
                n_found += distances_of(
                    leaves.points, leaf, x, y, z, bound2, room.distances2, n_rows
                )
                n_rows += 1
        if n_found >= k or bound2 >= max2:
            searching = False
        elif bound2 < far2:
            bound2 = min(4.0 * bound2, far2)
        else:
            far2 = min(growth * far2, max2)
            growth, bound2, n_near = 2.0 * growth, far2, -1
    return n_rows, n_found, bound2, far2, n_near
