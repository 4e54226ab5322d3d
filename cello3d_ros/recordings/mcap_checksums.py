"""Checksums for the chunks of an MCAP file, so that readers notice a damaged byte.

Source: MCAP specification, records Chunk (op 0x06) and its field uncompressed_crc; rosbags leaves
it 0, which says that there is none.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

_MAGIC = 8
_CHUNK = 0x06
_CRC_AT = 24  # bytes of a chunk record before uncompressed_crc: two times and a size


def add_checksums(file: Path) -> None:
    """Fill in the checksum of every uncompressed chunk, in place."""
    with file.open("r+b") as stream:
        stream.seek(_MAGIC)
        while len(head := stream.read(9)) == 9:
            op, size = struct.unpack("<BQ", head)
            start = stream.tell()
            if op == _CHUNK:
                _add(stream, start)
            stream.seek(start + size)


def _add(stream: BinaryIO, start: int) -> None:
    fixed = stream.read(_CRC_AT + 8)
    (n_name,) = struct.unpack_from("<I", fixed, _CRC_AT + 4)
    compression = stream.read(n_name)
    (n_records,) = struct.unpack("<Q", stream.read(8))
    if compression:
        return
    crc = crc32(stream.read(n_records))
    stream.seek(start + _CRC_AT)
    stream.write(struct.pack("<I", crc))
