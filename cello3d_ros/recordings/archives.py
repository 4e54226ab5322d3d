"""Files of a folder or of a zip archive, read by their relative names without unpacking."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath

from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings.tables import read_bytes

_DEPTHS = ("*", "*/*", "*/*/*")  # how far down a folder is looked
_MAX_BYTES = 1 << 30  # a member that declares more is not a scan


class Files:
    """Names (relative, with ``/``) and contents of the files below a folder or in a zip archive.

    A folder's zip archives count as if they were unpacked where they lie.
    """

    def __init__(self, path: Path) -> None:
        """List the files.  Raises RecordingError for a damaged archive or one that escapes."""
        self.path = path
        self._readers: dict[str, Callable[[], bytes]] = {}
        if path.is_file():
            self._add_zip(path, "")
            return
        for file in sorted(p for pattern in _DEPTHS for p in path.glob(pattern) if p.is_file()):
            name = file.relative_to(path)
            if file.suffix.lower() == ".zip":
                self._add_zip(file, "" if name.parent == Path(".") else f"{name.parent}/")
            else:
                self._readers[name.as_posix()] = partial(read_bytes, file)

    @property
    def names(self) -> list[str]:
        """Relative names of all files."""
        return list(self._readers)

    def read(self, name: str) -> bytes:
        """Return what a file holds.  Raises RecordingError."""
        return self._readers[name]()

    def where(self, name: str) -> str:
        """Return a name for sentences."""
        return f"{self.path}/{name}"

    def _add_zip(self, archive: Path, prefix: str) -> None:
        with _one_sentence(archive):
            with zipfile.ZipFile(archive) as opened:
                members = [m for m in opened.infolist() if not m.is_dir()]
                for member in members:
                    opened.open(member).close()  # its name must be the same in both places
            for member in members:
                _check_member(archive, member)
                name = prefix + member.filename
                self._readers[name] = partial(_read_member, archive, member)


def _check_member(archive: Path, member: zipfile.ZipInfo) -> None:
    name = PurePosixPath(member.filename.replace("\\", "/"))
    if name.is_absolute() or ".." in name.parts or ":" in name.parts[0]:
        raise RecordingError(f"{archive}: holds {member.filename!r}, a path out of the archive")


def _read_member(archive: Path, member: zipfile.ZipInfo) -> bytes:
    if member.file_size > _MAX_BYTES:
        raise RecordingError(f"{archive}: {member.filename} declares {member.file_size} bytes")
    with _one_sentence(archive, f"{member.filename}: "), zipfile.ZipFile(archive) as opened:
        return opened.read(member)


@contextmanager
def _one_sentence(archive: Path, where: str = "") -> Iterator[None]:
    try:
        yield
    except RecordingError:
        raise
    except (
        OSError,
        EOFError,
        ValueError,
        IndexError,
        KeyError,
        RuntimeError,  # also NotImplementedError: encrypted, or compressed in a way not known
        MemoryError,
        OverflowError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise RecordingError(f"{archive}: {where}cannot be read ({reason})") from error
