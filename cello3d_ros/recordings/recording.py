"""What every recording yields: scans in order of time, read lazily."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import NDArray

from cello3d_ros.clouds.point_times import Clock, PointTimesError, TimeLaw
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array

if TYPE_CHECKING:
    from cello3d_ros.geometry.pose_track import PoseTrack

NOT_READ = "not read"  # how ``Recording.times`` begins where times cannot be read


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One point cloud and what is known of its pose.

    stamp_ns: time of the scan.
    points: (N, 3) finite float64, metres, sensor frame.
    T_world_sensor: (4, 4) ground truth, or None.
    T_odom_sensor: (4, 4) odometry at the stamp, or None.
    intensity: (N,) float64 in the sensor's own unit, or None.
    time_s: (N,) float64, when each point was measured, after the stamp; NaN where that is
        damaged; or None.
    echoes: of a simulated scan, what its beams met (``simulation.scanner.Echoes``), from which it
        can be scanned again; or None.
    look: of a simulated scan, returns the echoes at its time from another pose; or None.
    """

    stamp_ns: int
    points: Array
    T_world_sensor: Array | None = None
    T_odom_sensor: Array | None = None
    intensity: Array | None = None
    time_s: Array | None = None
    echoes: Any = None
    look: Callable[[Array], Any] | None = None

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


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What a user says of how a recording is to be read; by default it is found in the data.

    points, odometry, ground_truth: topics of a bag, "" for none.  ground_truth_frames: take the
    ground truth from TF, the pose of the second frame in the first.  T_base_sensor: (4, 4), the
    sensor in the frame whose poses a bag has.  poses: a TUM or KITTI file of ground truth.  clock:
    of clouds and points.  strict: refuse a recording for one message that cannot be read.
    """

    points: str | None = None
    odometry: str | None = None
    ground_truth: str | None = None
    ground_truth_frames: tuple[str, str] | None = None
    T_base_sensor: Array | None = None
    poses: Path | None = None
    clock: Clock = field(default_factory=Clock)
    strict: bool = False

    @property
    def is_for_bags(self) -> bool:
        """Whether something is said that only a bag has."""
        topics = (self.points, self.odometry, self.ground_truth)
        return (
            any(topics) or self.ground_truth_frames is not None or self.T_base_sensor is not None
        )


@dataclass
class Skips:
    """What was left out because it cannot be read: how often for each reason."""

    where: object
    strict: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    first: str = ""

    def add(self, reason: str, sentence: str) -> None:
        """Count one.  Raises RecordingError with the sentence instead when ``strict``."""
        if self.strict:
            raise RecordingError(f"{self.where}: {sentence}")
        self.counts[reason] += 1
        self.first = self.first or sentence


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

    @property
    def n_declared(self) -> int:
        """How many clouds it says it has; some may prove unreadable."""
        ...

    @property
    def skipped(self) -> dict[str, int]:
        """How many clouds and poses were left out, by reason, once the scans have been read."""
        ...

    @property
    def times(self) -> str:
        """How the times of points are read, or why they are not; "" where there are none."""
        ...

    def __len__(self) -> int:
        """How many scans it yields; may read all of them to know."""
        ...

    def __iter__(self) -> Iterator[Scan]: ...

    def track(self) -> PoseTrack | None:
        """Return the sensor's poses as densely as they are known, odometry before ground truth."""
        ...


class LenientRecording(ABC):
    """Leaves out clouds that cannot be read, counts them, and refuses only if nothing is left."""

    def __init__(self, where: object, options: ReadOptions) -> None:
        """where: for sentences.  options: the clock, and whether to be strict."""
        self._where, self._strict, self._clock = where, options.strict, options.clock
        self._n: int | None = None
        self._cloud_skips = Skips(where, options.strict)

    @property
    @abstractmethod
    def n_declared(self) -> int:
        """How many clouds it says it has; some may prove unreadable."""

    @property
    def skipped(self) -> dict[str, int]:
        """How many clouds were left out, by reason, once they have been read."""
        return dict(self._cloud_skips.counts)

    def __len__(self) -> int:
        if self._n is None:
            for _ in self._kept():
                pass
        assert self._n is not None
        return self._n

    @property
    def times(self) -> str:
        """How the times of points are read, or why they are not; "" where there are none."""
        return self._times[1]

    @cached_property
    def _times(self) -> tuple[TimeLaw | None, str]:
        """The law of the points' times, and ``times``.

        Raises RecordingError for what a user said of them and is not so.
        """
        try:
            law = self._law()
        except PointTimesError as error:
            if self._clock.is_given:
                raise RecordingError(f"{self._where}: {error}") from None
            return None, f"{NOT_READ}: {error}"
        return law, "" if law is None else law.sentence

    def _law(self) -> TimeLaw | None:
        """Return the law of the points' times, None of none.  Raises PointTimesError."""
        return None

    @abstractmethod
    def _clouds(self, skips: Skips) -> Iterator[Any]:
        """Yield what can be read of each cloud; count in ``skips`` what cannot."""

    def _kept(self) -> Iterator[Any]:
        """Yield the clouds and remember, in the end, how many there were.

        Raises RecordingError when none of several can be read.
        """
        skips, n = Skips(self._where, self._strict), 0
        for item in self._clouds(skips):
            n += 1
            yield item
        if n == 0 and skips.counts:
            raise RecordingError(
                f"{self._where}: none of its {sum(skips.counts.values())} clouds can be read; "
                f"of the first: {skips.first}"
            )
        self._n, self._cloud_skips = n, skips


class DerivedRecording:
    """A recording whose scans are those of another with something changed."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    @property
    def name(self) -> str:
        """As of the recording."""
        return self.recording.name

    @property
    def n_projected(self) -> int:
        """As of the recording."""
        return self.recording.n_projected

    @property
    def has_odometry(self) -> bool:
        """As of the recording."""
        return self.recording.has_odometry

    @property
    def n_declared(self) -> int:
        """As of the recording."""
        return self.recording.n_declared

    @property
    def skipped(self) -> dict[str, int]:
        """As of the recording."""
        return self.recording.skipped

    @property
    def times(self) -> str:
        """As of the recording."""
        return self.recording.times

    def __len__(self) -> int:
        return len(self.recording)
