"""Scans to folders: KITTI's layout, or one file a cloud with poses in TUM files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.atomic import new_folder
from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings import ply
from cello3d_ros.recordings.folder import ODOMETRY, TIMES, TRUTH
from cello3d_ros.recordings.poses import kitti_line, seconds_text, tum_line
from cello3d_ros.recordings.recording import Scan


def write_kitti(path: Path, scans: Iterable[Scan]) -> int:
    """Write a KITTI odometry folder; return how many scans there were.

    velodyne/NNNNNN.bin (float32 x, y, z, intensity; 0 where unknown), times.txt, poses.txt when
    the scans have ground truth, calib.txt of the identity: poses are the lidar's.  Odometry and
    per-point times have no place in it.  Raises RecordingError.
    """
    with new_folder(path) as folder, ExitStack() as stack:
        (folder / "velodyne").mkdir(parents=True)
        (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
        times = stack.enter_context((folder / TIMES).open("w"))
        poses = stack.enter_context((folder / "poses.txt").open("w"))
        n, n_poses = 0, 0
        for scan in _ordered(scans):
            rows = np.zeros((len(scan.points), 4), dtype="<f4")
            rows[:, :3] = scan.points
            if scan.intensity is not None:
                rows[:, 3] = scan.intensity
            (folder / "velodyne" / f"{n:06d}.bin").write_bytes(rows.tobytes())
            times.write(seconds_text(scan.stamp_ns) + "\n")
            n += 1
            if scan.T_world_sensor is not None:
                n_poses += 1
                poses.write(kitti_line(scan.T_world_sensor))
        stack.close()
        _check_some(path, n)
        if n_poses not in (0, n):
            raise RecordingError(f"{n - n_poses} of {n} scans have no pose, KITTI needs them all")
        if not n_poses:
            (folder / "poses.txt").unlink()
    return n


def write_folder(path: Path, scans: Iterable[Scan], ending: str) -> int:
    """Write a file for each cloud (".npy" or ".ply"), and the poses; return how many clouds.

    times.txt has the stamps, ground_truth.tum and odometry.tum (where known) the poses, as evo
    reads them.  Points are kept as they are: exactly.  Raises RecordingError.
    """
    files = {TIMES: 0, TRUTH[0]: 0, ODOMETRY: 0}
    with new_folder(path) as folder, ExitStack() as stack:
        folder.mkdir()
        streams = {name: stack.enter_context((folder / name).open("w")) for name in files}
        for n, scan in enumerate(_ordered(scans)):
            CLOUD_WRITERS[ending](folder / f"{n:06d}{ending}", _columns(scan))
            streams[TIMES].write(seconds_text(scan.stamp_ns) + "\n")
            files[TIMES] += 1
            poses = {TRUTH[0]: scan.T_world_sensor, ODOMETRY: scan.T_odom_sensor}
            for name, T in poses.items():
                if T is not None:
                    streams[name].write(tum_line(scan.stamp_ns, T))
                    files[name] += 1
        stack.close()
        _check_some(path, files[TIMES])
        for name, n_lines in files.items():
            if not n_lines:
                (folder / name).unlink()
    return files[TIMES]


def _ordered(scans: Iterable[Scan]) -> Iterable[Scan]:
    before_ns = None
    for scan in scans:
        if before_ns is not None and scan.stamp_ns <= before_ns:
            raise RecordingError(
                f"scans are not in order of time: {scan.stamp_ns} follows {before_ns}"
            )
        before_ns = scan.stamp_ns
        yield scan


def _check_some(path: Path, n: int) -> None:
    if not n:
        raise RecordingError(f"there is no scan to write into {path.name}")


def _columns(scan: Scan) -> dict[str, NDArray[Any]]:
    """Return the columns of a scan, in single precision where that loses nothing."""
    found = dict(zip("xyz", scan.points.T, strict=True))
    if scan.intensity is not None:
        found["intensity"] = scan.intensity
    single = {name: values.astype(np.float32) for name, values in found.items()}
    exact = all(np.array_equal(single[name], found[name], equal_nan=True) for name in found)
    kept: dict[str, NDArray[Any]] = dict(single if exact else found)
    if scan.time_s is not None:
        kept["time"] = scan.time_s
    return kept


def _write_npy(path: Path, found: dict[str, NDArray[Any]]) -> None:
    """Write an array (N, 3), with named fields where there is more than x, y, z."""
    if set(found) == set("xyz"):
        np.save(path, np.stack(list(found.values()), axis=1))
        return
    rows = np.empty(len(found["x"]), np.dtype([(n, v.dtype) for n, v in found.items()]))
    for name, values in found.items():
        rows[name] = values
    np.save(path, rows)


CLOUD_WRITERS: dict[str, Callable[[Path, dict[str, NDArray[Any]]], None]] = {
    ".npy": _write_npy,
    ".ply": ply.write,
}
