"""A folder of clouds (.ply .pcd .bin .npy .csv) with poses in a TUM or KITTI file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import tables
from cello3d_ros.recordings.files import READERS, read_columns, scan_of
from cello3d_ros.recordings.kitti import STEP_NS
from cello3d_ros.recordings.poses import (
    StampedRows,
    check_order,
    read_tum,
    rigid,
    seconds_to_ns,
    stamps_of,
)
from cello3d_ros.recordings.recording import Scan

TRUTH = (
    "ground_truth.tum", "groundtruth.tum", "poses.tum", "poses.txt",
    "ground_truth.txt", "groundtruth.txt", "trajectory.txt", "traj.txt",
)  # fmt: skip
ODOMETRY, TIMES = "odometry.tum", "times.txt"
_NOT_CLOUDS = ("pose_scanner_leica.csv",)
_NEAR_NS = 1_000_000  # a stamp this far outside the poses still has the first or last of them
_NUMBER = re.compile(r"(\d+(?:\.\d+)?)$")


class FolderRecording:
    """Clouds in the order of the numbers in their names.

    Stamps: times.txt (seconds, one a row), else names that are times (seconds with a decimal
    point; or integers of seconds, us or ns), else the rows of a TUM file with as many poses as
    there are clouds, else 0.1 s apart.  Poses: the file named, else ``ground_truth.tum``,
    ``poses.txt`` or the like; KITTI rows belong to clouds by order, TUM rows by stamp (linear and
    SLERP between two), or by order where nothing else gives stamps.
    """

    def __init__(self, folder: Path | str, poses: Path | str | None = None) -> None:
        """Read everything but the clouds.  Raises RecordingError."""
        self.folder = Path(folder)
        self._files = clouds_in(self.folder)
        if not self._files:
            raise RecordingError(f"{folder}: has no cloud ({', '.join(READERS)})")
        self.n_projected = 0
        self._stamps_ns = self._known_stamps()
        file = Path(poses) if poses is not None else self._usual()
        self._truth: PoseTrack | list[Array] | None = None
        if file is not None:
            self._truth = self._read_poses(file)
        if self._stamps_ns is None:
            self._stamps_ns = [k * STEP_NS for k in range(len(self._files))]
        self._odometry = self._tum(self.folder / ODOMETRY)
        self._check_poses(file)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    @property
    def has_odometry(self) -> bool:
        """Whether there is an ``odometry.tum``."""
        return self._odometry is not None

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Scan]:
        assert self._stamps_ns is not None
        for k, (file, stamp_ns) in enumerate(zip(self._files, self._stamps_ns, strict=True)):
            yield replace(
                scan_of(read_columns(file), stamp_ns, file),
                T_world_sensor=self._pose(k, stamp_ns),
                T_odom_sensor=None if self._odometry is None else _near(self._odometry, stamp_ns),
            )

    def track(self) -> PoseTrack | None:
        """Return the odometry, else the ground truth."""
        if self._odometry is not None or not isinstance(self._truth, list):
            return self._odometry or self._truth  # type: ignore[return-value]
        return PoseTrack.of_poses(self._stamps_ns or [], np.stack(self._truth))

    def _pose(self, k: int, stamp_ns: int) -> Array | None:
        if isinstance(self._truth, list):
            return self._truth[k].copy()
        return None if self._truth is None else _near(self._truth, stamp_ns)

    def _known_stamps(self) -> list[int] | None:
        times = self.folder / TIMES
        if times.exists():
            stamps = stamps_of(tables.read_bytes(times), times)
            if len(stamps) != len(self._files):
                raise RecordingError(
                    f"{times}: has {len(stamps)} rows for {len(self._files)} clouds"
                )
            return check_order(stamps, times)
        named = [_named_stamp(file) for file in self._files]
        return [s for s in named if s is not None] if None not in named else None

    def _usual(self) -> Path | None:
        return next((p for name in TRUTH if (p := self.folder / name).is_file()), None)

    def _tum(self, path: Path) -> PoseTrack | None:
        if not path.is_file():
            return None
        return _track(read_tum(tables.read_bytes(path), path), path)

    def _read_poses(self, path: Path) -> PoseTrack | list[Array]:
        data = tables.read_bytes(path)
        if _n_columns(data) != 8:
            rows = tables.numbers(data, 12, path)
            self._check_count(path, len(rows))
            poses = rigid(rows.reshape(-1, 3, 4), path)
            self.n_projected = poses.n_projected
            return list(poses.T)
        found = read_tum(data, path)
        if self._stamps_ns is None:
            self._check_count(path, len(found.stamps_ns))
            self._stamps_ns = check_order(found.stamps_ns, path)
        return _track(found, path)

    def _check_count(self, path: Path, n_rows: int) -> None:
        if n_rows != len(self._files):
            raise RecordingError(f"{path}: has {n_rows} poses for {len(self._files)} clouds")

    def _check_poses(self, path: Path | None) -> None:
        truth = self._truth
        if isinstance(truth, PoseTrack) and not any(
            _near(truth, stamp_ns) is not None for stamp_ns in self._stamps_ns or []
        ):
            raise RecordingError(f"{path}: no pose has the time of any cloud")


def clouds_in(folder: Path) -> list[Path]:
    """Return the files with clouds of a folder, in the order of the numbers in their names."""
    if not folder.is_dir():
        return []
    files = [f for f in folder.iterdir() if f.suffix.lower() in READERS and f.is_file()]
    files = [f for f in files if f.name not in _NOT_CLOUDS]
    return sorted(files, key=lambda file: (_natural(file.name), file.name))


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts the numbers in names by value."""
    words = re.split(r"(\d+)", name)
    return [(len(w.lstrip("0")), w.lstrip("0")) if w.isdigit() else (0, w) for w in words]


def _named_stamp(file: Path) -> int | None:
    """Return the stamp that is a file's name, None if the name is no time."""
    found = _NUMBER.search(file.stem)
    if found is None:
        return None
    text = found[1]
    if "." in text or 9 <= len(text) <= 11:
        return seconds_to_ns(text, file)
    if len(text) >= 18:
        return int(text)
    return int(text) * 1000 if len(text) >= 15 else None


def _track(found: StampedRows, path: Path) -> PoseTrack:
    try:
        return PoseTrack.of_rows(*found)
    except PoseError as error:
        raise RecordingError(f"{path}: {error}") from None


def _near(track: PoseTrack, stamp_ns: int) -> Array | None:
    """Return the pose at a stamp, or the first or last of the track when just outside of it."""
    if len(track) == 0:
        return None
    first, last = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
    if first - _NEAR_NS <= stamp_ns <= last + _NEAR_NS:
        return track.at(min(max(stamp_ns, first), last))
    return None


def _n_columns(data: bytes) -> int:
    lines = (line.split(b"#")[0].split() for line in data.splitlines())
    return next((len(words) for words in lines if words), 0)
