"""What a node published, byte by byte, into a rosbag2.  Imports no ROS."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.errors import RecordingError


def record(path: Path, raw: Iterable[tuple[str, str, int, bytes]]) -> None:
    """Write messages (topic, ROS type, time in ns, CDR bytes) to a new rosbag2 folder (mcap).

    A folder of that name is replaced when the new one is complete.  Raises RecordingError.
    """
    try:
        partial = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        try:
            _write(partial / path.name, raw)
            shutil.rmtree(path, ignore_errors=True)
            os.rename(partial / path.name, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror or error}") from error


def _write(folder: Path, raw: Iterable[tuple[str, str, int, bytes]]) -> None:
    typestore = get_typestore(Stores.ROS2_JAZZY)
    connections: dict[str, Any] = {}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, time_ns, data in raw:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore)
            writer.write(connections[topic], time_ns, data)
