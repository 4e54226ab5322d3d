"""How chains of registrations hold on simulated drives of 7 m, and on a parked robot.

    python benchmarks/chains.py --seeds 0 10 [--kinds garden rooms] [--json FILE]
    python benchmarks/chains.py --parked 600 --rate 10 --seeds 0 1

Each recording is driven once at 20 scans a second and tracked as by the node, without ROS, with
every scan, every second, every fourth and every twentieth: 20, 10, 5 and 1 Hz.  ``end_mm`` is the
error of the last pose (root mean square over the recordings), ``D_M`` its mean Mahalanobis
distance (2.35 is ideal), ``in 95 %`` the share within the bound of 95 %.  ``step`` and ``twist``
are means of D2/6 of single registrations and of the motion between two answers, ``1 s`` to ``20
s`` of the sum of these motions over so long, as if they were independent, and ``drift_mm_s`` is
the error of the mean velocity.  One recording is one sample, by a scanner of its own.  Odometry
drifts by half a percent.
A run with --json goes on where that file ends.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from cello3d_ros.config import NodeConfig, Pipeline
from cello3d_ros.covariance.model import Model, load_model
from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry.gaussian import Chained, GaussianPose, extended, mahalanobis
from cello3d_ros.geometry.se3 import Array, inverse, log
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS, calibrated
from cello3d_ros.simulation.simulation import Simulation
from cello3d_ros.tracking.guess import Place
from cello3d_ros.tracking.tracker import Answer, Tracker

KINDS = {
    "garden": ("garden", "spinning32", 1.2),
    "garden16": ("garden", "spinning16", 1.2),
    "wood": ("wood", "spinning32", 1.2),
    "hall": ("hall", "spinning32", 1.2),
    "rooms": ("rooms", "spinning32", 1.2),
    "corridor": ("corridor", "spinning32", 1.2),
    "stairs": ("stairs", "spinning32", 1.2),
    "street": ("street", "vlp16", 4.0),
}
EVERY = {20: 1, 10: 2, 5: 4, 1: 20}
SUMS_S = (1, 5, 20)


def main() -> None:
    """Run and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 10), help="first and end")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=6.0, help="of a drive")
    parser.add_argument("--pairing", default="keyframe")
    parser.add_argument("--model", default="general")
    parser.add_argument("--parked", type=float, metavar="S", help="stand still for so long")
    parser.add_argument("--rate", type=float, default=10.0, help="of a parked robot, in Hz")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    model = load_model(arguments.model)
    known = json.loads(arguments.json.read_text()) if has(arguments.json) else {}
    for seed in range(*arguments.seeds):
        for kind in arguments.kinds:
            if f"{kind}-{seed}" in known:
                continue
            known[f"{kind}-{seed}"] = recorded(kind, seed, model, arguments)
            if arguments.json:
                arguments.json.write_text(json.dumps(known))
    print(table(known, arguments))


def has(path: Path | None) -> bool:
    """Return whether a file is there."""
    return path is not None and path.exists()


def recorded(kind: str, seed: int, model: Model, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the measures of one recording, by rate."""
    world, scanner, speed_m_s = KINDS[kind]
    node = NodeConfig(pairing=arguments.pairing)
    if arguments.parked:
        n, rates = round(arguments.parked * arguments.rate), {arguments.rate: 1}
        drive = Drive(motion="still", sweeps=False, rate_hz=arguments.rate)
    else:
        n, rates = round(20 * arguments.seconds) + 1, EVERY
        drive = Drive(rate_hz=20.0, speed_m_s=speed_m_s, sweeps=False)
    own = calibrated(SCANNERS[scanner], np.random.default_rng(seed))
    scans: Any = Simulation(world, seed, n, own, drive=drive)
    scans = scans if arguments.parked else list(scans)
    found = {}
    for rate_hz, every in rates.items():
        some = scans if every == 1 else scans[::every]
        found[f"{rate_hz:g}"] = measured(*tracked(some, Tracker(model, Pipeline(), node)))
    return found


def tracked(scans: Sequence[Scan], tracker: Tracker) -> tuple[list[Answer], dict[int, Array]]:
    """Return the answers of a chain and the true poses in the frame of its odometry, by stamp."""
    answers, truth, T_odom_world = [], {}, None
    for scan in scans:
        if T_odom_world is None:
            T_odom_world = scan.T_odom_sensor @ inverse(scan.T_world_sensor)
        truth[scan.stamp_ns] = T_odom_world @ scan.T_world_sensor
        try:
            answer = tracker.step(scan.stamp_ns, scan.points, Place(scan.T_odom_sensor))
        except Cello3dError:
            continue
        answers += [] if answer is None else [answer]
    if tracker.n_restarts:
        return [], truth
    return answers, truth


def measured(answers: list[Answer], truth: dict[int, Array]) -> dict[str, float] | None:
    """Return how well a chain and its parts know themselves; None where it broke."""
    if not answers:
        return None
    stamps = np.array(list(truth))
    steps, motions = [], []
    for answer in answers:
        T_true, estimate = truth[answer.stamp_ns], answer.estimate
        T_step = inverse(truth[answer.reference_ns]) @ T_true
        steps.append(squared(T_step, GaussianPose(estimate.T_ref_read, estimate.covariance)))
        if answer.motion is not None:
            before = np.abs(stamps - (answer.stamp_ns - 1e9 * answer.span_s)).argmin()
            motions.append((inverse(truth[stamps[before]]) @ T_true, answer.motion))
    last = answers[-1]
    xi = log(inverse(truth[last.stamp_ns]) @ last.pose.T)
    found = {
        "end_mm": 1e3 * float(np.linalg.norm(xi[:3])),
        "d2": squared(truth[last.stamp_ns], last.pose),
        "step": float(np.mean(steps)),
        "twist": float(np.mean([squared(*motion) for motion in motions])),
        "keyframes": len({answer.reference_ns for answer in answers}),
        "failed": len(truth) - 1 - len(answers),
    }
    span_s = 1e-9 * (last.stamp_ns - answers[0].stamp_ns) / max(len(answers) - 1, 1)
    for sum_s in SUMS_S:
        n = max(1, round(sum_s / span_s))
        parts = [motions[i : i + n] for i in range(0, len(motions) - n + 1, n)]
        if parts and n > 1:
            found[f"{sum_s} s"] = float(np.mean([summed(part) for part in parts]))
    wrong = [log(inverse(T) @ motion.T)[:3] for T, motion in motions]
    found["drift_mm_s"] = 1e3 * float(np.linalg.norm(np.mean(wrong, axis=0))) / span_s
    return found


def squared(T_true: Array, pose: GaussianPose) -> float:
    """Return D2/6 of a pose."""
    return float(mahalanobis(log(inverse(T_true) @ pose.T), pose.Y) ** 2) / 6.0


def summed(motions: list[tuple[Array, GaussianPose]]) -> float:
    """Return D2/6 of many motions after each other, taken as independent."""
    T_true, chain = np.eye(4), Chained.start(np.eye(4))
    for T, motion in motions:
        T_true, chain = T_true @ T, extended(chain, motion)
    return squared(T_true, chain.pose)


def table(known: dict[str, Any], arguments: argparse.Namespace) -> str:
    """Return the means over the recordings of a kind and a rate, as Markdown."""
    names = ["step", "twist", *(f"{s} s" for s in SUMS_S)]
    head = ["kind", "Hz", "n", "end_mm", "D_M", "in 95 %", *names, "keyframes", "drift_mm_s"]
    rows = [head, ["---"] * len(head)]
    rates = list(next(iter(known.values())))
    for kind in arguments.kinds:
        for rate in rates:
            every = [v[rate] for k, v in known.items() if k.rsplit("-", 1)[0] == kind]
            good = [v for v in every if v is not None]
            if not good:
                continue
            d2 = 6 * np.array([v["d2"] for v in good])
            row = [kind, rate, f"{len(good)}" + f" of {len(every)}" * (len(good) < len(every))]
            row.append(f"{np.sqrt(np.mean([v['end_mm'] ** 2 for v in good])):.0f}")
            row += [f"{np.sqrt(d2).mean():.2f}", f"{np.mean(d2 <= chdtri(6, 0.05)):.2f}"]
            for name in [*names, "keyframes", "drift_mm_s"]:
                values = [v[name] for v in good if name in v]
                row.append(f"{np.mean(values):.2f}" if values else "")
            rows.append(row)
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


if __name__ == "__main__":
    main()
