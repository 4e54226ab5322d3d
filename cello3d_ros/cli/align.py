"""``cello3d align RECORDING --out POSES.tum``: reference poses from the recording itself."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cello3d_ros.atomic import check_outputs
from cello3d_ros.cli.arguments import add_jobs_argument, add_seed_argument
from cello3d_ros.cli.sources import add_source_arguments, in_words, open_source

if TYPE_CHECKING:
    from cello3d_ros.config import Pipeline
    from cello3d_ros.recordings.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="bag or data set")
    parser.add_argument(
        "--out",
        metavar="POSES",
        type=Path,
        required=True,
        help="TUM file to write, or KITTI's if it ends in .txt; further parts become POSES.2.tum "
        "and so on",
    )
    add_source_arguments(parser)
    parser.add_argument("--report", metavar="FILE", type=Path, help="JSON of every scan, to write")
    add_seed_argument(parser)
    add_jobs_argument(parser)


def run(arguments: argparse.Namespace) -> None:
    """Align, write the poses and say how good they are; goes on where it was interrupted."""
    from threadpoolctl import threadpool_limits

    from cello3d_ros.learning.align import align
    from cello3d_ros.learning.align_report import as_dict, sentences, write_poses
    from cello3d_ros.learning.align_sweeps import AlignSettings
    from cello3d_ros.recordings.start_poses import start_track

    outputs = [path for path in (arguments.out, arguments.report) if path is not None]
    check_outputs(outputs, [arguments.recording, arguments.poses])
    poses, arguments.poses = arguments.poses, None
    recording = open_source(arguments.recording, arguments)
    start = None if poses is None else start_track(poses, recording)
    folder = arguments.out.with_name(f".{arguments.out.name}.align")
    with bar(recording.name) as progress, threadpool_limits(1, user_api="blas"):
        settings = AlignSettings(seed=arguments.seed, n_threads=arguments.jobs)
        found = align(recording, settings, start, folder=folder, progress=progress)
    written = write_poses(arguments.out, found, recording.n_declared)
    if arguments.report is not None:
        _write_json(arguments.report, as_dict(found))
    shutil.rmtree(folder, ignore_errors=True)
    print(", ".join(map(str, written)) + in_words(recording.skipped))
    if arguments.out not in written:
        n = len(found.members())
        print(
            f"{arguments.out} is not written: KITTI's format has a row for each scan, and "
            f"{n} of {recording.n_declared} have a pose"
        )
    print("\n".join(sentences(found)))


def joint(
    paths: Sequence[Path | str], dataset: Path, config: Pipeline, n_threads: int
) -> list[Recording]:
    """Align recordings for a dataset, say how good the poses are and return the parts.

    The poses are kept beside the dataset, in DATASET.joint, so that a second call finds them.
    """
    from threadpoolctl import threadpool_limits

    from cello3d_ros.config import pipeline_of
    from cello3d_ros.learning.align_report import sentences
    from cello3d_ros.learning.align_sweeps import AlignSettings
    from cello3d_ros.learning.aligned import aligned_parts, joint_folder
    from cello3d_ros.recordings import open_recording

    settings = AlignSettings(pipeline_of(config), n_threads=n_threads)
    found: list[Recording] = []
    for path in paths:
        recording = open_recording(path)
        folder = joint_folder(dataset, recording.name)
        with bar(recording.name) as progress, threadpool_limits(1, user_api="blas"):
            parts = aligned_parts(recording, folder, settings, progress)
        print("\n".join(sentences(parts[0].alignment)))
        found += parts
    return found


def posed(
    recording: Recording, poses: Path | None, n_threads: int, keeps_odometry: bool = False
) -> Recording:
    """Return a recording with poses: its own, those of a file, or for the word joint its clouds'.

    Of a recording that falls into parts the longest is returned.  keeps_odometry: beside the poses
    of a file.
    """
    if poses is None:
        return recording
    if str(poses) != "joint":
        from cello3d_ros.recordings.start_poses import PosedRecording, start_track

        return PosedRecording(recording, start_track(poses, recording), keeps_odometry)
    from threadpoolctl import threadpool_limits

    from cello3d_ros.learning.align import align
    from cello3d_ros.learning.align_report import sentences
    from cello3d_ros.learning.align_sweeps import AlignSettings
    from cello3d_ros.learning.aligned import AlignedPart

    with bar(recording.name) as progress, threadpool_limits(1, user_api="blas"):
        found = align(recording, AlignSettings(n_threads=n_threads), progress=progress)
    print("\n".join(sentences(found)))
    return AlignedPart(recording, found)


@contextmanager
def bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """Give a function of (done, total) that shows progress and time left on a terminal."""
    from tqdm import tqdm

    with tqdm(
        total=1, desc=f"aligning {name}", unit="scan", disable=not sys.stderr.isatty(), leave=False
    ) as shown:

        def progress(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield progress


def _write_json(path: Path, report: dict[str, Any]) -> None:
    from cello3d_ros.atomic import new_file

    with new_file(path) as partial:
        partial.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
