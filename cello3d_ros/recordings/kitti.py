"""KITTI odometry folders: velodyne/NNNNNN.bin, poses.txt, calib.txt, times.txt."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import tables
from cello3d_ros.recordings.files import read_columns, scan_of
from cello3d_ros.recordings.poses import check_order, rigid, stamps_of
from cello3d_ros.recordings.recording import Scan

STEP_NS = 100_000_000  # KITTI's lidar turns 10 times a second


class KittiRecording:
    """Scans of a KITTI odometry folder, with ground truth where there is a poses.txt.

    File number i belongs to row i of poses.txt and times.txt.  The rows of poses.txt, T_cam, are
    of the camera; with ``Tr`` of calib.txt (lidar -> camera, else identity) the sensor's pose is
    ``T_world_sensor = Tr^-1 T_cam Tr``.  Without times.txt, scans are 0.1 s apart.
    """

    has_odometry = False

    def __init__(self, folder: Path | str) -> None:
        """Read everything but the clouds.  Raises RecordingError naming file and row."""
        self.folder = Path(folder)
        files = sorted((self.folder / "velodyne").glob("*.bin"))
        if not files:
            raise RecordingError(f"{self.folder}: has no velodyne/*.bin")
        if odd := [f.name for f in files if not f.stem.isdecimal()]:
            raise RecordingError(f"{self.folder}: velodyne/{odd[0]} is not named by a number")
        self._files = sorted((int(f.stem), f) for f in files)
        self._stamps_ns = self._read_stamps()
        self.n_projected = 0
        self._T_world_sensor = self._read_poses()

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Scan]:
        for number, file in self._files:
            poses = self._T_world_sensor
            scan = scan_of(read_columns(file), self._stamp(number), file)
            yield replace(scan, T_world_sensor=None if poses is None else poses[number].copy())

    def track(self) -> PoseTrack | None:
        """Return the ground truth at the stamps, if there is any."""
        poses = self._T_world_sensor
        if poses is None:
            return None
        stamps = [self._stamp(number) for number, _ in self._files]
        return PoseTrack.of_poses(stamps, poses[[number for number, _ in self._files]])

    def _stamp(self, number: int) -> int:
        return number * STEP_NS if self._stamps_ns is None else self._stamps_ns[number]

    def _read_stamps(self) -> list[int] | None:
        path = self.folder / "times.txt"
        if not path.exists():
            return None
        data = tables.read_bytes(path)
        self._check_enough(path, len(tables.numbers(data, 1, path)))
        return check_order(stamps_of(data, path), path)

    def _read_poses(self) -> Array | None:
        path = self.folder / "poses.txt"
        if not path.exists():
            return None
        rows = tables.numbers(tables.read_bytes(path), 12, path)
        self._check_enough(path, len(rows))
        T_cam, self.n_projected = rigid(rows.reshape(-1, 3, 4), path)
        Tr = _calibration(self.folder)
        if np.array_equal(Tr, np.eye(4)):
            return T_cam
        return np.asarray(se3.inverse(Tr) @ T_cam @ Tr)

    def _check_enough(self, path: Path, n_rows: int) -> None:
        """Check that each scan has a row."""
        number, file = self._files[-1]
        if number >= n_rows:
            raise RecordingError(
                f"{path}: has {n_rows} rows, but {file.name} needs row {number + 1}"
            )


def _calibration(folder: Path) -> Array:
    """Return Tr (4, 4) of calib.txt, the identity if there is none."""
    path = folder / "calib.txt"
    if not path.exists():
        return np.eye(4)
    try:
        lines = [line.split() for line in path.read_text().splitlines()]
        values = [[float(v) for v in words[1:]] for words in lines if words[:1] == ["Tr:"]]
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read ({error})") from error
    if not values:
        return np.eye(4)
    Tr = np.eye(4)
    if len(values[0]) == 12:
        Tr[:3] = np.reshape(values[0], (3, 4))
    if len(values[0]) != 12 or not se3.is_rigid(Tr):
        raise RecordingError(f"{path}: Tr is not a rotation and a translation of 12 numbers")
    return np.asarray(rigid(Tr[None], path).T[0])
