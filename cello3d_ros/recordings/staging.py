"""New folders that appear under their name only when they are complete."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cello3d_ros.errors import RecordingError


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Give a path to make a folder at; in the end it is renamed to ``path``.

    When anything is raised nothing is left behind.  Raises RecordingError when there is something
    of that name already, or no room to write.
    """
    if path.exists() or path.is_symlink():
        raise RecordingError(f"{path} exists already; give another name or remove it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        try:
            yield partial / path.name
            os.rename(partial / path.name, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror or error}") from error
    except sqlite3.Error as error:
        raise RecordingError(f"cannot write {path}: {error}") from error
