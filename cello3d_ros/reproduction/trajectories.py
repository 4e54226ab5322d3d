"""Odometry over two sequences, under compounded covariances that were sampled or predicted."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cello3d_ros.errors import DatasetError
from cello3d_ros.evaluation.online import prepared
from cello3d_ros.evaluation.trajectories import compound_path, runs_of_models
from cello3d_ros.geometry.gaussian import GaussianPose, to_fixed_axes
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.models import MODELS, TRAINED, Place, datasets, testable, trained
from cello3d_ros.reproduction.result import Result
from cello3d_ros.reproduction.sequences import SEQUENCES

SHOWN = ("wood_summer", "gazebo_winter")  # as in the paper
_N_RUNS = 20  # as in the paper
_N_SIGMA = 2.0
_MODELS = {"sampled": "sampled", "paper": "paper's model", "relative": "relative model"}


class _Walk(NamedTuple):
    """truth: (L, 4, 4) in the frame of the first scan.  paths: by model, poses at scans 1..L-1;
    runs: the same of the odometries that are drawn; n_lost: of how many a registration ended in
    another minimum.
    """

    truth: Array
    paths: dict[str, list[GaussianPose]]
    runs: list[list[GaussianPose]]
    n_lost: int


def make(place: Place) -> Result:
    """Draw 20 runs of each sequence with the ellipses of three covariances."""
    keys = [key for key in SHOWN if key in testable(place.recordings)]
    if not keys:
        titles = " and ".join(SEQUENCES[key].title for key in SHOWN)
        raise DatasetError(f"the figure needs {titles}, one at least, and the other season")
    found = datasets(place, {k for key in keys for k in (key, *SEQUENCES[key].trained_on)})
    shown = {key: _walk(place, found, key) for key in keys}
    inside = {
        key: {name: _share_inside(walk, path[-1]) for name, path in walk.paths.items()}
        for key, walk in shown.items()
    }
    data = {
        "n_sigma": _N_SIGMA,
        "sequences": {key: _data(walk, inside[key]) for key, walk in shown.items()},
    }
    rows: list[list[Any]] = [["sequence", "run", "scan", "x_m", "y_m", "z_m"]]
    rows += [
        [key, run, k + 1, *np.round(pose.T[:3, 3], 5).tolist()]
        for key, walk in shown.items()
        for run, path in enumerate(walk.runs)
        for k, pose in enumerate(path)
    ]
    sentences = [_sentence(key, walk, inside[key]) for key, walk in shown.items()]
    text = (
        f"Runs of ICP odometry from above, {_N_RUNS} at most, with ellipses of {_N_SIGMA:g}σ of "
        f"the compounded covariance at each scan. Sampled covariances and those of the paper's "
        f"model are compounded as independent steps, as in the paper, those of the relative model "
        f"with the bias that neighbouring steps share. Black is the truth, green the end. Errors "
        f"and ellipses are drawn larger by the factor at the axis. Share of the drawn ends within "
        f"the final ellipse, ideally 86 %. {'. '.join(sentences)}."
    )
    title = "Trajectories: sampled against predicted covariances"
    return Result("fig-trajectories", title, text, data, rows, _figure(shown))


def _data(walk: _Walk, inside: dict[str, float]) -> dict[str, Any]:
    return {
        "truth": np.round(walk.truth[:, :3, 3], 5).tolist(),
        "covariances": {
            name: [_positions(pose).tolist() for pose in path] for name, path in walk.paths.items()
        },
        "share_of_finals_inside": inside,
        "n_drawn": len(walk.runs),
        "n_lost": walk.n_lost,
        "n_runs": _N_RUNS,
    }


def _sentence(key: str, walk: _Walk, inside: dict[str, float]) -> str:
    told = ", ".join(f"{share:.0%} ({_MODELS[name]})" for name, share in inside.items())
    return (
        f"{SEQUENCES[key].title}: {told}; {walk.n_lost} of {_N_RUNS} runs had a registration "
        f"in another minimum, which no covariance covers, and "
        f"{'are not drawn' if walk.n_lost < _N_RUNS else 'are drawn nevertheless'}"
    )


def _walk(place: Place, found: dict[str, Dataset], key: str) -> _Walk:
    configs = {name: MODELS[name] for name in TRAINED}
    models, _ = trained(place, found, key, configs)
    recording, workshop, dataset = place.recordings[key], place.workshop, found[key]
    scans = range(len(recording))
    records = [dataset.read(recording.name, k - 1, k) for k in scans[1:]]
    if bad := [record for record in records if not record.accepted]:
        raise DatasetError(f"{dataset.path}: pair {bad[0].key} was rejected ({bad[0].reason})")
    clouds, poses = prepared(recording, dataset.pipeline, scans, workshop.seed)
    T = np.array([poses[k] for k in scans])
    truth = inverse(T[0]) @ T
    paths = {"sampled": compound_path([GaussianPose(r.T_mean, r.covariance) for r in records])}
    every = runs_of_models(
        *([clouds[k] for k in scans], T, list(models.values()), _N_RUNS),
        *(workshop.seed, workshop.n_threads),
    )
    runs = every[0]
    if not runs.paths:
        raise DatasetError(f"{recording.name}: no run of odometry has an answer")
    found_way = np.flatnonzero(~runs.lost)
    if not len(found_way):
        found_way = np.arange(len(runs.paths))
    first = int(found_way[0])
    paths |= {name: of_model.paths[first] for name, of_model in zip(models, every, strict=True)}
    drawn = [runs.paths[k] for k in found_way[:_N_RUNS]]
    return _Walk(truth, paths, drawn, int(runs.lost.sum()))


def _positions(pose: GaussianPose) -> Array:
    """Return the covariance of the position along the axes of the first scan.  (3, 3)."""
    return to_fixed_axes(pose.T[:3, :3], pose.Y)[:3, :3]


def _share_inside(walk: _Walk, last: GaussianPose) -> float:
    """Return the share of final positions, from above, within the final ellipse."""
    C = _positions(last)[:2, :2]
    off = np.array([path[-1].T[:2, 3] for path in walk.runs]) - walk.truth[-1, :2, 3]
    return float(np.mean(np.einsum("ni,ij,nj->n", off, np.linalg.inv(C), off) <= _N_SIGMA**2))


def _figure(shown: dict[str, _Walk]) -> Any:
    heights = [max(0.4, _height(walk)) for walk in shown.values()]
    figure = drawing.figure(12.5, 1.2 + sum(1.2 + 3.6 * height for height in heights))
    grid = figure.add_gridspec(len(shown), len(_MODELS), height_ratios=heights)
    for row, (key, walk) in enumerate(shown.items()):
        factor = _factor(walk)
        first = None
        for column, (name, path) in enumerate(walk.paths.items()):
            axes = figure.add_subplot(grid[row, column], sharex=first, sharey=first)
            first = first or axes
            _draw(axes, walk, path, factor)
            axes.set_title(f"{SEQUENCES[key].title}: {_MODELS[name]}")
            axes.set_xlabel("x in m")
            if column == 0:
                axes.set_ylabel(f"y in m (errors × {factor:g})")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure


def _height(walk: _Walk) -> float:
    """Return how high a path is that is one wide."""
    width, height = np.ptp(walk.truth[:, :2, 3], axis=0)
    return float(height / width)


def _draw(axes: Any, walk: _Walk, path: list[GaussianPose], factor: float) -> None:
    truth = walk.truth[:, :2, 3]
    for n, run in enumerate(walk.runs):
        xy = np.array([truth[0], *(pose.T[:2, 3] for pose in run)])
        xy = truth + factor * (xy - truth)
        label = "odometry" if n == 0 else None
        axes.plot(*xy.T, color=drawing.BLUE, linewidth=0.6, alpha=0.6, label=label)
        end = "its end" if n == 0 else None
        axes.plot(*xy[-1], "o", color=drawing.GREEN, markersize=4, zorder=4, label=end)
    for k, pose in enumerate(path):
        last = k == len(path) - 1
        drawing.ellipse(
            axes,
            truth[k + 1],
            factor**2 * _positions(pose)[:2, :2],
            _N_SIGMA,
            color=drawing.GREEN if last else "#999999",
            linewidth=2.0 if last else 0.8,
            zorder=3,
            label=f"{_N_SIGMA:g}σ" if last else None,
        )
    axes.plot(*truth.T, color="black", linewidth=3, zorder=2, label="truth")
    axes.set_aspect("equal")
    axes.grid(alpha=0.25)


def _factor(walk: _Walk) -> float:
    """Return 1, 2, 5, 10, ...: how much larger errors must be drawn to be seen."""
    extent = np.ptp(walk.truth[:, :2, 3], axis=0).max()
    C = _positions(walk.paths["sampled"][-1])[:2, :2]
    wanted = 0.12 * extent / (_N_SIGMA * np.sqrt(np.linalg.eigvalsh(C)[-1]))
    steps = [10.0**e * m for e in range(5) for m in (1, 2, 5)]
    return max([1.0, *(step for step in steps if step <= wanted)])
