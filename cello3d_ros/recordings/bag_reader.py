"""Opens ROS bags with rosbags, and mends what it does not know of the formats."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import unpack_from
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cello3d_ros.clouds import livox
from cello3d_ros.errors import Cello3dError, RecordingError

ENDINGS = (".bag", ".mcap", ".db3")
PACKED = (".mcap.zstd", ".db3.zstd")

_CHUNK = 0x06
_MCAP_IS_CUT = ("File end magic is invalid.", "Invalid MCAP footer.")


def parts_of(path: Path) -> list[Path]:
    """Return what to open: the path, or the files of a folder that rosbags would not know.

    Such are bags that were split without metadata, and a rosbag2 named like a rosbag1, ``.bag``.
    Raises RecordingError for files that must be unpacked or mended first.
    """
    if path.name.endswith(PACKED):
        raise RecordingError(_packed(path))
    if path.is_dir() and (path.suffix == ".bag" or not (path / "metadata.yaml").exists()):
        for ending in ENDINGS:
            if parts := sorted(path.glob(f"*{ending}")):
                return parts
        for packed in (file for ending in PACKED for file in sorted(path.glob(f"*{ending}"))):
            raise RecordingError(_packed(packed))
    return [path]


def check_sqlite(path: Path) -> None:
    """Refuse an SQLite bag that is not whole without another file, or has lost its end."""
    for file in [path] if path.is_file() else sorted(path.glob("*.db3")):
        log = file.with_name(f"{file.name}-wal")
        if log.is_file() and log.stat().st_size:
            raise RecordingError(
                f"{log.name} holds messages that are not in {file.name} yet, as after a recorder "
                f"that was killed; merge it: sqlite3 {file.name} 'PRAGMA wal_checkpoint(TRUNCATE)'"
            )
        _check_length(file)


def open_bag(parts: list[Path]) -> AnyReader:
    """Return a reader, to be entered as a context, of the parts of one bag."""
    reader = AnyReader(parts, default_typestore=_typestore())
    for part in reader.readers:
        storage = getattr(part, "storage", None)  # a rosbag1 has none
        if isinstance(storage, McapReader):
            part.storage = _Mcap(part.path)  # type: ignore[union-attr]
        elif isinstance(storage, DirectoryReader):
            plugins = {**storage.STORAGE_PLUGINS, "mcap": _Mcap}
            storage.STORAGE_PLUGINS = plugins
    return reader


@contextmanager
def one_sentence(path: Path, where: str = "") -> Iterator[None]:
    """Turn whatever a damaged bag raises into a RecordingError with the path.

    rosbags parses untrusted bytes and lets through what its parsers raise (struct.error, KeyError,
    AssertionError, sqlite3.Error, zstd's and lz4's errors, ...), so nothing narrower will do.
    """
    try:
        yield
    except FileNotFoundError as error:
        what = "no such file or folder" if not path.exists() else "no metadata.yaml: not a rosbag2"
        raise RecordingError(f"{path}: {where}{what}") from error
    except Exception as error:
        if isinstance(error, RecordingError) and str(error).startswith(f"{path}: "):
            raise
        raise RecordingError(f"{path}: {where}{reason_in_words(error)}") from error


def reason_in_words(error: Exception) -> str:
    """Return the first line of an error, which for those of rosbags says no more than that."""
    line = (str(error).splitlines() or [type(error).__name__])[0]
    if isinstance(error, Cello3dError):
        return line
    if line in _MCAP_IS_CUT:
        return "its end is missing, as after a recorder that was killed; `mcap recover` mends it"
    return f"cannot be read ({line.rstrip('.')})"


class _Mcap(McapReader):
    """MCAP whose summary lacks records that the specification leaves to the writer.

    rosbags relies on statistics, repeated channels, chunk indexes and message indexes.  Where one
    of them is missing the file is read through once for them.
    """

    def read_index(self) -> None:
        super().read_index()
        if not self.chunks:
            self.chunks.extend(self._chunks_in_file())
        is_whole = all(c.message_index_offsets for c in self.chunks if c.uncompressed_size)
        if self.statistics is not None and self.channels and is_whole:
            return
        self.meta_scan()
        for chunk in self.chunks:  # a chunk is looked into when it has one of a topic's messages
            chunk.channel_count.update(dict.fromkeys(self.channels, 1))

    def _chunks_in_file(self) -> Iterator[ChunkInfo]:
        """Yield the chunks of a file without an index of them, all as if of every channel."""
        bio = self.bio
        assert bio is not None
        at = self.data_start
        while at < self.data_end:
            bio.seek(at)
            head = bio.read(9 + 32)
            op, size = unpack_from("<BQ", head)
            if op == _CHUNK:
                start, end, n_bytes, _, n_name = unpack_from("<QQQII", head, 9)
                name = bio.read(n_name).decode()
                (n_packed,) = unpack_from("<Q", bio.read(8))
                yield ChunkInfo(start, end, at, 9 + size, {}, 0, name, n_packed, n_bytes, {})
            at += 9 + size


def _typestore() -> Any:
    """Return the types for bags that bring none: ROS 2 Jazzy's and Livox's."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in livox.TYPES:
        text = livox.DEFINITION.format(package=kind.split("/")[0])
        store.register(get_types_from_msg(text, kind))
    return store


def _packed(file: Path) -> str:
    return f"{file.name} is compressed as a whole: unpack it (zstd -d {file.name}) first"


def _check_length(file: Path) -> None:
    """Refuse an SQLite file shorter than its header says: SQLite reads the rest as zeros.

    Source: SQLite database file format, bytes 16-17 (page size) and 28-31 (pages), big-endian.
    """
    with file.open("rb") as stream:
        head = stream.read(32)
    if head.startswith(b"SQLite format 3\0") and len(head) == 32:
        page = int.from_bytes(head[16:18], "big")
        declared = (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big")
        if file.stat().st_size < declared:
            raise RecordingError(f"{file.name} has lost its end: {declared} bytes are declared")
