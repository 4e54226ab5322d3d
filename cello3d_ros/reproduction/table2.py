"""Table II: is the compounded covariance of ICP odometry consistent with where it ends?"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from cello3d_ros.errors import DatasetError
from cello3d_ros.evaluation.online import prepared
from cello3d_ros.evaluation.result import Trajectory
from cello3d_ros.evaluation.trajectories import Runs, consistency, length_m, runs_of_models
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import PAPER
from cello3d_ros.reproduction.models import (
    MODELS,
    TRAINED,
    Place,
    datasets,
    general,
    testable,
    trained,
)
from cello3d_ros.reproduction.result import Result, markdown_table
from cello3d_ros.reproduction.sequences import SEQUENCES

Row = dict[str, Trajectory]  # by model

_TITLES = {"relative": "Relative", "general": "General", "paper": "Paper's"}
_MEASURES = (
    *("length_m", "n_runs", "n_failed", "n_lost", "n_told", "error_m", "dm_translation"),
    *("error_rad", "dm_rotation", "dm_6dof", "dm_6dof_median", "coverage_95"),
)
IDEAL_6DOF, IDEAL_3DOF = 2.35, 1.60  # means of chi with 6 and 3 degrees of freedom


def make(places: Sequence[Place], n_runs: int, source: str) -> Result:
    """Run odometry ``n_runs`` times over each sequence of each place.

    Models saw what the paper trained on.  Raises DatasetError where no sequence has that.
    """
    keys = testable(places[0].recordings)
    if not keys:
        raise DatasetError(f"{source}: no sequence is there with what the paper trained it on")
    by_place = [_rows(place, keys, n_runs) for place in places]
    rows = {key: _pooled([found[key] for found in by_place]) for key in keys}
    alone = [{key: _pooled([found[key]]) for key in keys} for found in by_place]
    data = {
        "source": source,
        "n_samples": places[0].workshop.n_samples,
        "ideal": {"dm_6dof": IDEAL_6DOF, "dm_3dof": IDEAL_3DOF},
        "sequences": {key: _data(row) for key, row in rows.items()},
        "places": [
            {
                "seed": place.workshop.seed,
                "sequences": {key: _data(row) for key, row in found.items()},
            }
            for place, found in zip(places, alone, strict=True)
        ],
    }
    tables = [
        f"{title} model:\n\n{markdown_table(_table(rows, n))}" for n, title in _TITLES.items()
    ]
    if len(places) > 1:
        tables.append(f"D_M by recording:\n\n{markdown_table(_by_recording(places, alone))}")
    text = "\n\n".join([_text(n_runs, source, len(places)), *tables])
    title = "Table II: consistency over trajectories"
    return Result("table2", title, text, data, _csv(rows), _figure(rows))


def _text(n_runs: int, source: str, n_places: int) -> str:
    """Return what the tables mean."""
    return (
        f"Mean Mahalanobis distance D_M of the final pose of {n_runs} runs of ICP odometry over "
        f"each recording (starts of variance 0.05, covariances compounded to 4th order), "
        f"{source}. A consistent covariance has D_M of {IDEAL_6DOF} in 6 degrees of freedom and "
        f"{IDEAL_3DOF:.2f} in 3; more is optimistic, less is pessimistic. Runs of one recording "
        f"share the offsets of its registrations from the truth: {n_places} "
        f"{'recording is' if n_places == 1 else 'recordings are'} that many independent "
        f"samples of a sequence, not {n_runs * n_places}. *Runs*: those with an answer for "
        f"every registration, of all. *Lost* ones had a registration end in another minimum; they "
        f"are in all figures, as in the paper. The relative and the "
        f"general model tell lost registrations and cover them (`docs/decisions/0011`); the "
        f"paper's does not."
    )


def _data(row: Row) -> dict[str, Any]:
    return {name: dataclasses.asdict(found) for name, found in row.items()}


def _csv(rows: dict[str, Row]) -> list[list[Any]]:
    head: list[Any] = ["sequence", "model", *_MEASURES]
    return [head] + [
        [SEQUENCES[key].title, name, *(getattr(report, measure) for measure in _MEASURES)]
        for key, row in rows.items()
        for name, report in row.items()
    ]


def _rows(
    place: Place, keys: Sequence[str], n_runs: int
) -> dict[str, tuple[float, dict[str, Runs]]]:
    """Return length and runs by model of each sequence."""
    found = datasets(place, {k for key in keys for k in SEQUENCES[key].trained_on})
    rows = {}
    for key in keys:
        configs = {name: MODELS[name] for name in TRAINED}
        models, _ = trained(place, found, key, configs)
        models["general"] = general()
        recording, workshop = place.recordings[key], place.workshop
        scans = range(len(recording))
        clouds, poses = prepared(recording, PAPER, scans, workshop.seed)
        T = np.array([poses[k] for k in scans])
        with workshop.costs.of(f"odometry {key}-{workshop.seed}"):
            runs = runs_of_models(
                *([clouds[k] for k in scans], T, list(models.values()), n_runs),
                *(workshop.seed, workshop.n_threads),
            )
        rows[key] = length_m(T), dict(zip(models, runs, strict=True))
    return rows


def _pooled(found: Sequence[tuple[float, dict[str, Runs]]]) -> Row:
    """Return the consistency over the recordings of one sequence."""
    length = float(np.mean([length for length, _ in found]))
    row = {}
    for name in found[0][1]:
        some = [runs[name] for _, runs in found]
        together = Runs(
            np.concatenate([r.xi for r in some]),
            np.concatenate([r.Y for r in some]),
            np.concatenate([r.lost for r in some]),
            np.concatenate([r.told for r in some]),
            sum(r.n_failed for r in some),
        )
        row[name] = Trajectory(length_m=length, **vars(consistency(together)))
    return row


def _by_recording(places: Sequence[Place], alone: Sequence[dict[str, Row]]) -> list[list[str]]:
    """Return D_M and coverage of each recording by each model."""
    seeds = [f"seed {place.workshop.seed}" for place in places]
    table = [["sequence", *(f"{title}, {seed}" for title in _TITLES.values() for seed in seeds)]]
    for key in alone[0]:
        cells = [_dm(found[key][name]) for name in _TITLES for found in alone]
        table.append([SEQUENCES[key].title, *cells])
    return table


def _dm(found: Trajectory) -> str:
    return f"{found.dm_6dof:.2f} ({found.coverage_95:.2f})" if found.n_runs else ""


def _table(rows: dict[str, Row], name: str) -> list[list[str]]:
    """Return our row of each sequence and the paper's after it."""
    table = [
        [
            *(
                "sequence",
                "length (m)",
                "runs",
                "lost",
                "‖u‖ (m)",
                "D_M of u",
                "‖ω‖ (rad)",
                "D_M of ω",
            ),
            *("D_M", "in 95 %", "D_M, not the lost"),
        ]
    ]
    for key, row in rows.items():
        r, theirs = row[name], SEQUENCES[key].trajectory
        cells = [f"{r.length_m:.1f}", f"{r.n_runs} of {r.n_runs + r.n_failed}", f"{r.n_lost}"]
        if r.n_runs:
            cells += [
                *(f"{r.error_m:.3g}", f"{r.dm_translation:.2f}", f"{r.error_rad:.2g}"),
                *(f"{r.dm_rotation:.2f}", f"**{r.dm_6dof:.2f}**"),
                f"{r.coverage_95:.2f}",
                f"{r.without_lost.dm_6dof:.2f}" if r.n_lost < r.n_runs else "",
            ]
        table.append([SEQUENCES[key].title, *cells, *[""] * (10 - len(cells))])
        table.append(
            [
                "— in the paper",
                *(f"{theirs.length_m:g}", "100", "", f"{theirs.error_m:g}"),
                *(f"{theirs.dm_translation:.2f}", f"{theirs.error_rad:g}"),
                *(f"{theirs.dm_rotation:.2f}", f"{theirs.dm_6dof:.2f}", "", ""),
            ]
        )
    ideal = [f"{IDEAL_3DOF:.2f}", "", f"{IDEAL_3DOF:.2f}", f"{IDEAL_6DOF:.2f}", "0.95", ""]
    return [*table, ["ideal", "", "", "", "", *ideal]]


def _figure(rows: dict[str, Row]) -> Any:
    figure = drawing.figure(9.0, 4.5)
    axes = figure.add_subplot()
    x = np.arange(len(rows))
    axes.axhspan(1.5, 3.0, color="#d9ead3", label="neither optimistic nor pessimistic (paper)")
    axes.axhline(IDEAL_6DOF, color="black", linestyle="--", linewidth=1, label="ideal, 2.35")
    theirs = [SEQUENCES[key].trajectory.dm_6dof for key in rows]
    by_name = {n: [row[n].dm_6dof for row in rows.values()] for n in _TITLES}
    for offset, values, style in (
        (-0.2, by_name["paper"], {"label": "paper's model here", "marker": "o", "color": "BLUE"}),
        (-0.07, theirs, {"label": "paper, its own data", "marker": "s", "color": "GREY"}),
        (0.07, by_name["relative"], {"label": "relative", "marker": "D", "color": "GREEN"}),
        (0.2, by_name["general"], {"label": "general", "marker": "P", "color": "RED"}),
    ):
        known = [(a, v) for a, v in zip(x + offset, values, strict=True) if v is not None]
        style["color"] = getattr(drawing, style["color"])
        axes.plot(*np.transpose(known), linestyle="none", markersize=7, **style)
    axes.set_xticks(x, [SEQUENCES[key].title.replace(" ", "\n") for key in rows])
    axes.set_ylabel("mean D_M of the final pose, 6 dof")
    axes.set_yscale("log")
    ticks = [0.3, 0.5, 1, 2, 3, 5, 10, 20, 50, 100, 200]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=6)
    return figure
