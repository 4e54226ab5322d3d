"""The same pose graph with each noise model of its registrations: how near the truth does it end?

    python benchmarks/fusion.py --cache FOLDER [--data FOLDER] [--model general] [--picture FILE]

Each scan of a recording is registered to the three before it; graphs hold these registrations and
the steps of a drifting odometry, whose noise all of them know.  What differs is the covariance of
the registrations.  Constants, scales and the weight of ours are chosen on other recordings than
those that are judged.  Recordings are simulated, or those of ``--data`` with joint reference poses
and an odometry that is made from them.  Registrations are kept in the cache, for each model and
pipeline, so that the same command goes on.  Needs gtsam.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import pickle
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import gtsam
import matplotlib.pyplot as plt
import numpy as np

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import NodeConfig, config_to
from cello3d_ros.covariance.case import DEFAULTS, Case
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.estimator import Estimator, draws
from cello3d_ros.covariance.methods import METHODS
from cello3d_ros.covariance.model import Model, find_model, load_model
from cello3d_ros.errors import Cello3dError
from cello3d_ros.evaluation.comparison import training_mean
from cello3d_ros.geometry.gaussian import bounded, rotation_first
from cello3d_ros.geometry.se3 import Array, inverse, log
from cello3d_ros.learning.align import Alignment
from cello3d_ros.learning.aligned import AlignedPart, aligned_parts
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.odometry import Drift, drift_odometry
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.simulation import Simulation

KINDS = "rooms,hall,corridor,stairs,garden,wood,street,tunnel,field,warehouse"
DRAWN = ("rooms", "stairs", "street", "tunnel")
N_SCANS, MAX_GAP = 32, 3
SINGLE_STEP = "single steps"  # walked, 0.4 to 0.9 m a step
# A robot at 10 Hz and 1 m/s.  Its odometry drifts over a metre as that of the walk does.
ROBOT = Drive(sweeps=False, odometry_share=0.045, odometry_deg_per_m=1.1)
RATES = {SINGLE_STEP: None, "10 Hz": ROBOT}
SCANNER_NAMES = ("spinning16", "spinning32", "vlp16")
FIRST_TUNED, FIRST_JUDGED = 7000, 8000  # seeds, used by nothing else

CONSTANTS = [
    (sigma_m, ratio * sigma_m)
    for sigma_m in (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
    for ratio in (0.05, 0.2, 1.0)
]
SCALES = [4.0**k for k in range(-4, 7)]
WEIGHTS = [1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0]
OURS, CONSTANT, ODOMETRY = "this package", "constant", "odometry alone"
HUBER = 1.345


Kept = TypeVar("Kept")


class Edge(NamedTuple):
    """A registration of scan j to scan i that the node would publish.

    T: (4, 4).  Y: name of a noise model -> (6, 6), translation first, on the side of j.
    """

    i: int
    j: int
    T: Array
    Y: dict[str, Array]
    is_unknown: bool
    is_lost: bool


class Run(NamedTuple):
    """A recording as a graph sees it: true poses, odometry, (n, 4, 4), and registrations."""

    name: str
    kind: str
    rate: str
    truth: Array
    odometry: Array
    drift: Drift
    edges: list[Edge]
    refused: dict[str, int]


class Solution(NamedTuple):
    """Poses (n, 4, 4) of a graph, errors (n - 1, 6), covariances (n - 1, 6, 6) of all but one.

    Ordered (u, omega), on the side of the sensor.
    """

    poses: Array
    errors: Array
    Y: Array

    @property
    def error_m(self) -> float:
        """Root mean square of the position errors."""
        return float(np.sqrt((self.errors[:, :3] ** 2).sum(axis=1).mean()))

    @property
    def error_rad(self) -> float:
        """Root mean square of the rotation errors."""
        return float(np.sqrt((self.errors[:, 3:] ** 2).sum(axis=1).mean()))

    @property
    def nees_over_6(self) -> float:
        """Mean squared Mahalanobis distance of the poses from the truth, over 6."""
        d2 = np.einsum("ni,nij,nj->n", self.errors, np.linalg.inv(self.Y), self.errors)
        return float(d2.mean() / 6.0)


# ---------------------------------------------------------------- recordings and registrations


@dataclass(frozen=True)
class Remembered(Simulation):
    """A simulation whose scans are kept in a folder."""

    folder: Path = Path()

    def __iter__(self) -> Iterator[Scan]:
        def made() -> list[Scan]:
            scans = super(Remembered, self).__iter__()
            return [
                replace(s, points=s.points.astype(np.float32), echoes=None, look=None)
                for s in scans
            ]

        self.folder.mkdir(exist_ok=True)
        for scan in kept(self.folder / f"{self.name}-{self.n_scans}.pickle", made):
            yield replace(scan, points=scan.points.astype(np.float64))


def simulated(
    cache: Path, kind: str, rate: str, seed: int, n_scans: int = N_SCANS
) -> tuple[Remembered, Drift]:
    """Return a simulated recording, whose scans are kept, and how its odometry drifts."""
    scanner, drive = SCANNERS[SCANNER_NAMES[seed % len(SCANNER_NAMES)]], RATES[rate]
    title = f"{kind}-{'walk' if drive is None else 'robot'}-{seed}"
    drift = Drift()
    if drive is not None:
        share, deg_per_m = drive.odometry_share, drive.odometry_deg_per_m
        drift = Drift(share, float(np.radians(deg_per_m)), share)
    folder = cache.parent / "scans"
    recording = Remembered(kind, seed, n_scans, scanner, title=title, drive=drive, folder=folder)
    return recording, drift


def plan(kinds: Sequence[str], n_each: int, first: int) -> list[tuple[str, str, int]]:
    """Return kind, rate and seed of n recordings of each kind and rate."""
    return [
        (kind, rate, first + 100 * k + 10 * r + n)
        for k, kind in enumerate(kinds)
        for r, rate in enumerate(RATES)
        for n in range(n_each)
    ]


def registered(
    name: str, kind: str, rate: str, scans: Iterable, drift: Drift, estimator: Estimator
) -> Run:
    """Register each scan to those before it and give each result every covariance.

    scans: with their true poses and odometry.
    """
    truth, odometry, clouds, edges = [], [], [], []
    refused: dict[str, int] = {}
    for j, scan in enumerate(scans):
        truth.append(scan.T_world_sensor)
        odometry.append(scan.T_odom_sensor)
        rng = draws(scan.points, 0)
        clouds.append(prepare(scan.points, estimator.pipeline.cloud, rng, 1))
        for i in range(max(0, j - MAX_GAP), j):
            T_init = inverse(odometry[i]) @ odometry[j]
            try:
                edges.append(judged(i, j, clouds, T_init, estimator, draws(scan.points, i)))
            except Cello3dError as error:
                refused[error.reason] = refused.get(error.reason, 0) + 1
        if j >= MAX_GAP:
            clouds[j - MAX_GAP] = None
    return Run(name, kind, rate, np.array(truth), np.array(odometry), drift, edges, refused)


def judged(
    i: int,
    j: int,
    clouds: list[Cloud],
    T_init: Array,
    estimator: Estimator,
    rng: np.random.Generator,
) -> Edge:
    """Return a registration with its covariances.  Raises Cello3dError where there is none."""
    reading, reference = clouds[j], clouds[i]
    found = estimator.register(reading, reference, T_init, rng)
    xi, config = log(inverse(T_init) @ found.T_ref_read), NodeConfig()
    limits = config.max_odometry_deviation_m, config.max_odometry_deviation_rad
    if np.linalg.norm(xi[:3]) > limits[0] or np.linalg.norm(xi[3:]) > limits[1]:
        raise Cello3dError("odometry disagrees")
    pipeline, T = estimator.pipeline, found.T_ref_read
    description = describe(reading, reference, T, pipeline, n_rotations=0)
    case = Case(
        *(reading, reference, found.registration, description, pipeline),
        *(estimator.model, rng, estimator.settings),
    )
    Y = {name: METHODS[name](case) for name in ("hessian", "censi", "sandwich")}
    Y[OURS] = found.covariance
    return Edge(i, j, T, Y, found.is_unknown, found.is_lost)


def digest(model: Model, path: Path) -> str:
    """Return what names the answers of a model with its pipeline."""
    settings = json.dumps(config_to(model.pipeline), sort_keys=True)
    return f"{zlib.crc32(path.read_bytes() + settings.encode()):08x}"


def kept(path: Path, made: Callable[[], Kept]) -> Kept:
    """Return what a file keeps, made and written where there is none."""
    if path.exists():
        return pickle.loads(path.read_bytes())
    found = made()
    partial_file = path.with_suffix(".partial")
    partial_file.write_bytes(pickle.dumps(found))
    partial_file.rename(path)
    return found


def one_simulated(cache: Path, model: str, item: tuple[str, str, int]) -> Run:
    """Return one simulated recording, registered."""
    kind, rate, seed = item

    def made() -> Run:
        recording, drift = simulated(cache, kind, rate, seed)
        return registered(recording.name, kind, rate, recording, drift, _estimator(model))

    return kept(cache / f"{kind}-{seed}.pickle", made)


def one_real(cache: Path, model: str, path: Path) -> Run:
    """Return one real recording, registered: joint poses, and an odometry that drifts from them.

    The longest part of the joint poses, at most ``N_SCANS`` scans.
    """
    recording, folder = open_recording(path), cache.parent / "joint"
    folder.mkdir(exist_ok=True)

    def aligned() -> Alignment:
        return aligned_parts(recording, folder / path.name)[0].alignment

    def made() -> Run:
        found = kept(folder / f"{path.name}.pickle", aligned)
        scans = list(itertools.islice(AlignedPart(recording, found), N_SCANS))
        truth = np.array([scan.T_world_sensor for scan in scans])
        odometry = drift_odometry(truth, np.random.default_rng(zlib.crc32(path.name.encode())))
        scans = [replace(s, T_odom_sensor=T) for s, T in zip(scans, odometry, strict=True)]
        return registered(path.name, path.name, "real", scans, Drift(), _estimator(model))

    return kept(cache / f"{path.name}.pickle", made)


def _estimator(model: str) -> Estimator:
    return Estimator(model, settings=DEFAULTS._replace(n_threads=1))


# ---------------------------------------------------------------- graphs


def solved(run: Run, noise: Callable[[Edge], Array] | None, huber: bool = False) -> Solution:
    """Return the poses of the graph of a recording; the first is known.

    noise: covariance (6, 6) of a registration; None leaves registrations out.
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first = gtsam.Pose3(run.truth[0])
    graph.add(gtsam.PriorFactorPose3(0, first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    steps = inverse(run.odometry[:-1]) @ run.odometry[1:]
    for k, T in enumerate(run.truth[0] @ inverse(run.odometry[0]) @ run.odometry):
        start.insert(k, gtsam.Pose3(T))
    for k, (step, sigma) in enumerate(zip(steps, run.drift.sigma(steps), strict=True)):
        Y = np.diag(np.maximum(sigma, 1e-4) ** 2)
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(step), _gaussian(Y)))
    for edge in run.edges if noise is not None else []:
        model = _gaussian(noise(edge))
        if huber:
            robust = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
            model = gtsam.noiseModel.Robust.Create(robust, model)
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T), model))
    values = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, values)
    n = len(run.truth)
    poses = np.array([values.atPose3(k).matrix() for k in range(n)])
    Y = np.array([rotation_first(marginals.marginalCovariance(k)) for k in range(1, n)])
    return Solution(poses, log(inverse(run.truth[1:]) @ poses[1:]), Y)


def _gaussian(Y: Array) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(rotation_first(Y))


def constant(sigma_m: float, sigma_rad: float) -> Callable[[Edge], Array]:
    """Return the noise model of one diagonal for all."""
    Y = np.diag(np.repeat([sigma_m, sigma_rad], 3) ** 2)
    return lambda edge: Y


def scaled(name: str, scale: float) -> Callable[[Edge], Array]:
    """Return the noise model of a method, between the node's floors and ceiling."""
    return lambda edge: bounded(scale * edge.Y[name], 1e-4, 1e-4, DEFAULTS.ceiling)


def one_matrix(Y: Array, scale: float) -> Callable[[Edge], Array]:
    """Return the noise model of one matrix for all."""
    return lambda edge: scale * Y


Noise = Callable[[Edge], Array] | None
Figures = tuple[float, float, float]  # error in m, in rad, NEES / 6


def figures(run: Run, noise: Noise, huber: bool = False) -> Figures:
    """Return position error, rotation error and NEES / 6 of a graph."""
    found = solved(run, noise, huber)
    return found.error_m, found.error_rad, found.nees_over_6


def each(runs: Sequence[Run], noise: Noise, huber: bool = False) -> Array:
    """Return the figures of all recordings.  (n, 3)."""
    return np.array([figures(run, noise, huber) for run in runs])


MEANS = {"mean": np.mean, "geometric mean": lambda values: np.exp(np.mean(np.log(values)))}


def least_error(errors: dict[object, Array], of: str) -> object:
    """Return the key whose errors (n,) are least in a mean of ``MEANS``."""
    return min(errors, key=lambda key: MEANS[of](errors[key]))


def most_consistent(runs: Sequence[Run], candidates: dict, huber: bool = False) -> object:
    """Return the key of the noise model whose median NEES / 6 is nearest to 1."""
    off = {
        key: abs(np.log(np.median(each(runs, noise, huber)[:, 2])))
        for key, noise in candidates.items()
    }
    return min(off, key=off.__getitem__)


# ---------------------------------------------------------------- edges that share a scan


def correlations(runs: Sequence[Run]) -> dict[str, float]:
    """Return how whitened errors of two registrations correlate, by what scan they share.

    Both errors are taken along the axes of the reading of the first.
    """
    sums: dict[str, list[float]] = {}
    for run in runs:
        white = [_white(run, edge) for edge in run.edges]
        for a, one in enumerate(run.edges):
            for b in range(a):
                what = _shared(run.edges[b], one)
                if what:
                    sums.setdefault(what, []).append(float(white[a] @ white[b]) / 6.0)
    size = np.mean([w @ w / 6.0 for run in runs for w in (_white(run, e) for e in run.edges)])
    return {what: float(np.mean(values) / size) for what, values in sorted(sums.items())}


def _white(run: Run, edge: Edge) -> Array:
    """Return the error of a registration in its own standard deviations, at most 5.  (6,)."""
    T = inverse(run.truth[edge.i]) @ run.truth[edge.j]
    L = np.linalg.cholesky(edge.Y[OURS])
    return np.clip(np.linalg.solve(L, log(inverse(T) @ edge.T)), -5.0, 5.0)


def _shared(one: Edge, other: Edge) -> str:
    if one.i == other.i:
        return "the same reference"
    if one.j == other.j:
        return "the same reading"
    return "the reading of one is the other's reference" if one.j == other.i else ""


# ---------------------------------------------------------------- tables


class Row(NamedTuple):
    """A noise model and its figures (n, 3) on the recordings judged."""

    name: str
    noise: Noise
    figures: Array


def constants(
    each: Callable[..., Array], tuned: Sequence, judged_runs: Sequence, **how: bool
) -> Iterator[Row]:
    """Yield the constants with the least errors on other recordings, then on those judged.

    each: what finds the figures (n, 3) of recordings with a noise model.
    """
    candidates = {key: constant(*key) for key in CONSTANTS}
    ending = ", Huber" if how.get("huber") else ""
    for what, chosen in (("tuned for the", tuned), ("best possible", judged_runs)):
        errors = {key: each(chosen, noise, **how)[:, 0] for key, noise in candidates.items()}
        for mean in MEANS:
            key = least_error(errors, mean)
            size = f"{1e3 * key[0]:g} mm {1e3 * key[1]:g} mrad"
            noise = candidates[key]
            name = f"{CONSTANT} {size}, {what} {mean}{ending}"
            yield Row(name, noise, each(judged_runs, noise, **how))


def rows(tuned: Sequence[Run], judged_runs: Sequence[Run], model: Model) -> Iterator[Row]:
    """Yield every noise model, chosen on some recordings, on the others."""
    yield Row(ODOMETRY, None, each(judged_runs, None))
    yield from constants(each, tuned, judged_runs)
    yield from itertools.islice(constants(each, tuned, judged_runs, huber=True), 2)
    mean = training_mean(model)
    others = {"mean covariance of training": partial(one_matrix, mean)}
    others |= {name: partial(scaled, name) for name in ("hessian", "censi", "sandwich")}
    for name, noise in others.items():
        candidates = {scale: noise(scale) for scale in SCALES}
        errors = {scale: each(tuned, candidates[scale])[:, 0] for scale in SCALES}
        scale = least_error(errors, "geometric mean")
        noise = candidates[scale]
        yield Row(f"{name} x {scale:g}, tuned", noise, each(judged_runs, noise))
    yield Row(OURS, scaled(OURS, 1.0), each(judged_runs, scaled(OURS, 1.0)))
    candidates = {weight: scaled(OURS, weight) for weight in WEIGHTS}
    for huber in (False, True):
        weight = most_consistent(tuned, candidates, huber)
        name = f"{OURS} x {weight:g}" + (", Huber" if huber else "")
        yield Row(name, candidates[weight], each(judged_runs, candidates[weight], huber))


def interval(values: Array, of: Callable[[Array], float], n: int = 2000) -> tuple[float, float]:
    """Return the 90 % interval of a statistic over recordings, by bootstrap."""
    rng = np.random.default_rng(0)
    drawn = [of(rng.choice(values, len(values))) for _ in range(n)]
    return tuple(np.quantile(drawn, [0.05, 0.95]))


def table(found: Sequence[Row]) -> str:
    """Return a table for people."""
    lines = [
        "| noise model | position: mean, mm | geometric mean, mm | rotation, mrad "
        "| NEES/6: median [90 %] | in .4-2.2 |",
        "|---|---|---|---|---|---|",
    ]
    for row in found:
        m, rad, nees = row.figures.T
        low, high = interval(nees, np.median)
        share = np.mean((nees >= 0.4) & (nees <= 2.2))
        lines.append(
            f"| {row.name} | {1e3 * m.mean():.1f} | {1e3 * MEANS['geometric mean'](m):.1f} "
            f"| {1e3 * MEANS['geometric mean'](rad):.1f} "
            f"| {np.median(nees):.2f} [{low:.2f}, {high:.2f}] | {100 * share:.0f} % |"
        )
    return "\n".join(lines)


def by_kind(judged_runs: Sequence[Run], found: Sequence[Row]) -> str:
    """Return a table of geometric means of position errors, a row a kind."""
    columns = [0, 1, 2, 3, len(found) - 2, len(found) - 1]
    lines = [
        "| kind | " + " | ".join(found[c].name for c in columns) + " | ours / best | NEES/6 |",
        "|---" * (len(columns) + 3) + "|",
    ]
    for kind in sorted({run.kind for run in judged_runs}):
        mine = np.array([run.kind == kind for run in judged_runs])
        values = [MEANS["geometric mean"](found[c].figures[mine, 0]) for c in columns]
        ratio, nees = values[-2] / min(values[1:4]), np.median(found[-2].figures[mine, 2])
        cells = " | ".join(f"{1e3 * value:.1f}" for value in values)
        lines.append(f"| {kind} | {cells} | {ratio:.2f} | {nees:.2f} |")
    return "\n".join(lines)


def ratios(found: Sequence[Row]) -> str:
    """Return how the errors of ours compare with those of the constants tuned for each mean."""
    lines = []
    for row in (row for row in found if row.name.startswith(OURS)):
        theirs = found[1:3] if "Huber" not in row.name else found[5:7]
        cells = [
            f"{mean} {MEANS[mean](row.figures[:, 0]) / MEANS[mean](other.figures[:, 0]):.2f}"
            for mean, other in zip(MEANS, theirs, strict=True)
        ]
        lines.append(f"{row.name} / constant tuned for it: " + ", ".join(cells))
    return "\n".join(lines)


def told(title: str, tuned: Sequence[Run], runs: Sequence[Run], model: Model) -> list[Row]:
    """Print all tables of a group of recordings."""
    edges = [edge for run in runs for edge in run.edges]
    refused = sum(sum(run.refused.values()) for run in runs)
    print(f"\n## {title}: {len(runs)} recordings\n")
    print(
        f"{len(edges)} registrations ({np.mean([e.is_unknown for e in edges]):.0%} unknown, "
        f"{np.mean([e.is_lost for e in edges]):.1%} lost), {refused} refused; "
        f"tuned on {len(tuned)} others.\n"
    )
    found = list(rows(tuned, runs, model))
    print(table(found) + "\n\n" + ratios(found) + "\n\n" + by_kind(runs, found), flush=True)
    shares = ", ".join(f"{what} {value:.2f}" for what, value in correlations(runs).items())
    print(f"\ncorrelation of whitened errors: {shares}", flush=True)
    return found


def picture(path: Path, runs: Sequence[Run], noises: dict[str, Noise]) -> None:
    """Draw the truth and trajectories by two noise models from above, with 3-sigma ellipses."""
    figure, panels = plt.subplots(2, 2, figsize=(11, 9))
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = 3.0 * np.array([np.cos(angle), np.sin(angle)])
    for axes, run in zip(panels.flat, runs, strict=True):
        T_first = inverse(run.truth[0])
        axes.plot(*(T_first @ run.truth)[:, :2, 3].T, "k-", lw=2, label="truth")
        axes.plot(*(inverse(run.odometry[0]) @ run.odometry)[:, :2, 3].T, "C7:", label=ODOMETRY)
        for (name, noise), colour in zip(noises.items(), ("C1", "C0"), strict=True):
            found = solved(run, noise)
            T = T_first @ found.poses
            label = f"{name}: {1e3 * found.error_m:.0f} mm, NEES/6 {found.nees_over_6:.1f}"
            axes.plot(*T[:, :2, 3].T, ".-", color=colour, ms=4, lw=1, label=label)
            for pose, Y in list(zip(T[1:], found.Y, strict=True))[4::5]:
                R = pose[:3, :3]
                xy = np.linalg.cholesky((R @ Y[:3, :3] @ R.T)[:2, :2]) @ circle
                axes.plot(*(pose[:2, 3:] + xy), "-", color=colour, lw=0.8)
        axes.set(title=run.name, aspect="equal", adjustable="datalim", xlabel="m", ylabel="m")
        axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Register what is missing, tune, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--picture", type=Path, help="file to draw some trajectories to")
    parser.add_argument("--only", default="", help="names of real recordings, divided by commas")
    parser.add_argument("--model", default="general")
    parser.add_argument("--kinds", default=KINDS)
    parser.add_argument("--each", type=int, default=3, help="recordings of each kind and rate")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    path = find_model(arguments.model)
    model = load_model(path)
    cache = arguments.cache / digest(model, path)
    cache.mkdir(parents=True, exist_ok=True)
    kinds = arguments.kinds.split(",")
    tuning = plan(kinds, 2, FIRST_TUNED)
    judging = plan(kinds, arguments.each, FIRST_JUDGED)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        work = partial(one_simulated, cache, arguments.model)
        found = list(pool.map(work, tuning + judging))
    tuned, runs = found[: len(tuning)], found[len(tuning) :]
    for rate in RATES:
        of_rate = [[run for run in some if run.rate == rate] for some in (tuned, runs)]
        result = told(f"simulated, {rate}", *of_rate, model)
        if arguments.picture and rate == SINGLE_STEP:
            chosen = {row.name: row.noise for row in (result[1], result[-2])}
            drawn = [f"{kind}-walk-{FIRST_JUDGED + 100 * kinds.index(kind)}" for kind in DRAWN]
            picture(arguments.picture, [r for r in runs if r.name in drawn], chosen)
    if arguments.data:
        names = set(filter(None, arguments.only.split(",")))
        paths = [p for p in sorted(arguments.data.iterdir()) if p.name in names]
        real = [one_real(cache, arguments.model, p) for p in paths]
        told("real", [run for run in tuned if run.rate == SINGLE_STEP], real, model)


if __name__ == "__main__":
    main()
