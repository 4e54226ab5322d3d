"""Tables in text files: CSV with a header, and rows of numbers.

CSV is read by PyArrow: several million rows a second on one core, every double rounded correctly,
and a row with a column too few or a word for a number is an error (pandas fills in NaN).
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array

_MAX_HEADER = 4096


def read_csv(data: bytes, where: object) -> dict[str, Array]:
    """Return the columns of numbers of a CSV file by their lower-case names, each (N,) float64.

    The first line is the header; separated by commas, semicolons or blanks; LF or CRLF.
    Raises RecordingError that starts with ``where``.
    """
    end = data[:_MAX_HEADER].find(b"\n")
    try:
        header = data[: end if end >= 0 else _MAX_HEADER].decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{where}: cannot be read (the header is not text)") from error
    separator = next((s for s in ",;" if s in header), None)
    names = [name.strip().strip('"').lower() for name in header.split(separator)]
    if len(set(names)) < len(names):
        raise RecordingError(f"{where}: a column comes twice in the header {header[:80]!r}")
    rows = data[end + 1 :] if end >= 0 else b""
    if not rows.strip():
        return {name: np.empty(0) for name in names}
    if separator is None:
        return dict(zip(names, numbers(rows, len(names), where).T, strict=True))
    return _parsed(rows, names, separator, where)


def columns(table: dict[str, Array], names: Sequence[str], where: object) -> Array:
    """Return some columns (N, len(names)); raises RecordingError naming the first missing."""
    for name in names:
        if name not in table:
            raise RecordingError(
                f"{where}: no column {name!r} in the header, which has {', '.join(table)[:80]!r}"
            )
    return np.stack([table[name] for name in names], axis=1)


def numbers(data: bytes, n_columns: int, where: object) -> Array:
    """Return rows of ``n_columns`` numbers separated by blanks; ``#`` starts a comment."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no rows
            rows = np.loadtxt(io.BytesIO(data), dtype=np.float64, ndmin=2)
    except ValueError as error:
        reason = (str(error).splitlines() or [""])[0]
        raise RecordingError(f"{where}: cannot be read ({reason})") from error
    if len(rows) and rows.size and rows.shape[1] != n_columns:
        raise RecordingError(f"{where}: has {rows.shape[1]} columns, expected {n_columns}")
    return np.asarray(rows.reshape(-1, n_columns), dtype=np.float64)


def read_bytes(path: Path) -> bytes:
    """Return what a file holds.  Raises RecordingError."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such file") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from error


def _parsed(rows: bytes, names: list[str], separator: str, where: object) -> dict[str, Array]:
    try:
        import pyarrow
        from pyarrow import csv
    except ImportError:
        raise RecordingError(
            f"{where}: reading CSV needs PyArrow: pip install 'cello3d_ros[csv]'"
        ) from None
    try:
        table: Any = csv.read_csv(
            pyarrow.py_buffer(rows),
            read_options=csv.ReadOptions(use_threads=False, column_names=names),
            parse_options=csv.ParseOptions(delimiter=separator, quote_char=False),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, pyarrow.float64()), null_values=[]
            ),
        )
    except (pyarrow.ArrowException, ValueError, OverflowError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{where}: cannot be read ({reason[:120]})") from error
    return {name: table[name].to_numpy() for name in names}
