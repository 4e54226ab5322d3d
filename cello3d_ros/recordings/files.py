"""Single point clouds in files: KITTI .bin, .npy, .csv with a header, .ply and .pcd."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, islice
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.point_times import (
    INTENSITIES,
    Clock,
    TimeLaw,
    law_of,
    relative_s,
)
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import pcd, ply, tables
from cello3d_ros.recordings.recording import LenientRecording, Scan, Skips

Columns = dict[str, NDArray[Any]]

_OWN = Clock()
_N_FIRST = 10  # clouds from which it is seen how times are to be read


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

    ``.bin``: float32 little-endian rows x, y, z, intensity (KITTI), also with a ring (nuScenes).
    ``.npy``: an array (N, 3) or wider, x, y, z first, or one with named fields.  ``.csv``: a
    header line with columns x, y, z anywhere, separated by commas, semicolons or blanks.
    ``.ply``, ``.pcd``: ASCII or binary.
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


def scan_of(
    found: Columns,
    stamp_ns: int,
    where: object,
    law: TimeLaw | None = None,
    clock: Clock = _OWN,
) -> Scan:
    """Return the finite points as a scan, with the intensities and times that there are.

    law: how to read times; None leaves them out.  Raises RecordingError when no point is finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        points = np.stack([found[axis].astype(np.float64) for axis in "xyz"], axis=1)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise RecordingError(f"{where}: holds no finite point")
    kept = {name: values[finite] for name, values in found.items()}
    intensity = next((kept[name] for name in INTENSITIES if name in kept), None)
    times = None if law is None else times_of(kept, clock)
    return Scan(
        stamp_ns=stamp_ns + clock.offset_ns,
        points=points[finite],
        intensity=None if intensity is None else intensity.astype(np.float64),
        time_s=None if times is None or law is None else relative_s(times, law, stamp_ns),
    )


def times_of(found: Columns, clock: Clock = _OWN) -> NDArray[Any] | None:
    """Return the column of times, None where there is none.  Raises PointTimesError."""
    name = clock.column(found)
    return None if name is None else found[name]


class CloudFiles(LenientRecording):
    """Clouds in files of their own; what is known of their poses is for those who build on it."""

    files: Sequence[Path]
    stamps_ns: Sequence[int]

    @property
    def n_declared(self) -> int:
        """How many files there are."""
        return len(self.files)

    def _clouds(self, skips: Skips) -> Iterator[tuple[int, Scan]]:
        """Yield the number of each file and its scan without poses."""
        law, _ = self._times
        for k, (file, stamp_ns) in enumerate(zip(self.files, self.stamps_ns, strict=True)):
            try:
                yield k, scan_of(read_columns(file), stamp_ns, file, law, self._clock)
            except RecordingError as error:
                if self._strict:
                    raise
                skips.add("malformed", str(error))

    def _law(self) -> TimeLaw | None:
        first = []
        for file, stamp_ns in islice(zip(self.files, self.stamps_ns, strict=True), _N_FIRST):
            try:
                times = times_of(read_columns(file), self._clock)
            except RecordingError:
                continue
            if times is None:
                return None
            first.append((times, stamp_ns))
        return law_of(first, self._clock.unit)


def _read_bin(data: bytes, path: Path) -> Columns:
    """Read rows of 4 float32 (KITTI), or of 5 (nuScenes, ``.pcd.bin``)."""
    values = np.frombuffer(data[: len(data) // 4 * 4], dtype="<f4")
    n = _n_columns(values, 5 if path.name.lower().endswith(".pcd.bin") else 4)
    if len(data) % (4 * n):
        raise RecordingError(
            f"{path}: {len(data)} bytes are no whole number of {4 * n}-byte points"
        )
    if n not in (4, 5):
        raise RecordingError(
            f"{path}: looks like {n} numbers a point; 4 (KITTI) and 5 (nuScenes) are read"
        )
    return dict(zip(("x", "y", "z", "intensity", "ring"), values.reshape(-1, n).T))


def _n_columns(values: NDArray[np.float32], usual: int) -> int:
    """Return how many numbers a point has, the usual number if another is not much likelier.

    Read with a wrong number each column is a mixture of the true ones: the greatest difference
    between the distributions of two columns is never above that of the true columns.
    """
    scores = {n: _difference(values, n) for n in (4, 5, 3, 6)}
    best = max(scores, key=lambda n: scores[n])
    margin = 0.15 + 3.0 / np.sqrt(max(len(values) / usual, 1))
    return best if scores[best] > scores[usual] + margin else usual


def _difference(values: NDArray[np.float32], n_columns: int) -> float:
    """Return the greatest Kolmogorov-Smirnov distance between columns, of at most 2000 rows."""
    rows = values[: len(values) // n_columns * n_columns].reshape(-1, n_columns)
    rows = np.sort(rows[:: max(1, len(rows) // 2000)], axis=0)
    if len(rows) < 100 or not np.isfinite(rows).all():
        return 0.0
    at = np.sort(rows.ravel())
    shares = [np.searchsorted(column, at, side="right") / len(rows) for column in rows.T]
    return max(float(np.abs(a - b).max()) for a, b in combinations(shares, 2))


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
