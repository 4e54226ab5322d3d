"""``cello3d replay RECORDING --out DIR``: the estimator over a recording, without ROS."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cello3d_ros.cli.arguments import add_pipeline_argument
from cello3d_ros.cli.sources import (
    add_source_arguments,
    check_folder,
    in_words,
    open_source,
    with_progress,
)
from cello3d_ros.errors import RecordingError

if TYPE_CHECKING:
    from cello3d_ros.config import NodeConfig
    from cello3d_ros.geometry.gaussian import GaussianPose
    from cello3d_ros.geometry.se3 import Array
    from cello3d_ros.recordings import Recording
    from cello3d_ros.tracking.offline import Step
    from cello3d_ros.tracking.tracker import Answer

_PREFIX = "/covariance_node"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="bag or data set")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to make")
    parser.add_argument(
        "--model", metavar="M", default="", help="model file or name of a shipped one (general)"
    )
    parser.add_argument(
        "--config", metavar="FILE", type=Path, help="YAML settings, of which 'node' counts"
    )
    add_pipeline_argument(parser, "the model's")
    add_source_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Leave poses.tum, covariances.jsonl and the node's messages in bag/.

    Raises Cello3dError; RecordingError when no pair was answered.
    """
    from cello3d_ros.config import PIPELINES, Config, NodeConfig, load_config, pipeline_warning
    from cello3d_ros.covariance.model import load_model
    from cello3d_ros.recordings.start_poses import PosesAsOdometry
    from cello3d_ros.tracking.offline import replay
    from cello3d_ros.tracking.tracker import Tracker

    check_folder(arguments.out)
    node = load_config(arguments.config).node if arguments.config else Config().node
    if arguments.extrinsic is None and node.T_base_sensor != NodeConfig().T_base_sensor:
        arguments.extrinsic = node.T_base_sensor
    recording = open_source(arguments.recording, arguments)
    if arguments.poses is not None and arguments.odometry is None:
        recording = PosesAsOdometry(recording)
    node = replace(node, T_base_sensor=_extrinsic(recording, arguments.extrinsic))
    model = load_model(arguments.model)
    pipeline = PIPELINES.get(arguments.pipeline, model.pipeline)
    if warning := pipeline_warning(model.pipeline, pipeline):
        print(f"cello3d: {warning}", file=sys.stderr)
    tracker = Tracker(model, pipeline, node)
    steps = replay(recording, tracker, node)
    counts = write_answers(
        arguments.out, with_progress(steps, recording.n_declared, recording.name), node
    )
    n_pairs = max(0, len(recording) - 1)
    summary = {
        "out": str(arguments.out),
        "n_pairs": n_pairs,
        "n_answered": counts.pop("", 0),
        "n_restarts": tracker.n_restarts,
        "failures": {k: n for k, n in counts.items() if k != "reference"},
        "skipped": recording.skipped,
    }
    print(json.dumps(summary) if arguments.json else _sentence(summary))


def _extrinsic(recording: Recording, given: Sequence[float] | None) -> tuple[float, ...]:
    """Return the sensor's pose, x y z and quaternion, in the frame of the odometry's poses.

    As given, else as the transforms of a bag say.
    """
    from cello3d_ros.geometry.se3 import quaternion
    from cello3d_ros.recordings.bag import BagRecording

    if given is None and isinstance(recording, BagRecording) and recording.topics.odometry:
        T = recording.extrinsic(recording.topics.odometry)
        return (*map(float, T[:3, 3]), *map(float, quaternion(T)))
    return tuple(given or (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def write_answers(out: Path, steps: Any, config: NodeConfig) -> Counter[str]:
    """Write the three files as the steps come; return how many clouds had which outcome."""
    from cello3d_ros.atomic import new_folder
    from cello3d_ros.recordings.bag_writer import write_messages

    counts: Counter[str] = Counter()
    sentences: dict[str, str] = {}
    with new_folder(out) as folder, ExitStack() as stack:
        folder.mkdir()
        poses = stack.enter_context((folder / "poses.tum").open("w"))
        lines = stack.enter_context((folder / "covariances.jsonl").open("w"))
        messages = _recorded(_noted(steps, counts, sentences), poses, lines, config)
        write_messages(folder / "bag", messages, {"made_by": "cello3d replay"})
        if not counts[""]:
            told = "; ".join(f"{counts[name]} {text}" for name, text in sentences.items())
            raise RecordingError(f"no pair was answered: {told or 'there is only one cloud'}")
    return counts


def _noted(
    steps: Iterable[Step], counts: Counter[str], sentences: dict[str, str]
) -> Iterator[Step]:
    """Yield the steps; count their reasons and keep the first sentence of each failure."""
    for step in steps:
        counts[step.reason] += 1
        if step.sentence:
            sentences.setdefault(step.reason, f"{step.reason.replace('_', ' ')} ({step.sentence})")
        yield step


def _recorded(
    steps: Iterator[Step], poses: Any, lines: Any, config: NodeConfig
) -> Iterator[tuple[str, int, Any]]:
    """Write each step to the two text files and yield its messages."""
    from rosbags.typesys import Stores, get_typestore

    from cello3d_ros.recordings.bag_messages import Messages
    from cello3d_ros.recordings.poses import tum_line

    make = Messages(get_typestore(Stores.ROS2_JAZZY))
    for step in steps:
        stamp_ns = step.scan.stamp_ns
        if (answer := step.answer) is None:
            failure = {"stamp_ns": stamp_ns, "reason": step.reason, "sentence": step.sentence}
            lines.write(json.dumps(failure) + "\n")
            continue
        C, C_chain = _published(answer.step, config), _published(answer.pose, config)
        poses.write(tum_line(stamp_ns, answer.pose.T))
        lines.write(json.dumps(_as_dict(answer)) + "\n")
        yield (
            f"{_PREFIX}/relative_pose",
            stamp_ns,
            make.pose_with_covariance(answer.step.T, C, stamp_ns, answer.frame_id),
        )
        yield (
            f"{_PREFIX}/pose",
            stamp_ns,
            make.pose_with_covariance(answer.pose.T, C_chain, stamp_ns, answer.pose_frame_id),
        )


def _published(pose: GaussianPose, config: NodeConfig) -> Array:
    from cello3d_ros.tracking.covariances import ros_covariance

    bounds = config.floor_sigma_m, config.floor_sigma_rad, config.ceiling
    return ros_covariance(pose.Y, pose.T[:3, :3], *bounds)


def _as_dict(answer: Answer) -> dict[str, Any]:
    """Return an answer as plain numbers under the names that they have in Python."""
    found, step = answer.estimate, answer.step
    registration = found.registration._replace(T_ref_read=step.T)  # as it is published
    return {
        "stamp_ns": answer.stamp_ns,
        "reference_ns": answer.reference_ns,
        "deskewed": answer.deskewed,
        **found._replace(registration=registration, covariance=step.Y).to_dict(),
        "T_odom_read": answer.pose.T.ravel().tolist(),
        "Y_chain": answer.pose.Y.ravel().tolist(),
    }


def _sentence(summary: dict[str, Any]) -> str:
    text = f"{summary['out']}: {summary['n_answered']} of {summary['n_pairs']} pairs answered"
    for reason, n in summary["failures"].items():
        text += f"; {n} {reason.replace('_', ' ')}"
    return text + in_words(summary["skipped"])
