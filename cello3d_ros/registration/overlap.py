"""The overlap of two registered clouds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.leaves import tree_order
from cello3d_ros.clouds.neighbors import Indices, any_within, nearest
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array, inverse, transform


class Overlap(NamedTuple):
    """How two registered clouds meet.

    points: (N, 3), the reading's points that are looked at, all or some, in its frame; reading:
    (N,), true where one has a neighbour in the reference; reference: (M,), true where a point has
    a neighbour in the reading, as far as those looked at tell; distances2, indices: (N, k),
    squared distances and indices of each point's k nearest reference points, closest first.
    """

    points: Array
    reading: NDArray[np.bool_]
    reference: NDArray[np.bool_]
    distances2: Array
    indices: Indices

    @property
    def n_points(self) -> int:
        """Number of overlapping points, of both clouds, among those looked at."""
        return int(self.reading.sum() + self.reference.sum())

    @property
    def ratio(self) -> float:
        """Share of the reading's points that overlap."""
        return float(self.reading.mean())


def find_overlap(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    radius_m: float,
    k: int = 1,
    n_threads: int = 1,
    n_looked_at: int = 0,
) -> Overlap:
    """Return the points of two clouds that are at most ``radius_m`` from the other cloud.

    T_ref_read: (4, 4), p_ref = T_ref_read p_read.  A reference point that is near enough among the
    neighbours of a reading point overlaps; the others look for a reading point themselves.
    n_looked_at: so many of the reading's points, drawn at random but always the same, stand for
    all, and no reference point looks for one itself: it needs no tree of the reading.  0: all.
    Source: S of Sec. IV-C.
    """
    points = reading.points
    if n_looked_at > 0:
        some = points.take(subsample(len(points), n_looked_at, np.random.default_rng(0)), axis=0)
        points = some.take(tree_order(some), axis=0)
    distances2, indices = nearest(reference.tree, transform(T_ref_read, points), k, n_threads)
    near = np.zeros(len(points), np.bool_)
    overlaps = np.zeros(len(reference.points), np.bool_)
    _mark(distances2, indices, radius_m**2, near, overlaps)
    if n_looked_at == 0:
        rest = np.flatnonzero(~overlaps)
        back = transform(inverse(T_ref_read), reference.points.take(rest, axis=0))
        overlaps[rest] = any_within(reading.tree, back, radius_m, n_threads)
    return Overlap(points, near, overlaps, distances2, indices)


@kernel()
def _mark(
    distances2: Array,
    indices: Indices,
    radius2: float,
    reading: NDArray[np.bool_],
    reference: NDArray[np.bool_],
) -> None:
    """Set true where an association is at most the radius long, squared, in either cloud."""
    for i in range(len(reading)):
        for j in range(indices.shape[1]):
            if not distances2[i, j] <= radius2:
                break  # the others are longer
            reading[i] = reference[indices[i, j]] = True
