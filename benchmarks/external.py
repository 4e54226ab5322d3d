"""Poses of KISS-ICP taken as registrations: how consistent are the covariances they are given?

    pip install kiss-icp
    python benchmarks/external.py --recording DIR --json FILE

KISS-ICP registers each scan to its own local map, from its own first guess, without odometry.
Its poses go through the part of the node that ``node.registration: external`` uses; beside it
stand ``unseen``, the same with ``max_external_offset: 0``, and ``icp``, our own registrations of
the same pairs from drifting odometry.  Errors are those of consecutive relative poses against the
poses of the recording, which may be no better themselves.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cello3d_ros.config import Config, NodeConfig, sections_of
from cello3d_ros.covariance.model import load_model, shipped_model_path
from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import mahalanobis
from cello3d_ros.recordings import Recording, Scan, open_recording
from cello3d_ros.recordings.odometry import SimulatedOdometry
from cello3d_ros.tracking.guess import EXTERNAL, ODOMETRY, Place
from cello3d_ros.tracking.tracker import Answer, Tracker

CHI2_95 = 12.592  # of 6 degrees of freedom


def kiss_icp(recording: Recording, max_range_m: float) -> Iterator[tuple[Scan, np.ndarray, float]]:
    """Yield each scan, its pose and the milliseconds it took, by KISS-ICP as it comes."""
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.deskew = False  # the scans' points have no times
    config.data.max_range = max_range_m
    config.mapping.voxel_size = max_range_m / 100.0
    odometry = KissICP(config)
    for scan in recording:
        started = time.perf_counter()
        odometry.register_frame(scan.points, np.zeros(len(scan.points)))
        yield scan, odometry.last_pose.copy(), 1e3 * (time.perf_counter() - started)


def run(steps: Iterator[tuple[Scan, Place]], tracker: Tracker) -> dict[str, Any]:
    """Return the figures of all answers to some scans."""
    answers: list[tuple[Answer, np.ndarray]] = []
    failures: dict[str, int] = {}
    before: dict[int, np.ndarray] = {}
    for scan, place in steps:
        before[scan.stamp_ns] = scan.T_world_sensor
        try:
            answer = tracker.step(scan.stamp_ns, scan.points, place)
        except Cello3dError as error:
            failures[type(error).__name__] = failures.get(type(error).__name__, 0) + 1
            continue
        if answer is not None:
            T_true = se3.inverse(before[answer.reference_ns]) @ scan.T_world_sensor
            T_hat = answer.step.T
            answers.append((answer, se3.log(se3.inverse(T_true) @ T_hat)))
    return figures(answers) | {"failures": failures}


def figures(answers: list[tuple[Answer, np.ndarray]]) -> dict[str, Any]:
    """Return errors and how they compare with the covariances."""
    xi = np.array([error for _, error in answers])
    Y = np.array([answer.step.Y for answer, _ in answers])
    D2 = mahalanobis(xi, Y) ** 2
    sigma = np.sqrt(np.linalg.eigvalsh(Y[:, :3, :3])[:, -1])
    return {
        "n": len(answers),
        "error_m": float(np.median(np.linalg.norm(xi[:, :3], axis=1))),
        "error_rad": float(np.median(np.linalg.norm(xi[:, 3:], axis=1))),
        "sigma_long_axis_m": float(np.median(sigma)),
        "d2_over_6": float(D2.mean() / 6),
        "d2_over_6_median": float(np.median(D2) / 5.348),  # 1 when consistent
        "in_95": float((D2 <= CHI2_95).mean()),
        "overlap": float(np.median([answer.estimate.overlap_ratio for answer, _ in answers])),
    }


def main() -> None:
    """Print a table, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recording", type=Path, required=True)
    parser.add_argument("--max-range", type=float, default=100.0)
    parser.add_argument("--model", type=Path, default=shipped_model_path())
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    recording = open_recording(arguments.recording)
    model = load_model(arguments.model)
    pipeline = sections_of(model.pipeline)

    def tracker(**settings: Any) -> Tracker:
        config = Config(**pipeline, node=NodeConfig(**settings))
        return Tracker(model, config, config.node)

    theirs = list(kiss_icp(recording, arguments.max_range))
    found = {
        name: run(
            ((scan, Place(T, guess=EXTERNAL)) for scan, T, _ in theirs),
            tracker(registration="external", **settings),
        )
        for name, settings in (("external", {}), ("unseen", {"max_external_offset": 0.0}))
    } | {
        "icp": run(
            ((s, Place(s.T_odom_sensor, guess=ODOMETRY)) for s in SimulatedOdometry(recording)),
            tracker(),
        ),
        "kiss_icp_ms": float(np.median([ms for *_, ms in theirs])),
        "recording": recording.name,
    }
    print(json.dumps(found, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
