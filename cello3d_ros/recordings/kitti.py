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
from cello3d_ros.recordings.files import CloudFiles
from cello3d_ros.recordings.poses import check_order, rigid, stamps_of
from cello3d_ros.recordings.recording import ReadOptions, Scan

_TR_UNRECTIFIED = ("Tr_velo_to_cam", "Tr_velo_cam")  # to the camera before rectification
_RECTIFYING = ("R0_rect", "R_rect")
STEP_NS = 100_000_000  # KITTI's lidar turns 10 times a second


class KittiRecording(CloudFiles):
    """Scans of a KITTI odometry folder, with ground truth where there is a poses.txt.

    File number i belongs to row i of poses.txt and times.txt.  The rows of poses.txt, T_cam, are
    of the camera; with ``Tr`` or ``Tr_velo_to_cam`` of calib.txt (lidar -> camera; the identity
    without the file) the sensor's pose is ``T_world_sensor = Tr^-1 T_cam Tr``.  Without times.txt,
    scans are 0.1 s apart.
    """

    has_odometry = False

    def __init__(self, folder: Path | str, options: ReadOptions | None = None) -> None:
        """Read everything but the clouds.  Raises RecordingError naming file and row."""
        self.folder = Path(folder)
        super().__init__(self.folder, options or ReadOptions())
        files = sorted((self.folder / "velodyne").glob("*.bin"))
        if not files:
            raise RecordingError(f"{self.folder}: has no velodyne/*.bin")
        if odd := [f.name for f in files if not f.stem.isdecimal()]:
            raise RecordingError(f"{self.folder}: velodyne/{odd[0]} is not named by a number")
        numbered = sorted((int(f.stem), f) for f in files)
        self._numbers, self.files = [k for k, _ in numbered], [f for _, f in numbered]
        stamps = self._read_stamps()
        self.stamps_ns = [k * STEP_NS if stamps is None else stamps[k] for k in self._numbers]
        self.n_projected = 0
        self._T_world_sensor = self._read_poses()

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    def __iter__(self) -> Iterator[Scan]:
        poses = self._T_world_sensor
        for k, scan in self._kept():
            T = None if poses is None else poses[self._numbers[k]].copy()
            yield replace(scan, T_world_sensor=T)

    def track(self) -> PoseTrack | None:
        """Return the ground truth at the stamps, if there is any."""
        poses = self._T_world_sensor
        if poses is None:
            return None
        stamps_ns = np.array(self.stamps_ns) + self._clock.offset_ns
        return PoseTrack.of_poses(stamps_ns, poses[self._numbers])

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
        number, file = self._numbers[-1], self.files[-1]
        if number >= n_rows:
            raise RecordingError(
                f"{path}: has {n_rows} rows, but {file.name} needs row {number + 1}"
            )


def _calibration(folder: Path) -> Array:
    """Return the lidar's pose in the camera (4, 4) of calib.txt, the identity without the file.

    ``Tr`` (odometry), or ``R0_rect Tr_velo_to_cam`` (object; also ``R_rect Tr_velo_cam`` of
    tracking).  Raises RecordingError for a file that has none of these.
    """
    path = folder / "calib.txt"
    if not path.exists():
        return np.eye(4)
    try:
        lines = [line.replace(":", " ").split() for line in path.read_text().splitlines()]
        wanted = {"Tr", *_TR_UNRECTIFIED, *_RECTIFYING}
        values = {w[0]: [float(v) for v in w[1:]] for w in lines if w and w[0] in wanted}
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read ({error})") from error
    name = next((n for n in ("Tr", *_TR_UNRECTIFIED) if n in values), None)
    if name is None:
        raise RecordingError(
            f"{path}: has no Tr, so the poses of the camera in poses.txt do not say where the "
            "lidar is; take calib.txt from KITTI's calibration archive"
        )
    Tr = _matrix(values[name], 4, name, path)
    rectifying = next((n for n in _RECTIFYING if n in values), None)
    if name == "Tr" or rectifying is None:
        return Tr
    return np.asarray(_matrix(values[rectifying], 3, rectifying, path) @ Tr)


def _matrix(values: list[float], n_columns: int, name: str, path: Path) -> Array:
    """Return three rows of numbers as a pose (4, 4)."""
    T = np.eye(4)
    if len(values) == 3 * n_columns:
        T[:3, :n_columns] = np.reshape(values, (3, n_columns))
    if len(values) != 3 * n_columns or not se3.is_rigid(T):
        what = "a rotation and a translation" if n_columns == 4 else "a rotation"
        raise RecordingError(f"{path}: {name} is not {what} of {3 * n_columns} numbers")
    return np.asarray(rigid(T[None], path).T[0])
