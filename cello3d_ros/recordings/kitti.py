"""KITTI odometry folders: velodyne/NNNNNN.bin, poses.txt, calib.txt, times.txt."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.files import read_cloud
from cello3d_ros.recordings.recording import Scan

_STEP_NS = 100_000_000  # KITTI's lidar turns 10 times a second


class KittiRecording:
    """Scans of a KITTI odometry folder, with ground truth where there is a poses.txt.

    File number i belongs to row i of poses.txt and times.txt.  The rows of poses.txt, T_cam, are
    of the camera; with ``Tr`` of calib.txt (lidar -> camera, else identity) the sensor's pose is
    ``T_world_sensor = Tr^-1 T_cam Tr``.  Without times.txt, scans are 0.1 s apart.
    """

    def __init__(self, folder: Path | str) -> None:
        """Read everything but the clouds.  Raises RecordingError naming file and row."""
        self.folder = Path(folder)
        files = sorted((self.folder / "velodyne").glob("*.bin"))
        if not files:
            raise RecordingError(f"{self.folder}: has no velodyne/*.bin")
        if odd := [f.name for f in files if not f.stem.isdecimal()]:
            raise RecordingError(f"{self.folder}: velodyne/{odd[0]} is not named by a number")
        self._files = sorted((int(f.stem), f) for f in files)
        poses, times = self.folder / "poses.txt", self.folder / "times.txt"
        self._stamps_ns = _stamps(times, self._needed(times, _table(times, 1)))
        self._T_world_sensor = None
        if (rows := self._needed(poses, _table(poses, 12))) is not None:
            self._T_world_sensor = _lidar_poses(rows, poses, _calibration(self.folder))

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Scan]:
        for number, file in self._files:
            stamps, poses = self._stamps_ns, self._T_world_sensor
            yield Scan(
                stamp_ns=number * _STEP_NS if stamps is None else stamps[number],
                points=read_cloud(file),
                T_world_sensor=None if poses is None else poses[number].copy(),
            )

    def _needed(self, path: Path, rows: Array | None) -> Array | None:
        """Return the rows, after checking that each scan has one."""
        number, file = self._files[-1]
        if rows is not None and number >= len(rows):
            raise RecordingError(
                f"{path}: has {len(rows)} rows, but {file.name} needs row {number + 1}"
            )
        return rows


def _table(path: Path, n_columns: int) -> Array | None:
    """Return the numbers (rows, n_columns) of a text file, or None if there is none."""
    if not path.exists():
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file: no rows
            rows = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise RecordingError(f"{path}: cannot be read ({reason})") from error
    if len(rows) and rows.shape[1] != n_columns:
        raise RecordingError(f"{path}: has {rows.shape[1]} columns, expected {n_columns}")
    return np.asarray(rows.reshape(-1, n_columns))


def _stamps(path: Path, rows: Array | None) -> list[int] | None:
    if rows is None:
        return None
    stamps = rows[:, 0]
    late = ~np.isfinite(stamps) | (np.diff(stamps, prepend=-np.inf) <= 0)
    if late.any():
        raise RecordingError(f"{path}: row {int(np.argmax(late)) + 1} does not follow in time")
    return [round(float(seconds) * 1e9) for seconds in stamps]


def _lidar_poses(rows: Array, path: Path, Tr: Array) -> Array:
    """Return the poses (n, 4, 4) of the lidar; a row may be 1e-3 off a rotation, not more."""
    T_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    T_cam[:, :3] = rows.reshape(-1, 3, 4)
    for k, T in enumerate(T_cam):
        if not se3.is_rigid(T):
            raise RecordingError(f"{path}: row {k + 1} is not a rotation and a translation")
    return np.asarray(se3.inverse(Tr) @ _projected(T_cam) @ Tr)


def _projected(T: Array) -> Array:
    """Return the poses (n, 4, 4) with each rotation replaced by the nearest exact one."""
    U, _, Vt = np.linalg.svd(T[:, :3, :3])
    out = T.copy()
    out[:, :3, :3] = U @ Vt
    return out


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
    return np.asarray(_projected(Tr[None])[0])
