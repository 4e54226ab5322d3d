"""Named arrays in one .npz file, read with suspicion: no pickle, sizes bounded before use.

A damaged or hostile file costs one sentence, never memory: what the zip directory and each .npy
header declare is compared with each other and with a bound before anything is allocated.
"""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.atomic import new_file
from cello3d_ros.errors import ModelError

MAX_BYTES = 2 * 1024**3  # all items of one file, uncompressed

_DAMAGE = (  # what zipfile, zlib and numpy's header parser raise on nonsense
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError),
    *(ValueError, TypeError, LookupError, OverflowError, SyntaxError, tokenize.TokenError),
    *(AttributeError, MemoryError),
)


def write_arrays(path: Path | str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays to ``path``, compressed; the old file stays until the new is complete.

    Raises WriteError where the disk refuses, ModelError beyond MAX_BYTES, which ``read_arrays``
    would refuse.
    """
    path = Path(path)
    if (size := sum(array.nbytes for array in arrays.values())) > MAX_BYTES - 1024 * len(arrays):
        raise ModelError(f"cannot write {path}: {size} bytes are more than {MAX_BYTES}")
    with new_file(path) as partial, partial.open("wb") as stream:
        _write(stream, arrays)


def read_arrays(
    path: Path | str, dtypes: Mapping[str, str], max_bytes: int = MAX_BYTES
) -> dict[str, NDArray[Any]]:
    """Read the items named in ``dtypes`` (name -> dtype such as "<f8"), bit by bit as written.

    Raises ModelError naming the file and the item: not an .npz, truncated, a failed checksum, an
    item missing, twice or of another dtype, or more than ``max_bytes`` declared for all together.
    """
    try:
        with open(path, "rb") as stream:
            return _read(stream, path, dtypes, max_bytes)
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror or error}") from None


def _write(stream: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write what ``numpy.load`` reads; the bytes depend on the arrays alone."""
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as item:
                np.lib.format.write_array(
                    cast(Any, item), np.asarray(array, order="C"), allow_pickle=False
                )


def _read(
    stream: IO[bytes], path: Path | str, dtypes: Mapping[str, str], max_bytes: int
) -> dict[str, NDArray[Any]]:
    if stream.read(4) != b"PK\x03\x04":
        raise ModelError(f"{path} is not an .npz file")
    try:
        archive = zipfile.ZipFile(stream)
    except _DAMAGE as error:
        raise ModelError(f"{path} is truncated or damaged: {error}") from None
    with archive:
        entries = archive.infolist()
        total = sum(entry.file_size for entry in entries)
        if total > max_bytes:
            raise ModelError(f"{path} declares {total} bytes, more than the {max_bytes} allowed")
        return {
            name: _item(archive, _entry(entries, name, path), np.dtype(dtype), path)
            for name, dtype in dtypes.items()
        }


def _entry(entries: list[zipfile.ZipInfo], name: str, path: Path | str) -> zipfile.ZipInfo:
    found = [entry for entry in entries if entry.filename == f"{name}.npy"]
    if len(found) != 1:
        raise ModelError(f"{path}: item {name!r} is {'there twice' if found else 'missing'}")
    return found[0]


def _item(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, dtype: np.dtype[Any], path: Path | str
) -> NDArray[Any]:
    where = f"{path}: item {entry.filename[:-4]!r}"
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ModelError(f"{where} is compressed by method {entry.compress_type}, not deflate")
    try:
        with archive.open(entry) as stream:
            if (version := np.lib.format.read_magic(stream)) != (1, 0):
                raise ModelError(f"{where} is in .npy format {version}, not (1, 0)")
            shape, fortran, found = np.lib.format.read_array_header_1_0(stream)
            n_bytes = entry.file_size - stream.tell()
            _check(where, shape, fortran, found, dtype, n_bytes)
            # without a count, read() would inflate whatever the stream holds
            return np.frombuffer(stream.read(n_bytes), dtype).reshape(shape)
    except _DAMAGE as error:
        raise ModelError(f"{where} is damaged: {error}") from None


def _check(
    where: str,
    shape: tuple[int, ...],
    fortran: bool,
    found: np.dtype[Any],
    dtype: np.dtype[Any],
    n_bytes: int,
) -> None:
    if found != dtype:
        raise ModelError(f"{where} has dtype {found}, not {dtype}")
    if math.prod(shape) * dtype.itemsize != n_bytes:
        raise ModelError(f"{where} has shape {shape}, which does not fit its {n_bytes} bytes")
    if fortran and len(shape) > 1:
        raise ModelError(f"{where} is stored column by column")
