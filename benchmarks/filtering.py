"""Filters of wheel odometry and the node's answers at 10 Hz: error and consistency.

    python benchmarks/filtering.py --cache FOLDER [--model general] [--each 3]

A robot drives at 1 m/s through simulated worlds; the node's tracker answers each scan.  Two
filters (``filters.py``) take the velocity or the relative pose that the node publishes: that of
robot_localization with config/examples/robot_localization.yaml, and an error-state filter by the
rules of fuse.  What differs is the covariance of the answers: the node's, or one constant that was
chosen on other recordings.  Answers are kept in the cache.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import fusion
import numpy as np
import yaml
from filters import RATES, TILT, VELOCITIES, chained, localized
from fusion import (
    FIRST_JUDGED,
    FIRST_TUNED,
    KINDS,
    ODOMETRY,
    OURS,
    Row,
    constants,
    digest,
    kept,
    ratios,
    simulated,
    table,
)

from cello3d_ros.config import NodeConfig
from cello3d_ros.covariance.model import find_model, load_model
from cello3d_ros.geometry.gaussian import GaussianPose
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array, inverse, log
from cello3d_ros.recordings.odometry import Drift
from cello3d_ros.tracking.covariances import twist_covariance
from cello3d_ros.tracking.offline import replay
from cello3d_ros.tracking.tracker import Tracker

EXAMPLE = Path(__file__).parents[1] / "config" / "examples" / "robot_localization.yaml"
FUSE, LOCALIZATION = "fuse", "robot_localization"
ROBOT_RATE = "10 Hz"
N_SCANS = 80  # 8 s
N_IMU = 5  # to a scan: 50 Hz
GYRO_RAD_S, TILT_RAD = 0.002, 0.005  # noise of the IMU

Noise = Callable[[GaussianPose], Array] | None  # motion -> covariance (6, 6); None: no answers


class Imu(NamedTuple):
    """Times, ``N_IMU`` to a scan, rates of turn (m, 3) and roll and pitch (m, 2)."""

    times_s: Array
    rates: Array
    tilts: Array


class Heard(NamedTuple):
    """What a filter hears.  truth, odometry: (n, 4, 4); motions: of all scans but the first."""

    name: str
    kind: str
    times_s: Array
    truth: Array
    odometry: Array
    drift: Drift
    motions: list[GaussianPose | None]
    spans_s: list[float]
    imu: Imu


def imu(track: PoseTrack, stamps_ns: Array, rng: np.random.Generator) -> Imu:
    """Return what an IMU measures, with white noise."""
    times = np.linspace(
        0.0, 1e-9 * (stamps_ns[-1] - stamps_ns[0]), N_IMU * (len(stamps_ns) - 1) + 1
    )
    T = track.motion(int(stamps_ns[0]), 0.0, times[-1]).at(times)
    rates = log(inverse(T[:-1]) @ T[1:])[:, 3:] / np.diff(times)[:, None]
    tilts = _euler(track.at(int(stamps_ns[0])) @ T[1:])[:, 3:5]
    rates = rates + rng.normal(scale=GYRO_RAD_S, size=rates.shape)
    return Imu(times[1:], rates, tilts + rng.normal(scale=TILT_RAD, size=tilts.shape))


def heard(cache: Path, model: str, kind: str, seed: int) -> Heard:
    """Return what the node answers to a simulated recording."""
    recording, drift = simulated(cache, kind, ROBOT_RATE, seed, N_SCANS)
    loaded, config = load_model(model), NodeConfig()
    steps = list(replay(recording, Tracker(loaded, loaded.pipeline, config), config))
    answers = [None if step.answer is None else step.answer for step in steps[1:]]
    stamps = np.array([step.scan.stamp_ns for step in steps])
    return Heard(
        recording.name,
        kind,
        1e-9 * (stamps - stamps[0]),
        np.array([step.scan.T_world_sensor for step in steps]),
        np.array([step.scan.T_odom_sensor for step in steps]),
        drift,
        [None if answer is None else answer.motion for answer in answers],
        [0.0 if a is None or a.span_s is None else a.span_s for a in answers],
        imu(recording.true_track(), stamps, np.random.default_rng(seed)),
    )


def one(cache: Path, model: str, item: tuple[str, int]) -> Heard:
    """Return one recording, kept in the cache."""
    kind, seed = item
    return kept(cache / f"filter-{kind}-{seed}.pickle", partial(heard, cache, model, kind, seed))


def by_fuse(run: Heard, noise: Noise) -> tuple[Array, Array]:
    """Return errors (n - 1, 6) and covariances of the error-state filter."""
    T_odom = inverse(run.odometry[:-1]) @ run.odometry[1:]
    sigma = run.drift.sigma(T_odom)
    steps = [GaussianPose(T, np.diag(s**2)) for T, s in zip(T_odom, sigma, strict=True)]
    answers = [
        None if motion is None or noise is None else GaussianPose(motion.T, noise(motion))
        for motion in run.motions
    ]
    found = list(chained(steps, answers, started(run)))
    truth = inverse(run.truth[0]) @ run.truth[1:]
    errors = log(inverse(truth) @ np.array([pose.T for pose in found]))
    return errors, np.array([pose.Y for pose in found])


def started(run: Heard) -> set[int]:
    """Return the numbers of the scans from which a motion is seen."""
    ends = np.array([k for k, motion in enumerate(run.motions, 1) if motion is not None], int)
    starts = run.times_s[ends] - np.array(run.spans_s)[ends - 1]
    return set(np.abs(run.times_s[:, None] - starts).argmin(axis=0).tolist())


def by_localization(Q: Array, run: Heard, noise: Noise) -> tuple[Array, Array]:
    """Return errors (n - 1, 6), x y z roll pitch yaw, and covariances of robot_localization.

    It hears the IMU and the velocities of the node at their stamps.
    """
    measured = [
        (t, [(RATES, rate, GYRO_RAD_S**2 * np.eye(3)), (TILT, tilt, TILT_RAD**2 * np.eye(2))])
        for t, rate, tilt in zip(*run.imu, strict=True)
    ]
    for k, (motion, span_s) in enumerate(zip(run.motions, run.spans_s, strict=True)):
        if motion is not None and noise is not None and span_s > 0.0:
            C = twist_covariance(noise(motion), span_s, 1e-4, 1e-4, 900.0)
            measured[N_IMU * (k + 1) - 1][1].append((VELOCITIES, log(motion.T) / span_s, C))
    x = np.zeros(15)
    x[:6] = _euler(run.truth[:1])[0]
    x[6:12] = log(inverse(run.truth[0]) @ run.truth[1]) / run.times_s[1]
    found = list(localized(Q, measured, x))[N_IMU - 1 :: N_IMU]
    errors = np.array([p for p, _ in found]) - _euler(run.truth[1:])
    errors[:, 3:] = (errors[:, 3:] + np.pi) % (2.0 * np.pi) - np.pi
    return errors, np.array([P for _, P in found])


def _euler(T: Array) -> Array:
    R = T[:, :3, :3]
    roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.column_stack([T[:, :3, 3], roll, -np.arcsin(R[:, 2, 0]), yaw])


def figures(filtered: Callable, run: Heard, noise: Noise) -> tuple[float, float, float]:
    """Return position error, rotation error and NEES / 6."""
    errors, P = filtered(run, noise)
    d2 = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(P), errors)
    rms = [float(np.sqrt((errors[:, s] ** 2).sum(1).mean())) for s in (slice(3), slice(3, 6))]
    return rms[0], rms[1], float(d2.mean() / 6.0)


def process_noise() -> Array:
    """Return the matrix (15, 15) of the example."""
    tree = yaml.safe_load(EXAMPLE.read_text())["ekf_filter_node"]["ros__parameters"]
    return np.array(tree["process_noise_covariance"]).reshape(15, 15)


def rows(filtered: Callable, tuned: Sequence[Heard], runs: Sequence[Heard]) -> Iterator[Row]:
    """Yield odometry alone, the constants and the node's covariances."""

    def each(some: Sequence[Heard], noise: Noise) -> Array:
        return np.array([figures(filtered, run, noise) for run in some])

    yield Row(ODOMETRY, None, each(runs, None))
    yield from constants(each, tuned, runs)
    yield Row(OURS, _as_published, each(runs, _as_published))


def _as_published(motion: GaussianPose) -> Array:
    return motion.Y


def main() -> None:
    """Answer what is missing, filter and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--model", default="general")
    parser.add_argument("--kinds", default=KINDS)
    parser.add_argument("--each", type=int, default=2, help="recordings of each kind")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    path = find_model(arguments.model)
    cache = arguments.cache / digest(load_model(path), path)
    cache.mkdir(parents=True, exist_ok=True)
    kinds, offset = arguments.kinds.split(","), 10 * list(fusion.RATES).index(ROBOT_RATE)
    items = [(kind, FIRST_TUNED + 100 * k + offset) for k, kind in enumerate(kinds)]
    items += [
        (kind, FIRST_JUDGED + 100 * k + offset + n)
        for k, kind in enumerate(kinds)
        for n in range(arguments.each)
    ]
    with ProcessPoolExecutor(arguments.jobs) as pool:
        found = list(pool.map(partial(one, cache, arguments.model), items))
    tuned, runs = found[: len(kinds)], found[len(kinds) :]
    filters = {FUSE: by_fuse, LOCALIZATION: partial(by_localization, process_noise())}
    for name, filtered in filters.items():
        result = list(rows(filtered, tuned, runs))
        print(f"\n## {name}: {len(runs)} recordings, {len(runs[0].truth)} scans each\n")
        print(table(result))
        print("\n" + ratios(result) + "\n")
        for kind in kinds:
            mine = np.array([run.kind == kind for run in runs])
            cells = [f"{1e3 * row.figures[mine, 0].mean():.1f} mm" for row in result]
            nees = np.median(result[-1].figures[mine, 2])
            print(f"{kind:10} " + " ".join(f"{c:>10}" for c in cells) + f"  NEES/6 {nees:.2f}")


if __name__ == "__main__":
    main()
