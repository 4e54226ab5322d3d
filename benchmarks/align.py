"""Joint reference poses against exact truth, beside pairwise ICP, in simulated worlds.

    python benchmarks/align.py [--kinds garden,hall] [--steps 0.1,0.5] [--scanners spinning32]

Each recording is aligned from its clouds alone.  A line: kind, scanner, step; root mean square
error of a step by pairwise ICP of each pipeline, started near the truth, with the ratio of joint
poses to it in brackets; by joint poses; the error that the alignment expects; scans left out.
Lines that are in ``--out`` already are not computed again.  ``--in-turn`` takes one scanner for
each kind and step, in turn, in place of all.

    python benchmarks/align.py --labels FOLDER [--kinds garden,hall] [--samples 200]

samples a walk in each world about joint and about true poses, and judges the covariances of the
one by those of the other: D2/6 above 1 says that joint poses make covariances too small.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import PIPELINES, Config, Pipeline, SamplingConfig
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import kl
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.align import align
from cello3d_ros.learning.aligned import AlignedPart
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.learning.examples import load_examples
from cello3d_ros.learning.sample import sample
from cello3d_ros.recordings.poses import tum_line
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.registration.icp import register
from cello3d_ros.simulation.paths import Route, walk
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.simulation import Simulation
from cello3d_ros.simulation.worlds import WORLDS, build_world

KINDS = ",".join(WORLDS)
SCANNED_BY = "spinning16,spinning32,spinning64,wide"
PERIOD_NS = 100_000_000


class Bare:
    """A recording of clouds without poses."""

    n_projected = 0
    has_odometry = False

    def __init__(self, name: str, scans: list[Scan]) -> None:
        """Keep the scans."""
        self.name, self.scans = name, scans

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans)

    def track(self) -> None:
        """There are no poses."""


def simulated(
    kind: str, scanner: str, seed: int, step_m: float, n_scans: int
) -> tuple[Bare, Array]:
    """Return the scans of a world each ``step_m`` along its route, and their true poses."""
    layout, way, _ = np.random.default_rng(seed).spawn(3)
    truth = poses_along(build_world(kind, layout).route, step_m, n_scans, way)
    with tempfile.NamedTemporaryFile("w", suffix=".tum") as path:
        path.writelines(tum_line((k + 1) * PERIOD_NS, T) for k, T in enumerate(truth))
        path.flush()
        scans = list(Simulation(kind, seed, n_scans, SCANNERS[scanner], Path(path.name)))
    bare = [Scan(stamp_ns=scan.stamp_ns, points=scan.points) for scan in scans]
    return Bare(f"{kind}-{scanner}-{step_m:g}-{seed}", bare), truth


def poses_along(route: Route, step_m: float, n: int, rng: np.random.Generator) -> Array:
    """Return poses (n, 4, 4) a step apart on the way of a simulated walk."""
    T = walk(route, 10 + int(n * step_m / 0.3), rng.uniform(0.9, 1.5), rng)
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)))
    at = 0.5 + step_m * np.arange(n)
    i = np.minimum(np.searchsorted(s, at, side="right") - 1, len(s) - 2)
    shares = (at - s[i]) / (s[i + 1] - s[i])
    return np.array([se3.interpolate(T[k], T[k + 1], a) for k, a in zip(i, shares, strict=True)])


def pairwise(recording: Bare, truth: Array, pipeline: Pipeline) -> Array:
    """Return the errors (n - 1, 6) of ICP on each pair in a row."""
    clouds = [
        prepare(scan.points, pipeline.cloud, np.random.default_rng(k))
        for k, scan in enumerate(recording)
    ]
    found = []
    for k in range(1, len(clouds)):
        rng = np.random.default_rng([7, k])
        T = se3.inverse(truth[k - 1]) @ truth[k]
        start = T @ se3.exp(rng.normal(size=6) * np.repeat([0.03, 0.005], 3))
        result = register(clouds[k], clouds[k - 1], start, pipeline.icp, rng)
        found.append(se3.log(se3.inverse(T) @ result.T_ref_read))
    return np.array(found)


def errors(poses: Array, truth: Array) -> Array:
    """Return the errors of the steps between poses (n, 4, 4).  (n - 1, 6)."""
    steps, exact = (se3.inverse(T[:-1]) @ T[1:] for T in (poses, truth))
    return np.asarray(se3.log(se3.inverse(exact) @ steps))


def rms(xi: Array) -> list[float]:
    """Return the root mean square errors in mm and mrad."""
    squares = (xi**2).mean(axis=0)
    return [1e3 * float(np.sqrt(squares[part].sum())) for part in (slice(0, 3), slice(3, 6))]


def measured(kind: str, scanner: str, step_m: float, n_scans: int, seed: int) -> dict[str, object]:
    """Return one line of the table."""
    recording, truth = simulated(kind, scanner, seed, step_m, n_scans)
    single = {name: pairwise(recording, truth, pipeline) for name, pipeline in PIPELINES.items()}
    found = align(recording)
    kept = found.members()
    both = np.flatnonzero(np.diff(kept) == 1)
    joint = errors(found.poses[kept], truth[kept])[both]
    steps = zip(kept[:-1][both], kept[1:][both], strict=True)
    Y = np.array([found.step_covariance(int(i), int(j)) for i, j in steps])
    d2 = np.einsum("ni,nij,nj->n", joint, np.linalg.inv(Y), joint)
    return {
        "recording": recording.name,
        "kind": kind,
        "step_m": step_m,
        **{name: rms(xi[kept[:-1][both]]) for name, xi in single.items()},
        "joint": rms(joint),
        "expected": [1e3 * sigma for sigma in found.sigmas()],
        "d2_over_6": float(d2.mean() / 6.0),
        "n_left_out": len(found.reasons),
        "n_sweeps": len(found.moves_m),
    }


def labels(kind: str, folder: Path, n_samples: int, seed: int, n_scans: int) -> str:
    """Return a line on the covariances about joint poses, judged by those about true ones."""
    config = Config(sampling=SamplingConfig(n_samples=n_samples, max_gap=2))
    exact = Simulation(kind, seed, n_scans)
    bare = [Scan(stamp_ns=scan.stamp_ns, points=scan.points) for scan in exact]
    found = align(Bare(exact.name, bare))
    truth, joint = folder / f"{exact.name}.exact", folder / f"{exact.name}.joint"
    sample([exact], truth, config, 2)
    sample([AlignedPart(Bare(exact.name, bare), found)], joint, config, 2)
    if found.reasons:
        return f"{kind:9} scans left out: {found.reasons}"
    datasets = [open_dataset(path) for path in (truth, joint)]
    both = {
        key
        for key in datasets[0].pair_keys()
        if all(data.read(*key).accepted for data in datasets)
    }
    Y_true, Y_joint = (
        load_examples([data], {exact.name}).covariances[
            [key in both for key in data.pair_keys() if data.read(*key).accepted]
        ]
        for data in datasets
    )
    fit = np.trace(np.linalg.solve(Y_joint, Y_true), axis1=1, axis2=2) / 6.0
    size = np.sqrt(
        np.mean([np.trace(Y[:, :3, :3], axis1=1, axis2=2) for Y in (Y_joint, Y_true)], 1)
    )
    return (
        f"{kind:9} {len(both)} pairs, sigma {1e3 * size[0]:.2f} mm (exact {1e3 * size[1]:.2f}), "
        f"KL median {np.median(kl(Y_true, Y_joint)):.2f}, D2/6 median {np.median(fit):.2f} "
        f"mean {fit.mean():.2f}"
    )


def main() -> None:
    """Measure what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", default=KINDS)
    parser.add_argument("--steps", default="0.02,0.1,0.5,1.5")
    parser.add_argument("--scanners", default=SCANNED_BY)
    parser.add_argument("--in-turn", action="store_true", help="one scanner for each cell")
    parser.add_argument("--seeds", default="21")
    parser.add_argument("--scans", type=int, default=10)
    parser.add_argument("--out", type=Path, help="JSON lines, to write and to go on from")
    parser.add_argument("--labels", type=Path, help="folder for datasets: compare labels instead")
    parser.add_argument("--samples", type=int, default=200)
    arguments = parser.parse_args()
    if arguments.labels:
        for kind in arguments.kinds.split(","):
            for seed in map(int, arguments.seeds.split(",")):
                n = arguments.scans
                print(labels(kind, arguments.labels, arguments.samples, seed, n), flush=True)
        return
    done = {}
    if arguments.out and arguments.out.exists():
        rows = map(json.loads, arguments.out.read_text().splitlines())
        done = {row["recording"]: row for row in rows}
    rows = defaultdict(list)
    for kind, scanner, step in cells(arguments):
        for seed in map(int, arguments.seeds.split(",")):
            n = max(arguments.scans, int(min(30, 1.4 / step)))
            name = f"{kind}-{scanner}-{step:g}-{seed}"
            row = done.get(name) or measured(kind, scanner, step, n, seed)
            if name not in done and arguments.out:
                with arguments.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            rows[kind, scanner, step].append(row)
        print(line(kind, scanner, step, rows[kind, scanner, step]), flush=True)
    print(together([row for found in rows.values() for row in found]))


def cells(arguments: argparse.Namespace) -> Iterator[tuple[str, str, float]]:
    """Yield what is measured: kind, scanner, step."""
    scanners = arguments.scanners.split(",")
    for i, kind in enumerate(arguments.kinds.split(",")):
        for j, step in enumerate(map(float, arguments.steps.split(","))):
            for scanner in [scanners[(i + j) % len(scanners)]] if arguments.in_turn else scanners:
                yield kind, scanner, step


def line(kind: str, scanner: str, step: float, rows: list[dict]) -> str:
    """Return one line for people, over the seeds."""
    mean = {
        key: np.sqrt(np.mean(np.square([row[key] for row in rows]), axis=0))
        for key in (*PIPELINES, "joint", "expected")
    }
    joint = mean["joint"]
    pairs = "  ".join(
        f"{name} {mean[name][0]:6.2f} mm {mean[name][1]:5.2f} mrad "
        f"({joint[0] / mean[name][0]:.2f}, {joint[1] / mean[name][1]:.2f})"
        for name in PIPELINES
    )
    return (
        f"{kind:13} {scanner:11} {step:5.2f} m  {pairs}  joint {joint[0]:6.2f} {joint[1]:5.2f}  "
        f"expected {mean['expected'][0]:6.2f} {mean['expected'][1]:5.2f}  "
        f"D2/6 {np.mean([row['d2_over_6'] for row in rows]):.2f}  "
        f"left out {sum(row['n_left_out'] for row in rows)}"
    )


def together(rows: list[dict]) -> str:
    """Return one line over all recordings: geometric means of the ratios and of D2/6."""
    logs = [
        [np.log(row["joint"][0] / row[name][0]) for name in PIPELINES] + [np.log(row["d2_over_6"])]
        for row in rows
    ]
    *ratios, d2_over_6 = np.exp(np.mean(logs, axis=0))
    said = ", ".join(f"{r:.2f} of pairs by {name}" for r, name in zip(ratios, PIPELINES))
    return f"{len(rows)} recordings: {said}; D2/6 {d2_over_6:.2f}"


if __name__ == "__main__":
    main()
