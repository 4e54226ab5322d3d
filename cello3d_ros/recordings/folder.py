"""A folder of clouds (.ply .pcd .bin .npy .csv) with poses in a TUM or KITTI file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import tables
from cello3d_ros.recordings.files import READERS, CloudFiles
from cello3d_ros.recordings.kitti import STEP_NS
from cello3d_ros.recordings.poses import (
    check_order,
    read_poses,
    read_track,
    seconds_to_ns,
    stamps_of,
)
from cello3d_ros.recordings.recording import ReadOptions, Scan

TRUTH = (
    "ground_truth.tum", "groundtruth.tum", "poses.tum", "poses.txt",
    "ground_truth.txt", "groundtruth.txt", "trajectory.txt", "traj.txt",
)  # fmt: skip
ODOMETRY, TIMES = "odometry.tum", "times.txt"
_NOT_CLOUDS = ("pose_scanner_leica.csv",)
_NUMBER = re.compile(r"(\d+(?:\.\d+)?)$")


class FolderRecording(CloudFiles):
    """Clouds in the order of the numbers in their names.

    Stamps: times.txt (seconds, one a row), else names that are times (seconds with a decimal
    point; or integers of seconds, us or ns), else the rows of a TUM file of ground truth or
    odometry with as many poses as there are clouds, else 0.1 s apart.  Poses: the file named,
    else ``ground_truth.tum``, ``poses.txt`` or the like; KITTI rows belong to clouds by order, TUM
    rows by stamp (linear and SLERP between two), or by order where nothing else gives stamps.
    """

    def __init__(self, folder: Path | str, options: ReadOptions | None = None) -> None:
        """Read everything but the clouds.  Raises RecordingError."""
        self.folder = Path(folder)
        options = options or ReadOptions()
        super().__init__(self.folder, options)
        self.files = clouds_in(self.folder)
        if not self.files:
            raise RecordingError(f"{folder}: has no cloud ({', '.join(READERS)})")
        self.n_projected = 0
        self._truth: PoseTrack | Array | None = None
        self._odometry: PoseTrack | None = None
        file, odometry = options.poses or self._usual(), self.folder / ODOMETRY
        if file is not None:
            self._truth, self.n_projected = read_poses(file)
            if not isinstance(self._truth, PoseTrack):
                self._check_count(file, len(self._truth))
        if odometry.is_file():
            self._odometry = read_track(odometry)
        self.stamps_ns = self._stamps(file)
        self._check_covered(file, self._truth)
        self._check_covered(odometry, self._odometry)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    @property
    def has_odometry(self) -> bool:
        """Whether there is an ``odometry.tum``."""
        return self._odometry is not None

    def __iter__(self) -> Iterator[Scan]:
        for k, scan in self._kept():
            odometry = self._odometry
            yield replace(
                scan,
                T_world_sensor=self._pose(k, scan.stamp_ns),
                T_odom_sensor=None if odometry is None else odometry.near(scan.stamp_ns),
            )

    def track(self) -> PoseTrack | None:
        """Return the odometry, else the ground truth."""
        if self._odometry is not None or self._truth is None:
            return self._odometry
        if isinstance(self._truth, PoseTrack):
            return self._truth
        stamps_ns = np.array(self.stamps_ns) + self._clock.offset_ns
        return PoseTrack.of_poses(stamps_ns, self._truth)

    def _pose(self, k: int, stamp_ns: int) -> Array | None:
        if isinstance(self._truth, PoseTrack):
            return self._truth.near(stamp_ns)
        return None if self._truth is None else self._truth[k].copy()

    def _stamps(self, file: Path | None) -> list[int]:
        """Return the stamps of the clouds, from the first source that there is."""
        if (known := self._known_stamps()) is not None:
            return known
        for path, poses in ((file, self._truth), (self.folder / ODOMETRY, self._odometry)):
            if path is not None and isinstance(poses, PoseTrack):
                stamps = stamps_of(tables.read_bytes(path), path)
                self._check_count(path, len(stamps))
                return check_order(stamps, path)
        return [k * STEP_NS for k in range(len(self.files))]

    def _known_stamps(self) -> list[int] | None:
        times = self.folder / TIMES
        if times.exists():
            stamps = stamps_of(tables.read_bytes(times), times)
            if len(stamps) != len(self.files):
                raise RecordingError(
                    f"{times}: has {len(stamps)} rows for {len(self.files)} clouds"
                )
            return check_order(stamps, times)
        named = [_named_stamp(file) for file in self.files]
        return [s for s in named if s is not None] if None not in named else None

    def _usual(self) -> Path | None:
        return next((p for name in TRUTH if (p := self.folder / name).is_file()), None)

    def _check_count(self, path: Path, n_rows: int) -> None:
        if n_rows != len(self.files):
            raise RecordingError(f"{path}: has {n_rows} poses for {len(self.files)} clouds")

    def _check_covered(self, path: Path | None, poses: PoseTrack | Array | None) -> None:
        stamps_ns = (stamp_ns + self._clock.offset_ns for stamp_ns in self.stamps_ns)
        if isinstance(poses, PoseTrack) and all(poses.near(t) is None for t in stamps_ns):
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
    found = _NUMBER.search(file.stem.removesuffix(".pcd"))  # as in nuScenes' .pcd.bin
    if found is None:
        return None
    text = found[1]
    if "." in text or 9 <= len(text) <= 11:
        return seconds_to_ns(text, file)
    if len(text) >= 18:
        return int(text)
    return int(text) * 1000 if len(text) >= 15 else None
