"""Files and folders that appear under their name only when they are complete."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cello3d_ros.errors import WriteError


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
