"""Single point clouds in files: KITTI .bin, .npy, .csv with a header, .ply and .pcd."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.scanner import import_open3d


def read_cloud(path: Path | str) -> Array:
    """Return the finite points (N, 3) of a file, N > 0, metres; the ending tells the format.

    ``.bin``: float32 little-endian rows x, y, z, intensity (KITTI).  ``.npy``: an array (N, 3) or
    wider, x, y, z first.  ``.csv``: a header line with columns x, y, z anywhere, separated by
    commas, semicolons or blanks.  ``.ply``, ``.pcd``: by Open3D.
    Raises RecordingError that says what is wrong with the file.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: unknown ending, expected one of {', '.join(_READERS)}")
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    try:
        points = reader(path)
    except (OSError, ValueError, EOFError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: cannot be read ({reason})") from error
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        raise RecordingError(f"{path}: holds no finite point")
    return finite


def _read_bin(path: Path) -> Array:
    data = path.read_bytes()
    if len(data) % 16:
        raise RecordingError(f"{path}: {len(data)} bytes are no whole number of 16-byte points")
    return np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)


def _read_npy(path: Path) -> Array:
    array: NDArray[np.generic] = np.load(path, allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] < 3:
        shape = getattr(array, "shape", None)
        raise RecordingError(f"{path}: expected an array (N, 3) or wider, found shape {shape}")
    if array.dtype.kind not in "fiu":
        raise RecordingError(f"{path}: expected numbers, found {array.dtype}")
    return array[:, :3].astype(np.float64)


def _read_csv(path: Path) -> Array:
    with path.open(encoding="utf-8-sig") as lines:
        header = lines.readline().strip()
        separator = next((s for s in ",;" if s in header), None)
        names = [name.strip().strip('"').lower() for name in header.split(separator)]
        if missing := [axis for axis in "xyz" if axis not in names]:
            raise RecordingError(
                f"{path}: no column {missing[0]!r} in the header, which has {header[:80]!r}"
            )
        columns = [names.index(axis) for axis in "xyz"]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "input contained no data": said below
            points = np.loadtxt(lines, delimiter=separator, usecols=columns, ndmin=2)
    return np.asarray(points, dtype=np.float64).reshape(-1, 3)


def _read_open3d(path: Path) -> Array:
    o3d = import_open3d(f"{path.suffix} files")
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with quiet:
        cloud = o3d.io.read_point_cloud(str(path))
    return np.array(cloud.points, dtype=np.float64).reshape(-1, 3)


_READERS: dict[str, Callable[[Path], Array]] = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".csv": _read_csv,
    ".ply": _read_open3d,
    ".pcd": _read_open3d,
}
