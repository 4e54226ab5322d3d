"""The 'Challenging data sets for point cloud registration algorithms' of ASL, ETH Zurich.

Source: Pomerleau, Liu, Colas, Siegwart 2012, IJRR 31(14); the paper's data.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.point_times import PointTimesError, TimeLaw, recognise
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import tables
from cello3d_ros.recordings.archives import Files
from cello3d_ros.recordings.files import checked, scan_of, times_of
from cello3d_ros.recordings.poses import check_order, rigid, seconds_to_ns
from cello3d_ros.recordings.recording import Scan

SEQUENCES = MappingProxyType(
    {
        "apartment": "Apartment",
        "stairs": "Stairs",
        "eth": "ETH Hauptgebaude",
        "hauptgebaude": "ETH Hauptgebaude",
        "gazebo_summer": "Gazebo in summer",
        "gazebo_winter": "Gazebo in winter",
        "plain": "Mountain plain",
        "wood_summer": "Wood in summer",
        "wood_autumn": "Wood in autumn",
    }
)
_POSES = "pose_scanner_leica.csv"
_LOCAL, _GLOBAL = re.compile(r"Hokuyo_(\d+)\.csv$"), re.compile(r"PointCloud(\d+)\.csv$")
_MATRIX = [f"t{i}{j}" for i in range(4) for j in range(4)]


def sequence_of(name: str) -> str | None:
    """Return which of the eight sequences a folder or archive is called after, or None."""
    words = f"_{re.sub(r'[^a-z]+', '_', name.lower())}_".replace("_in_", "_")
    return next((full for key, full in SEQUENCES.items() if f"_{key}_" in words), None)


class _PoseFile(NamedTuple):
    """stamps_ns: None where the file says nothing of time.  T_world_sensor: (n, 4, 4)."""

    ids: list[int]
    stamps_ns: list[int] | None
    T_world_sensor: Array
    n_projected: int


class ChallengingRecording:
    """Scans of one sequence, in integer order, with the poses that the theodolite measured.

    In any folder of the tree ``Hokuyo_<i>.csv`` (sensor frame; preferred) or ``PointCloud<i>.csv``
    (world frame, moved back by the pose), and ``pose_scanner_leica.csv``, the one that is nearest
    to them; everything may lie in zip archives.  Poses are found by poseId, by row where ids and
    numbers of files differ.
    """

    has_odometry = False
    times = ""  # the sensor stands still during each scan

    def __init__(self, path: Path | str) -> None:
        """Read the poses.  Raises RecordingError."""
        self.path = Path(path)
        self._files = Files(self.path)
        self._local, clouds = _clouds(self._files)
        if not clouds:
            raise RecordingError(f"{path}: has no Hokuyo_<i>.csv and no PointCloud<i>.csv")
        self._clouds = sorted(clouds.items())
        self._poses = self._read_poses(PurePosixPath(self._clouds[0][1]).parent)
        if self._poses is None and not self._local:
            raise RecordingError(f"{path}: PointCloud<i>.csv need {_POSES}, which is missing")
        self._rows = self._matched()

    @property
    def name(self) -> str:
        """Name of the folder or archive."""
        return self.path.stem if self.path.suffix == ".zip" else self.path.resolve().name

    @property
    def n_projected(self) -> int:
        """How many poses were not quite rigid and were made so."""
        return 0 if self._poses is None else self._poses.n_projected

    @property
    def n_declared(self) -> int:
        """How many scans there are."""
        return len(self._clouds)

    @property
    def skipped(self) -> dict[str, int]:
        """Nothing: a scan that cannot be read is an error."""
        return {}

    def __len__(self) -> int:
        return len(self._clouds)

    def __iter__(self) -> Iterator[Scan]:
        before_ns = None
        for (_, name), row in zip(self._clouds, self._rows, strict=True):
            scan = self._scan(name, row)
            if before_ns is not None and scan.stamp_ns <= before_ns:
                raise RecordingError(f"{self._files.where(name)}: does not follow in time")
            before_ns = scan.stamp_ns
            yield scan

    def track(self) -> PoseTrack | None:
        """Return None: the sensor stood still during each scan."""
        return None

    def _scan(self, name: str, row: int | None) -> Scan:
        where, poses = self._files.where(name), self._poses
        found = checked(tables.read_csv(self._files.read(name), where), where)
        stamps = None if poses is None else poses.stamps_ns
        if stamps is not None and row is not None:
            stamp_ns = stamps[row]
        else:
            stamp_ns = _first_ns(found, where)
        T = None if poses is None or row is None else poses.T_world_sensor[row].copy()
        if not self._local and T is not None:
            moved = se3.transform(se3.inverse(T), np.stack([found[a] for a in "xyz"], axis=1))
            found |= dict(zip("xyz", moved.T, strict=True))
        scan = scan_of(found, stamp_ns, where, _law(found, stamp_ns))
        return Scan(**{**vars(scan), "T_world_sensor": T})

    def _read_poses(self, beside: PurePosixPath) -> _PoseFile | None:
        """Read the poses whose file shares most of its path with the clouds', None without."""
        names = [name for name in self._files.names if PurePosixPath(name).name == _POSES]
        if not names:
            return None
        nearest = min(names, key=lambda name: (-_n_shared(PurePosixPath(name), beside), name))
        return _read_pose_file(self._files, nearest)

    def _matched(self) -> list[int | None]:
        """Return the row of each cloud's pose."""
        if self._poses is None:
            return [None] * len(self._clouds)
        rows = {i: k for k, i in enumerate(self._poses.ids)}
        numbers = [number for number, _ in self._clouds]
        if all(number in rows for number in numbers):
            return [rows[number] for number in numbers]
        if max(numbers) < len(rows):
            return list(numbers)
        raise RecordingError(
            f"{self.path}: {_POSES} has {len(rows)} poses, but none for scan {max(numbers)}"
        )


def is_challenging(path: Path) -> bool:
    """Return whether a folder or a zip archive holds clouds of these names.

    Raises RecordingError for an archive that is damaged.
    """
    if path.is_file() and path.suffix.lower() != ".zip":
        return False
    return bool(_clouds(Files(path))[1])


def _clouds(files: Files) -> tuple[bool, dict[int, str]]:
    """Return whether the clouds are in the sensor frame, and their names by number."""
    for pattern in (_LOCAL, _GLOBAL):
        folders: dict[str, dict[int, str]] = {}
        for name in files.names:
            path = PurePosixPath(name)
            if found := pattern.match(path.name):
                folders.setdefault(str(path.parent), {})[int(found[1])] = name
        if len(folders) > 1:
            listed = ", ".join(sorted(folders)[:4])
            raise RecordingError(f"{files.path}: has scans in several folders, name one: {listed}")
        if folders:
            return pattern is _LOCAL, next(iter(folders.values()))
    return True, {}


def _n_shared(name: PurePosixPath, folder: PurePosixPath) -> int:
    """Return how many folders a file lies in, from the top, that a folder lies in as well."""
    pairs = zip(name.parent.parts, folder.parts, strict=False)
    return sum(1 for _ in takewhile(lambda ab: ab[0] == ab[1], pairs))


def _read_pose_file(files: Files, name: str) -> _PoseFile:
    where = files.where(name)
    data = files.read(name)
    table = tables.read_csv(data, where)
    poses = rigid(tables.columns(table, _MATRIX, where).reshape(-1, 4, 4), where)
    ids = tables.columns(table, ["poseid"], where)[:, 0]
    if not np.array_equal(ids, np.round(ids)) or len(set(ids)) < len(ids):
        raise RecordingError(f"{where}: poseId must be different whole numbers")
    stamps = None
    if len(ids) and "timestamp" in table and np.ptp(table["timestamp"]) > 0:
        at = list(table).index("timestamp")
        lines = [line for line in data.decode("ascii", "replace").splitlines()[1:] if line.strip()]
        words = [line.replace(";", ",").split(",")[at].strip() for line in lines]
        stamps = check_order([seconds_to_ns(word, where) for word in words], where)
    return _PoseFile([int(i) for i in ids], stamps, poses.T, poses.n_projected)


def _law(found: dict[str, Array], stamp_ns: int) -> TimeLaw | None:
    times = times_of(found)
    if times is None:
        return None
    try:
        return recognise(times, stamp_ns)
    except PointTimesError:
        return None


def _first_ns(found: dict[str, Array], where: str) -> int:
    """Return the time of the first point, of a scan whose pose has none."""
    name = next((n for n in ("time_in_sec", "timestamp", "time") if n in found), None)
    if name is None or not len(found[name]) or not np.isfinite(found[name][0]):
        raise RecordingError(f"{where}: neither its pose nor its points have a time")
    return round(float(found[name][0]) * 1e6) * 1000
