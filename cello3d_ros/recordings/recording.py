"""What every recording yields: scans in order of time, read lazily."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import NDArray

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array

if TYPE_CHECKING:
    from cello3d_ros.geometry.pose_track import PoseTrack


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One point cloud and what is known of its pose.

    stamp_ns: time of the scan.
    points: (N, 3) finite float64, metres, sensor frame.
    T_world_sensor: (4, 4) ground truth, or None.
    T_odom_sensor: (4, 4) odometry at the stamp, or None.
    intensity: (N,) float64 in the sensor's own unit, or None.
    time_s: (N,) float64, when each point was measured, after the stamp; or None.
    echoes: of a simulated scan, what its beams met (``simulation.scanner.Echoes``), from which it
        can be scanned again; or None.
    """

    stamp_ns: int
    points: Array
    T_world_sensor: Array | None = None
    T_odom_sensor: Array | None = None
    intensity: Array | None = None
    time_s: Array | None = None
    echoes: Any = None

    def __post_init__(self) -> None:
        for name in ("intensity", "time_s"):
            values = getattr(self, name)
            if values is not None and values.shape != (len(self.points),):
                raise RecordingError(
                    f"{name} of shape {values.shape} does not fit {len(self.points)} points"
                )

    def only(self, rows: NDArray[Any]) -> Scan:
        """Return the scan with some of its points: a mask or indices, companions alike."""
        return replace(
            self,
            points=self.points[rows],
            intensity=None if self.intensity is None else self.intensity[rows],
            time_s=None if self.time_s is None else self.time_s[rows],
        )


class Recording(Protocol):
    """A sequence of scans; iterating again starts over and yields the same scans."""

    @property
    def name(self) -> str:
        """Short name: the folder or file without its ending."""
        ...

    @property
    def n_projected(self) -> int:
        """How many poses were not quite rigid and were made so."""
        ...

    @property
    def has_odometry(self) -> bool:
        """Whether it holds odometry, at least for some scans."""
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Scan]: ...

    def track(self) -> PoseTrack | None:
        """Return the sensor's poses as densely as they are known, odometry before ground truth."""
        ...
