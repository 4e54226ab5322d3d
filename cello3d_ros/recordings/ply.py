"""PLY files: the vertices, ASCII or binary; written in binary."""

from __future__ import annotations

from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.errors import RecordingError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_NAMES = {"f4": "float", "f8": "double"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Header(NamedTuple):
    encoding: str
    n_vertices: int
    properties: list[tuple[str, str]]
    body: bytes


def read(data: bytes, where: object) -> dict[str, NDArray[Any]]:
    """Return the properties of the vertices, each (N,), by lower-case names.

    The vertices must come first, as they do from all common programs; other elements (faces) are
    left unread.  Raises RecordingError.
    """
    header = _header(data, where)
    order = _ORDERS[header.encoding]
    dtype = np.dtype([(name, order + kind) for name, kind in header.properties])
    if header.encoding == "ascii":
        return _ascii(header, where)
    size = header.n_vertices * dtype.itemsize
    if len(header.body) < size:
        raise RecordingError(f"{where}: declares {size} bytes but holds {len(header.body)}")
    rows = np.frombuffer(header.body[:size], dtype)
    return {
        name: rows[name].astype(dtype[name].newbyteorder("=")) for name, _ in header.properties
    }


def write(path: Path, found: dict[str, NDArray[Any]]) -> None:
    """Write columns (N,) of float32 or float64 as binary vertices."""
    kinds = {name: f"f{values.dtype.itemsize}" for name, values in found.items()}
    rows = np.empty(len(found["x"]), np.dtype([(n, "<" + kind) for n, kind in kinds.items()]))
    for name, values in found.items():
        rows[name] = values
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {_NAMES[kind]} {name}" for name, kind in kinds.items()]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())


def _header(data: bytes, where: object) -> _Header:
    end = data.find(b"end_header")
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise RecordingError(f"{where}: is no PLY file, or its header is cut")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    encoding = next((words[1] for words in lines if words[:1] == ["format"] and words[1:]), "")
    elements = [k for k, words in enumerate(lines) if words[:1] == ["element"]]
    if encoding not in _ORDERS or not elements or lines[elements[0]][1:2] != ["vertex"]:
        raise RecordingError(f"{where}: expected a format and the vertices as first element")
    try:
        n_vertices = int(lines[elements[0]][2])
        body = takewhile(lambda words: words[:1] != ["element"], lines[elements[0] + 1 :])
        pairs = [(w[2].lower(), _TYPES[w[1]]) for w in body if w[:1] == ["property"]]
    except (ValueError, IndexError, KeyError) as error:
        raise RecordingError(f"{where}: its header is damaged ({error})") from error
    if n_vertices < 0 or not pairs or len({name for name, _ in pairs}) < len(pairs):
        raise RecordingError(f"{where}: its header is damaged (vertices and properties)")
    return _Header(encoding, n_vertices, pairs, data[newline + 1 :])


def _ascii(header: _Header, where: object) -> dict[str, NDArray[Any]]:
    n = header.n_vertices * len(header.properties)
    words = header.body.split(maxsplit=n)[:n]
    if len(words) < n:
        raise RecordingError(f"{where}: declares {n} numbers but holds {len(words)}")
    try:
        rows = np.array(words, dtype=np.float64).reshape(header.n_vertices, -1)
    except ValueError as error:
        raise RecordingError(f"{where}: cannot be read ({error})") from error
    return {
        name: rows[:, k]
        if kind == "f8"
        else rows[:, k].astype(np.float32)
        if kind == "f4"
        else rows[:, k]
        for k, (name, kind) in enumerate(header.properties)
    }
