"""Poses in files: rows of a matrix (KITTI, ASL) or of stamp, position and quaternion (TUM)."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import tables

_EXACT = 1e-12  # a rotation this close to orthonormal is left as it is,
_ROUNDED = 1e-6  # one this close is rounded, as text is: made exact but not counted
_UNIT = 1e-3  # quaternions farther from unit length are damaged


class Poses(NamedTuple):
    """Rigid poses (n, 4, 4); n_projected of them were off by more than rounding."""

    T: Array
    n_projected: int


def rigid(matrices: ArrayLike, where: object) -> Poses:
    """Return the nearest rigid poses of (n, 4, 4) matrices, or of their first three rows.

    Raises RecordingError naming the row that is farther than 1e-3 from a rigid pose.
    """
    rows = np.asarray(matrices, dtype=np.float64)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, : rows.shape[1]] = rows
    for k, pose in enumerate(T):
        if not se3.is_rigid(pose):
            raise RecordingError(f"{where}: row {k + 1} is not a rotation and a translation")
    R = T[:, :3, :3]
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    off = error > _EXACT
    U, _, Vt = np.linalg.svd(R[off])
    T[off, :3, :3] = U @ Vt
    T[:, 3] = [0.0, 0.0, 0.0, 1.0]
    return Poses(T, int((error > _ROUNDED).sum()))


class StampedRows(NamedTuple):
    """Rows of a TUM file.  stamps_ns: (n,), exact.  rows: (n, 7), x y z qx qy qz qw."""

    stamps_ns: list[int]
    rows: Array


def read_tum(data: bytes, where: object) -> StampedRows:
    """Return the rows of a TUM trajectory, as evo and others write it.  Raises RecordingError."""
    rows = tables.numbers(data, 8, where)
    bad = ~(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0) <= _UNIT)
    if bad.any():
        raise RecordingError(f"{where}: row {int(np.argmax(bad)) + 1} has no unit quaternion")
    return StampedRows(stamps_of(data, where), rows[:, 1:])


def stamps_of(data: bytes, where: object) -> list[int]:
    """Return the first number of each row, in seconds, as nanoseconds without rounding errors."""
    lines = (line.split(b"#")[0].split() for line in data.splitlines())
    words = [line[0].decode("ascii", "replace") for line in lines if line]
    return [seconds_to_ns(word, f"{where}: row {k}") for k, word in enumerate(words, start=1)]


def seconds_to_ns(text: str, where: object) -> int:
    """Return decimal seconds as the nearest nanosecond.  Raises RecordingError."""
    try:
        value = Decimal(text)
        if value.is_finite() and abs(value) < 9_000_000_000:
            return int(value.scaleb(9).to_integral_value())
    except InvalidOperation:
        pass
    raise RecordingError(f"{where}: {text[:40]!r} is not a time in seconds")


def read_poses(path: Path) -> tuple[PoseTrack | Array, int]:
    """Return the poses of a file, and how many were not quite rigid and were made so.

    Rows of 8 numbers are TUM's, a track over time; rows of 12 KITTI's, (n, 4, 4) without times.
    Raises RecordingError.
    """
    data = tables.read_bytes(path)
    words = (line.split(b"#")[0].split() for line in data.splitlines())
    if len(next((row for row in words if row), [])) == 8:
        return _track(data, path), 0
    return rigid(tables.numbers(data, 12, path).reshape(-1, 3, 4), path)


def read_track(path: Path) -> PoseTrack:
    """Return the poses of a TUM file.  Raises RecordingError."""
    return _track(tables.read_bytes(path), path)


def _track(data: bytes, path: Path) -> PoseTrack:
    try:
        return PoseTrack.of_rows(*read_tum(data, path))
    except PoseError as error:
        raise RecordingError(f"{path}: {error}") from None


def check_order(stamps_ns: list[int], where: object) -> list[int]:
    """Return stamps that increase; raises RecordingError naming the first row that does not."""
    for k in range(1, len(stamps_ns)):
        if stamps_ns[k] <= stamps_ns[k - 1]:
            raise RecordingError(f"{where}: row {k + 1} does not follow in time")
    return stamps_ns


def seconds_text(stamp_ns: int) -> str:
    """Return a stamp in seconds with all nine digits, so that none is lost."""
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(stamp_ns) // 1_000_000_000}.{abs(stamp_ns) % 1_000_000_000:09d}"


def tum_line(stamp_ns: int, T: Array) -> str:
    """Return one line of a TUM file: stamp, position, quaternion x y z w."""
    values = [*T[:3, 3], *se3.quaternion(T)]
    return " ".join([seconds_text(stamp_ns), *(repr(float(v)) for v in values)]) + "\n"


def kitti_line(T: Array) -> str:
    """Return one line of a KITTI poses.txt: the 3x4 matrix, row by row."""
    return " ".join(repr(float(v)) for v in T[:3].ravel()) + "\n"
