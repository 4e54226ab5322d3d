"""The overlap of two registered clouds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.neighbors import any_within
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.geometry.se3 import Array, inverse, transform


class Overlap(NamedTuple):
    """Points of each cloud that have a neighbour in the other.

    reading: (N,) and reference: (M,), true where a point overlaps.
    """

    reading: NDArray[np.bool_]
    reference: NDArray[np.bool_]

    @property
    def n_points(self) -> int:
        """Number of overlapping points, of both clouds."""
        return int(self.reading.sum() + self.reference.sum())

    @property
    def ratio(self) -> float:
        """Share of the reading's points that overlap."""
        return float(self.reading.mean())


def find_overlap(reading: Cloud, reference: Cloud, T_ref_read: Array, radius_m: float) -> Overlap:
    """Return the points of two clouds that are at most ``radius_m`` from the other cloud.

    T_ref_read: (4, 4), p_ref = T_ref_read p_read.  Source: S of Sec. IV-C.
    """
    return Overlap(
        any_within(reference.tree, transform(T_ref_read, reading.points), radius_m),
        any_within(reading.tree, transform(inverse(T_ref_read), reference.points), radius_m),
    )
