"""``cello3d estimate READING REFERENCE``: one pair of files to a pose and its covariance."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cello3d_ros.cli.arguments import add_pipeline_argument, add_seed_argument
from cello3d_ros.config import COVARIANCE_MODES, PIPELINES
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import Array, is_rigid

if TYPE_CHECKING:
    from cello3d_ros.covariance.estimator import Estimate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("reading", metavar="READING", help=".bin, .npy, .csv, .ply or .pcd")
    parser.add_argument("reference", metavar="REFERENCE", help="the cloud that stays")
    parser.add_argument(
        "--init", metavar="FILE", help="first guess of T_ref_read: 16 or 12 numbers, row by row"
    )
    parser.add_argument(
        "--model", metavar="M", default="general", help="model file, or a shipped model's name"
    )
    parser.add_argument(
        "--method",
        choices=COVARIANCE_MODES,
        default="cello3d",
        help="how the covariance is found; fused is experimental",
    )
    add_pipeline_argument(parser, "the model's")
    add_seed_argument(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Print the pose and the covariance of one pair."""
    from cello3d_ros.covariance.estimator import Estimator
    from cello3d_ros.recordings.files import read_cloud

    T_init = _read_pose(Path(arguments.init)) if arguments.init else np.eye(4)
    estimator = Estimator(
        arguments.model, arguments.method, pipeline=PIPELINES.get(arguments.pipeline)
    )
    reading, reference = read_cloud(arguments.reading), read_cloud(arguments.reference)
    found = estimator(reading, reference, T_init, arguments.seed)
    print(json.dumps(found.to_dict(), indent=2) if arguments.json else _as_text(found))


def _as_text(found: Estimate) -> str:
    sigmas = np.sqrt(np.diag(found.covariance_ros()))
    return "\n".join(
        [
            "T_ref_read",
            *("  " + "  ".join(f"{value:12.6f}" for value in row) for row in found.T_ref_read),
            "standard deviations along and about the reference's axes",
            "  x, y, z    " + "  ".join(f"{value:.5f}" for value in sigmas[:3]) + "  m",
            "  rotation   " + "  ".join(f"{value:.6f}" for value in sigmas[3:]) + "  rad",
            f"ICP converged after {found.registration.n_iterations} iterations, "
            f"{found.overlap_ratio:.0%} of the reading overlaps",
            f"{found.trust.sentence} (novelty {found.novelty:.2f}, "
            f"{found.effective_neighbors:.1f} effective neighbors)",
        ]
    )


def _read_pose(path: Path) -> Array:
    """Read a 4x4 or 3x4 pose.  Raises RecordingError when it is none."""
    try:
        values = np.array(path.read_text().replace(",", " ").split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "it holds more than numbers"
        raise RecordingError(f"cannot read the pose {path}: {why}") from None
    if values.size not in (12, 16):
        raise RecordingError(f"{path} holds {values.size} numbers, a pose has 16 or 12")
    T = np.eye(4)
    T.flat[: values.size] = values
    if not is_rigid(T):
        raise RecordingError(f"{path} is not a rigid pose: rotation and translation, row by row")
    return T
