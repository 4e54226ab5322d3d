"""``cello3d convert SOURCE OUT``: any recording to a rosbag2, a KITTI folder or plain clouds."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cello3d_ros.cli.sources import (
    add_source_arguments,
    check_folder,
    in_words,
    open_source,
    with_progress,
)
from cello3d_ros.errors import RecordingError, counted

if TYPE_CHECKING:
    from cello3d_ros.recordings import Recording, Scan

FORMATS = {
    "mcap": "a rosbag2 folder (default)",
    "sqlite3": "a rosbag2 folder",
    "kitti": "a KITTI odometry folder",
    "npy": "a folder of .npy clouds with TUM poses",
    "ply": "a folder of .ply clouds with TUM poses",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("source", metavar="SOURCE", type=Path, help="bag, folder or archive")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder to make")
    formats = ", ".join(f"{name}: {what}" for name, what in FORMATS.items())
    parser.add_argument("--format", choices=FORMATS, default="mcap", help=formats)
    add_source_arguments(parser)
    parser.add_argument(
        "--deskew",
        action="store_true",
        help="undo the motion within each scan, by the points' times and the odometry",
    )
    parser.add_argument(
        "--double", action="store_true", help="float64 points in a bag (RViz does not show them)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Convert; OUT appears when it is complete.  Raises RecordingError."""
    check_folder(arguments.out)
    if arguments.out.exists():
        raise RecordingError(f"{arguments.out} exists already; give another name or remove it")
    recording = open_source(arguments.source, arguments)
    counts = {"n_with_ground_truth": 0, "n_with_odometry": 0}
    scans = _counted(_scans(arguments, recording), counts)
    n_written = _write(arguments, recording, scans)
    summary = {
        "out": str(arguments.out),
        "format": arguments.format,
        "n_scans": n_written,
        "n_left_out": len(recording) - n_written,
        **counts,
        "n_poses_projected": recording.n_projected,
        "skipped": recording.skipped,
        "times": recording.times,
    }
    print(json.dumps(summary) if arguments.json else _sentence(summary, arguments.deskew))


def _scans(arguments: argparse.Namespace, recording: Recording) -> Iterable[Scan]:
    from cello3d_ros.recordings.deskew import deskewed

    scans = deskewed(recording) if arguments.deskew else recording
    progress: Iterable[Scan] = with_progress(scans, recording.n_declared, recording.name)
    return progress


def _counted(scans: Iterable[Scan], counts: dict[str, int]) -> Iterator[Scan]:
    for scan in scans:
        counts["n_with_ground_truth"] += scan.T_world_sensor is not None
        counts["n_with_odometry"] += scan.T_odom_sensor is not None
        yield scan


def _write(arguments: argparse.Namespace, recording: Recording, scans: Iterable[Scan]) -> int:
    out, kind = arguments.out, arguments.format
    if kind == "kitti":
        from cello3d_ros.recordings.writers import write_kitti

        return write_kitti(out, scans)
    if kind in ("npy", "ply"):
        from cello3d_ros.recordings.writers import write_folder

        return write_folder(out, scans, f".{kind}")
    from cello3d_ros.recordings.bag_writer import write_bag

    made_by = {"made_by": shlex.join(["cello3d", "convert", recording.name, "--format", kind])}
    return write_bag(out, scans, provenance=made_by, storage=kind, double=arguments.double)


def _sentence(summary: dict[str, Any], deskew: bool) -> str:
    text = f"{summary['out']}: {counted(summary['n_scans'], 'scan')}"
    if summary["n_left_out"]:
        text += f"; {summary['n_left_out']} left out, their poses do not cover them"
    for what in ("ground_truth", "odometry"):
        if 0 < (n := summary[f"n_with_{what}"]) < summary["n_scans"]:
            text += f"; only {n} have {what.replace('_', ' ')}"
    text += in_words(summary["skipped"])
    if deskew:
        text += f"; times of points taken {summary['times']}"
    if summary["n_poses_projected"]:
        text += f"; {summary['n_poses_projected']} poses were not quite rigid and were made so"
    return text
