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


class _Property(NamedTuple):
    """A number of each row, or a list of numbers whose length comes first.  kind: numpy's."""

    name: str
    kind: str
    length: str = ""  # kind of the length of a list


class _Element(NamedTuple):
    name: str
    n_rows: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(p.length for p in self.properties)


class _Header(NamedTuple):
    encoding: str
    elements: list[_Element]
    body: bytes


def read(data: bytes, where: object) -> dict[str, NDArray[Any]]:
    """Return the properties of the vertices, each (N,), by lower-case names.

    Lists and other elements (faces) are left out.  Raises RecordingError.
    """
    header = _header(data, where)
    words = header.body.split() if header.encoding == "ascii" else []
    at = 0
    for element in header.elements:
        if header.encoding == "ascii":
            found, at = _ascii(element, words, at, where)
        else:
            order = _ORDERS[header.encoding]
            found, at = _binary(element, header.body, at, order, where)
        if element.name == "vertex":
            return found
    raise AssertionError("unreachable")


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
    try:
        starts = [k for k, words in enumerate(lines) if words[:1] == ["element"]]
        elements = [_element(lines[k:]) for k in starts]
    except (ValueError, IndexError, KeyError) as error:
        raise RecordingError(f"{where}: its header is damaged ({error})") from error
    if encoding not in _ORDERS or "vertex" not in (element.name for element in elements):
        raise RecordingError(f"{where}: expected a format and vertices")
    for element in elements:
        names = {p.name for p in element.properties}
        if element.n_rows < 0 or not names or len(names) < len(element.properties):
            raise RecordingError(f"{where}: its header is damaged ({element.name})")
    return _Header(encoding, elements, data[newline + 1 :])


def _element(lines: list[list[str]]) -> _Element:
    properties = []
    for words in takewhile(lambda words: words[:1] != ["element"], lines[1:]):
        if words[:2] == ["property", "list"]:
            properties.append(_Property(words[4].lower(), _TYPES[words[3]], _TYPES[words[2]]))
        elif words[:1] == ["property"]:
            properties.append(_Property(words[2].lower(), _TYPES[words[1]]))
    return _Element(lines[0][1], int(lines[0][2]), properties)


def _binary(
    element: _Element, body: bytes, at: int, order: str, where: object
) -> tuple[dict[str, NDArray[Any]], int]:
    """Return the columns of an element and where the next begins."""
    if element.has_lists:
        return _binary_with_lists(element, body, at, order, where)
    dtype = np.dtype([(p.name, order + p.kind) for p in element.properties])
    end = at + element.n_rows * dtype.itemsize
    if len(body) < end:
        raise RecordingError(f"{where}: declares {end} bytes but holds {len(body)}")
    rows = np.frombuffer(body[at:end], dtype)
    return {n: rows[n].astype(dtype[n].newbyteorder("=")) for n in dtype.names or ()}, end


def _binary_with_lists(
    element: _Element, body: bytes, at: int, order: str, where: object
) -> tuple[dict[str, NDArray[Any]], int]:
    """Read row by row: only the lengths of the lists tell where the next begins."""
    plain = [p for p in element.properties if not p.length]
    dtype = np.dtype([(p.name, order + p.kind) for p in plain])
    packed = bytearray()
    for _ in range(element.n_rows):
        for p in element.properties:
            size = int(p.kind[1:])
            if p.length:
                end = at + int(p.length[1:])
                length = np.frombuffer(body[at:end].ljust(end - at, b"\0"), order + p.length)
                at, size = end, size * max(int(length[0]), 0)
            else:
                packed += body[at : at + size]
            at += size
        if at > len(body):
            raise RecordingError(f"{where}: declares more rows than it holds")
    rows = np.frombuffer(bytes(packed), dtype) if plain else np.empty(0, dtype)
    return {n: rows[n].astype(dtype[n].newbyteorder("=")) for n in dtype.names or ()}, at


def _ascii(
    element: _Element, words: list[bytes], at: int, where: object
) -> tuple[dict[str, NDArray[Any]], int]:
    """Return the columns of an element and the number of the word after it."""
    plain = [p for p in element.properties if not p.length]
    end = at + element.n_rows * len(element.properties)
    try:
        if element.has_lists:
            rows, end = _ascii_with_lists(element, words, at)
        else:
            rows = np.array(words[at:end], dtype=np.float64)
        table = rows.reshape(element.n_rows, len(plain))
    except (ValueError, IndexError, OverflowError) as error:
        raise RecordingError(
            f"{where}: declares {element.n_rows} rows of numbers but holds others ({error})"
        ) from error
    found = {
        p.name: table[:, k].astype(np.float32) if p.kind == "f4" else table[:, k]
        for k, p in enumerate(plain)
    }
    return found, end


def _ascii_with_lists(
    element: _Element, words: list[bytes], at: int
) -> tuple[NDArray[np.float64], int]:
    kept: list[float] = []
    for _ in range(element.n_rows):
        for p in element.properties:
            if p.length:
                at += 1 + int(words[at])
            else:
                kept.append(float(words[at]))
                at += 1
    return np.array(kept, dtype=np.float64), at
