"""Single point clouds in files: KITTI .bin, .npy, .csv with a header, .ply and .pcd."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.point_times import INTENSITIES, NAMES, TimeLaw, recognise, relative_s
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import pcd, ply, tables
from cello3d_ros.recordings.recording import Scan

Columns = dict[str, NDArray[Any]]


_DAMAGE = (  # what numpy's reader of headers lets through, and allocations of damaged sizes
    ValueError,
    TypeError,
    KeyError,
    EOFError,
    OverflowError,
    MemoryError,
    SyntaxError,
    RecursionError,
    TokenError,
)


def read_cloud(path: Path | str) -> Array:
    """Return the finite points (N, 3) of a file, N > 0, metres; the ending tells the format.

    ``.bin``: float32 little-endian rows x, y, z, intensity (KITTI).  ``.npy``: an array (N, 3) or
    wider, x, y, z first, or one with named fields.  ``.csv``: a header line with columns x, y, z
    anywhere, separated by commas, semicolons or blanks.  ``.ply``, ``.pcd``: ASCII or binary.
    Raises RecordingError that says what is wrong with the file.
    """
    return scan_of(read_columns(path), 0, path).points


def read_columns(path: Path | str) -> Columns:
    """Return all that a file says of its points, each (N,), by lower-case names."""
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: unknown ending, expected one of {', '.join(READERS)}")
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    try:
        return reader(tables.read_bytes(path), path)
    except _DAMAGE as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: cannot be read ({reason})") from error


def scan_of(found: Columns, stamp_ns: int, where: object, law: TimeLaw | None = None) -> Scan:
    """Return the finite points as a scan, with the intensities and times that there are.

    law: how to read times; recognised from this scan if None.  Raises RecordingError when no
    point is finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        points = np.stack([found[axis].astype(np.float64) for axis in "xyz"], axis=1)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise RecordingError(f"{where}: holds no finite point")
    kept = {name: values[finite] for name, values in found.items()}
    intensity, times = companions(kept)
    law = law or (None if times is None else recognise(times, stamp_ns))
    return Scan(
        stamp_ns=stamp_ns,
        points=points[finite],
        intensity=None if intensity is None else intensity.astype(np.float64),
        time_s=None if times is None or law is None else relative_s(times, law, stamp_ns),
    )


def companions(found: Columns) -> tuple[NDArray[Any] | None, NDArray[Any] | None]:
    """Return the columns of intensity and of time, None where there is none."""
    intensity = next((found[name] for name in INTENSITIES if name in found), None)
    return intensity, next((found[name] for name in NAMES if name in found), None)


def _read_bin(data: bytes, path: Path) -> Columns:
    if len(data) % 16:
        raise RecordingError(f"{path}: {len(data)} bytes are no whole number of 16-byte points")
    rows = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    return dict(zip(("x", "y", "z", "intensity"), rows.T, strict=True))


def _read_npy(data: bytes, path: Path) -> Columns:
    array: NDArray[Any] = np.load(io.BytesIO(data), allow_pickle=False)
    if isinstance(array, np.ndarray) and array.dtype.names and array.ndim == 1:
        return checked({name.lower(): array[name] for name in array.dtype.names}, path)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] < 3:
        shape = getattr(array, "shape", None)
        raise RecordingError(f"{path}: expected an array (N, 3) or wider, found shape {shape}")
    return checked(dict(zip("xyz", array[:, :3].T, strict=True)), path)


def _read_csv(data: bytes, path: Path) -> Columns:
    return checked(tables.read_csv(data, path), path)


def _read_ply(data: bytes, path: Path) -> Columns:
    return checked(ply.read(data, path), path)


def _read_pcd(data: bytes, path: Path) -> Columns:
    return checked(pcd.read(data, path), path)


def checked(found: Columns, where: object) -> Columns:
    """Return columns that have x, y, z, and numbers in all of them; raises RecordingError."""
    for axis in "xyz":
        if axis not in found:
            raise RecordingError(
                f"{where}: no column {axis!r} in the header, which has {', '.join(found)[:80]!r}"
            )
    for name, values in found.items():
        if values.dtype.kind not in "fiu" or values.ndim != 1:
            raise RecordingError(f"{where}: {name}: expected numbers, found {values.dtype}")
    return found


READERS: dict[str, Callable[[bytes, Path], Columns]] = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".csv": _read_csv,
    ".ply": _read_ply,
    ".pcd": _read_pcd,
}
