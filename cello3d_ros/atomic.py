"""Files and folders that appear under their name only when they are complete."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from cello3d_ros.errors import WriteError


def check_outputs(paths: Sequence[Path], inputs: Iterable[Path | str | None] = ()) -> None:
    """Raise WriteError, before the work, where files cannot be written or would replace an input.

    A file within a folder that is read counts as a part of it.
    """
    read = {Path(path).resolve(): path for path in inputs if path is not None}
    for path in paths:
        folder = path.absolute().parent
        if path.is_dir() or not folder.is_dir():
            raise WriteError(f"cannot write {path}: not a file in an existing folder")
        if path.exists() and not path.is_file():
            raise WriteError(f"cannot write {path}: it is not a file")
        if not os.access(folder, os.W_OK):
            raise WriteError(f"cannot write {path}: its folder cannot be written to")
        here = path.resolve()
        if path.exists() and (found := read.keys() & {here, *here.parents}):
            raise WriteError(f"cannot write {path}: it is a part of {read[min(found)]}, an input")
    if len({path.resolve() for path in paths}) < len(paths):
        raise WriteError(f"the same file is to be written twice: {', '.join(map(str, paths))}")


@contextmanager
def new_file(path: Path | str) -> Iterator[Path]:
    """Give a path to write a file at; in the end it is renamed to ``path``, replacing that.

    When anything is raised, what was there stays and nothing else is left.  The partial file is
    named ``.NAME.PID.tmp``.  Raises WriteError where the disk refuses.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        if path.exists() and not path.is_file():
            raise WriteError(f"cannot write {path}: it is not a file")
        yield partial
        with partial.open("rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise WriteError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path | str, replace: bool = False) -> Iterator[Path]:
    """Give a path to make a folder at; in the end it is renamed to ``path``.

    When anything is raised nothing is left behind.  replace: whether a folder of that name gives
    way when the new one is complete.  Raises WriteError when there is something of that name
    already, or no room to write.
    """
    path = Path(path)
    if not replace and (path.exists() or path.is_symlink()):
        raise WriteError(f"{path} exists already; give another name or remove it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        try:
            yield partial / path.name
            if replace:
                shutil.rmtree(path, ignore_errors=True)
            os.rename(partial / path.name, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise WriteError(f"cannot write {path}: {error.strerror or error}") from error
