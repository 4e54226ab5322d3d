"""A cloud that stays, such as a map, as a reference.  Imports no ROS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cello3d_ros.clouds.filters import crop_range, limit_density, subsample
from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import CloudConfig, PairingConfig
from cello3d_ros.errors import CloudError, NoOverlapError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array

_MOVED = 0.25  # share of the range after which the map is cropped anew
_SPARE = 10  # of so many times the points that are kept density is made even


class Map:
    """A cloud that stays; what lies around the sensor is prepared once and kept for a while."""

    def __init__(self, stamp_ns: int, points: Array, frame_id: str) -> None:
        """points: (N, 3), in the frame ``frame_id``."""
        self.stamp_ns, self.points, self.frame_id = stamp_ns, points, frame_id
        self._cloud: Cloud | None = None
        self._centre = np.zeros(3)
        self._made_with: tuple[float, int, CloudConfig, int] | None = None

    def is_same(self, other: Map) -> bool:
        """Return whether another message says the same."""
        mine, theirs = ((m.stamp_ns, m.frame_id, m.points.shape) for m in (self, other))
        return mine == theirs and np.array_equal(self.points, other.points)

    def around(
        self, position: Array, node: PairingConfig, config: CloudConfig
    ) -> tuple[Cloud, Array]:
        """Return the prepared points around a position and T_map_crop, the frame they are in.

        That frame has the axes of the map and its origin at a place at most a quarter of
        ``reference_range_m`` from the position.  position: (3,).  Raises NoOverlapError.
        """
        range_m, n_points = node.reference_range_m, node.max_reference_points
        made_with = (range_m, n_points, config, node.seed)
        moved_m = np.linalg.norm(position - self._centre)
        if self._cloud is None or moved_m > _MOVED * range_m or made_with != self._made_with:
            self._cloud = None
            rng = np.random.default_rng([node.seed, self.stamp_ns & (2**64 - 1)])
            self._cloud = self._prepared(position, range_m, n_points, config, rng)
            self._centre, self._made_with = np.array(position), made_with
        return self._cloud, se3.pose(self._centre, [0.0, 0.0, 0.0, 1.0])

    def _prepared(
        self,
        centre: Array,
        range_m: float,
        n_points: int,
        config: CloudConfig,
        rng: np.random.Generator,
    ) -> Cloud:
        """Return what is within range of a centre, even in density and no more than that many."""
        low, high = centre - range_m, centre + range_m
        near = self.points[((self.points >= low) & (self.points <= high)).all(axis=1)] - centre
        near = crop_range(near[subsample(len(near), _SPARE * n_points, rng)], 0.0, range_m)
        even = limit_density(near, config.voxel_m, config.max_points_per_voxel, rng)
        few = even[subsample(len(even), n_points, rng)]
        every = replace(config, min_range_m=0.0, max_range_m=range_m, min_support=0.0)  # no scan
        try:
            return prepare(few, every, rng)
        except CloudError as error:
            raise NoOverlapError(
                f"the reference cloud around the guess of the sensor is too small: {error}"
            ) from None
