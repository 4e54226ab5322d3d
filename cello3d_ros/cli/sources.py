"""What verbs that read a recording share: arguments, opening, progress."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cello3d_ros.errors import RecordingError, counted

if TYPE_CHECKING:
    from cello3d_ros.recordings import Recording


_FILES = (".bag", ".mcap", ".db3", ".ply", ".pcd", ".npy", ".bin", ".csv")
SIMULATED = "simulated"


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that say how a recording is read."""
    parser.add_argument("--points", metavar="TOPIC", help="clouds of a bag")
    parser.add_argument(
        "--odometry",
        metavar="TOPIC",
        help="odometry of a bag, '' for none; 'simulated': ground truth made to drift",
    )
    parser.add_argument("--ground-truth", metavar="TOPIC", help="ground truth, '' for none")
    parser.add_argument(
        "--ground-truth-frames", nargs=2, metavar=("WORLD", "FRAME"), help="ground truth from TF"
    )
    parser.add_argument(
        "--extrinsic",
        nargs=7,
        type=float,
        metavar=("X", "Y", "Z", "QX", "QY", "QZ", "QW"),
        help="pose of the sensor in the frame whose poses a bag has",
    )
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="ground truth: a TUM file, or KITTI's by order; replay takes them for "
        "odometry; in graph also the word joint",
    )
    parser.add_argument("--time-field", metavar="NAME", help="field with the times of the points")
    parser.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), help="their unit")
    parser.add_argument(
        "--time-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="seconds to add to the stamps of clouds, so that they are on the clock of the poses",
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="refuse a recording for one message that cannot be read; else it is left out",
    )


def check_folder(out: Path) -> None:
    """Refuse a folder named like a file: ``bag.mcap`` would become ``bag.mcap/bag.mcap.mcap``."""
    if out.suffix.lower() in _FILES:
        raise RecordingError(
            f"{out}: a folder is made, name it without an ending: {out.with_suffix('')}"
        )


def open_source(path: Path, arguments: argparse.Namespace) -> Recording:
    """Return the recording.  Raises RecordingError."""
    import numpy as np

    from cello3d_ros.clouds.point_times import Clock
    from cello3d_ros.geometry import se3
    from cello3d_ros.recordings import ReadOptions, open_recording
    from cello3d_ros.recordings.odometry import SimulatedOdometry

    T_base_sensor = None
    if (given := arguments.extrinsic) is not None:
        if not np.isfinite(given).all() or abs(np.linalg.norm(given[3:]) - 1.0) > 1e-3:
            raise RecordingError("--extrinsic needs x y z and a unit quaternion qx qy qz qw")
        T_base_sensor = se3.pose(given[:3], given[3:])
    frames = arguments.ground_truth_frames
    is_simulated = arguments.odometry == SIMULATED
    recording = open_recording(
        path,
        ReadOptions(
            points=arguments.points,
            odometry=None if is_simulated else arguments.odometry,
            ground_truth=arguments.ground_truth,
            ground_truth_frames=None if frames is None else (frames[0], frames[1]),
            T_base_sensor=T_base_sensor,
            poses=arguments.poses,
            clock=Clock(
                field=arguments.time_field,
                unit=arguments.time_unit,
                cloud_offset_s=arguments.time_offset,
            ),
            strict=arguments.strict,
        ),
    )
    return SimulatedOdometry(recording) if is_simulated else recording


def in_words(skipped: dict[str, int]) -> str:
    """Return what was left out of a recording as the end of a sentence, "" if nothing was."""
    return "".join(
        f"; {counted(n, 'message')} left out: {reason.replace('_', ' ')}"
        for reason, n in skipped.items()
    )


def with_progress(scans: Iterable[Any], total: int, name: str) -> Any:
    """Return the scans, with a bar of counts and time left where there is a terminal."""
    from tqdm import tqdm

    return tqdm(
        scans,
        total=total,
        desc=name,
        unit="scan",
        disable=not sys.stderr.isatty(),
        leave=False,
    )
