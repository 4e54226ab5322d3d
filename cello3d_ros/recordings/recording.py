"""What every recording yields: scans in order of time, read lazily."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from cello3d_ros.geometry.se3 import Array


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One point cloud and what is known of its pose.

    stamp_ns: time of the scan.
    points: (N, 3) finite float64, metres, sensor frame.
    T_world_sensor: (4, 4) ground truth, or None.
    T_odom_sensor: (4, 4) odometry at the stamp, or None.
    """

    stamp_ns: int
    points: Array
    T_world_sensor: Array | None = None
    T_odom_sensor: Array | None = None


class Recording(Protocol):
    """A sequence of scans; iterating again starts over and yields the same scans."""

    @property
    def name(self) -> str:
        """Short name: the folder or file without its ending."""
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Scan]: ...
