"""``cello3d estimate READING REFERENCE``: one pair of files to a pose and its covariance."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cello3d_ros.config import COVARIANCE_MODES
from cello3d_ros.errors import CloudError, RecordingError
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
        help="what says how far the registration is to be trusted",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random subsamples")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Print the pose and the covariance of one pair."""
    from cello3d_ros.clouds.shape import Cloud, prepare
    from cello3d_ros.covariance.estimator import Estimator
    from cello3d_ros.covariance.model import find_model, load_model
    from cello3d_ros.recordings.files import read_cloud

    model = load_model(find_model(arguments.model))
    T_init = _read_pose(Path(arguments.init)) if arguments.init else np.eye(4)
    rng = np.random.default_rng(arguments.seed)

    def cloud(path: str) -> Cloud:
        try:
            return prepare(read_cloud(Path(path)), model.pipeline.cloud, rng)
        except CloudError as error:
            raise CloudError(f"{path}: {error}") from None

    reading, reference = cloud(arguments.reading), cloud(arguments.reference)
    estimator = Estimator(model, arguments.method)
    answer = as_dict(estimator.register(reading, reference, T_init, rng))
    print(json.dumps(answer, indent=2) if arguments.json else _as_text(answer))


def as_dict(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate as plain numbers.

    T_ref_read: 16, row by row.  covariance: 36, as ROS has it: position along and rotation about
    the fixed axes of the reference.  covariance_reading: 36, of ``T_ref_read exp(xi)``.
    """
    from cello3d_ros.geometry.gaussian import to_fixed_axes

    registration = estimate.registration
    T = registration.T_ref_read
    return {
        "T_ref_read": T.ravel().tolist(),
        "covariance": to_fixed_axes(T[:3, :3], estimate.covariance).ravel().tolist(),
        "covariance_reading": estimate.covariance.ravel().tolist(),
        "overlap_ratio": estimate.overlap_ratio,
        "iterations": registration.n_iterations,
        "converged": registration.converged,
        "residual_rms_m": registration.residual_rms_m,
        "associations": registration.n_associations,
        "method": estimate.method,
        "nearest_rho": estimate.nearest_rho,
        "novelty": estimate.novelty,
        "probably_lost": estimate.is_lost,
        "effective_neighbors": estimate.effective_neighbors,
    }


def _as_text(answer: dict[str, Any]) -> str:
    T = np.reshape(answer["T_ref_read"], (4, 4))
    sigmas = np.sqrt(np.diag(np.reshape(answer["covariance"], (6, 6))))
    state = "converged" if answer["converged"] else "did NOT converge: do not rely on this"
    if answer["probably_lost"]:
        state += ", but probably to a WRONG pose, in another minimum,"
    return "\n".join(
        [
            "T_ref_read",
            *("  " + "  ".join(f"{value:12.6f}" for value in row) for row in T),
            "standard deviations along and about the reference's axes",
            "  x, y, z    " + "  ".join(f"{value:.5f}" for value in sigmas[:3]) + "  m",
            "  rotation   " + "  ".join(f"{value:.6f}" for value in sigmas[3:]) + "  rad",
            f"ICP {state} after {answer['iterations']} iterations, "
            f"{answer['overlap_ratio']:.0%} of the reading overlaps",
            f"nearest example at rho {answer['nearest_rho']:.3g}, "
            f"{answer['effective_neighbors']:.1f} effective neighbors, novelty "
            f"{answer['novelty']:.2f}",
        ]
    )


def _read_pose(path: Path) -> Array:
    """Read a 4x4 or 3x4 pose.  Raises RecordingError when it is none."""
    try:
        values = np.array(path.read_text().replace(",", " ").split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise RecordingError(f"cannot read the pose {path}: {error}") from None
    if values.size not in (12, 16):
        raise RecordingError(f"{path} holds {values.size} numbers, a pose has 16 or 12")
    T = np.eye(4)
    T.flat[: values.size] = values
    if not is_rigid(T):
        raise RecordingError(f"{path} is not a rigid pose: rotation and translation, row by row")
    return T
