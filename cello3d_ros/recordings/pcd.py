"""PCD files of the Point Cloud Library, version 0.7: ASCII, binary and compressed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.compiled import kernel
from cello3d_ros.errors import RecordingError

_MAX_RATIO = 264 / 3  # LZF copies at most 264 bytes with 3
_KINDS = {"F": "f", "I": "i", "U": "u"}


def read(data: bytes, where: object) -> dict[str, NDArray[Any]]:
    """Return the fields with one number a point, each (N,), by lower-case names.

    Raises RecordingError.
    """
    header, body = _header(data, where)
    try:
        names = [name.lower() for name in header["FIELDS"]]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
        sizes, kinds = [int(s) for s in header["SIZE"]], [_KINDS[t] for t in header["TYPE"]]
        n, encoding = int(header["POINTS"][0]), header["DATA"][0].lower()
        fields = list(zip(names, sizes, kinds, counts, strict=True))
        dtypes = [np.dtype(f"<{kind}{size}") for _, size, kind, _ in fields]
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise RecordingError(f"{where}: its header is damaged ({error})") from error
    if n < 0 or not counts or min(counts) < 0 or sum(c * s for c, s in zip(counts, sizes)) > 65536:
        raise RecordingError(f"{where}: its header is damaged (POINTS or COUNT)")
    bodies = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}
    if encoding not in bodies:
        raise RecordingError(f"{where}: DATA {encoding!r} is not known")
    found = bodies[encoding](body, n, dtypes, counts, where)
    return {name: values for (name, *_), values in zip(fields, found) if values is not None}


def _header(data: bytes, where: object) -> tuple[dict[str, list[str]], bytes]:
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = data.find(b"\n", at)
        if end < 0 or end - at > 4096 or at > 65536:
            raise RecordingError(f"{where}: is no PCD file, or its header is cut")
        words = data[at:end].decode("ascii", "replace").split("#")[0].split()
        if words:
            found[words[0].upper()] = words[1:]
        at = end + 1
    return found, data[at:]


Found = list[NDArray[Any] | None]


def _ascii(
    body: bytes, n: int, dtypes: list[np.dtype[Any]], counts: list[int], where: object
) -> Found:
    words = body.split()
    if len(words) < n * sum(counts):
        raise RecordingError(f"{where}: declares {n} points but holds fewer")
    rows = np.array(words[: n * sum(counts)], dtype=np.float64).reshape(n, sum(counts))
    starts = np.cumsum([0, *counts[:-1]])
    return [
        (rows[:, k].astype(dtype) if dtype.kind == "f" else rows[:, k]) if count == 1 else None
        for k, dtype, count in zip(starts, dtypes, counts)
    ]


def _binary(
    body: bytes, n: int, dtypes: list[np.dtype[Any]], counts: list[int], where: object
) -> Found:
    row = np.dtype([(f"f{k}", d, (c,)) for k, (d, c) in enumerate(zip(dtypes, counts)) if c])
    if len(body) < n * row.itemsize:
        raise RecordingError(f"{where}: declares {n * row.itemsize} bytes, holds {len(body)}")
    rows = np.frombuffer(body[: n * row.itemsize], row)
    return [rows[f"f{k}"][:, 0].copy() if c == 1 else None for k, c in enumerate(counts)]


def _compressed(
    body: bytes, n: int, dtypes: list[np.dtype[Any]], counts: list[int], where: object
) -> Found:
    size = n * sum(d.itemsize * c for d, c in zip(dtypes, counts))
    packed, unpacked = (int(v) for v in np.frombuffer(body[:8].ljust(8, b"\0"), "<u4"))
    if unpacked != size or len(body) < 8 + packed or size > _MAX_RATIO * max(packed, 1):
        raise RecordingError(f"{where}: declares {size} bytes, but its blocks are of other sizes")
    out = np.zeros(size, np.uint8)
    if _lzf(np.frombuffer(body, np.uint8, packed, 8), out) != size:
        raise RecordingError(f"{where}: its compressed points are damaged")
    found: Found = []
    at = 0
    for dtype, count in zip(dtypes, counts):
        end = at + n * count * dtype.itemsize
        found.append(out[at:end].view(dtype) if count == 1 else None)
        at = end
    return found


@kernel()
def _lzf(data: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Decompress LZF (Lehmann's liblzf) into ``out``; return the bytes written, -1 if damaged."""
    i, o, n, size = 0, 0, data.size, out.size
    while i < n:
        control = int(data[i])
        i += 1
        if control < 32:  # control + 1 bytes as they are
            length = control + 1
            if i + length > n or o + length > size:
                return -1
            for _ in range(length):
                out[o] = data[i]
                i += 1
                o += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n:
                return -1
            length += int(data[i])
            i += 1
        if i >= n:
            return -1
        source = o - ((control & 31) << 8) - int(data[i]) - 1
        i += 1
        length += 2
        if source < 0 or o + length > size:
            return -1
        for _ in range(length):  # bytes just written may be copied again
            out[o] = out[source]
            source += 1
            o += 1
    return o
