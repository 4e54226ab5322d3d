"""Table I: divergence of predicted from sampled covariances, beside the baseline and Censi."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.errors import DatasetError, RegistrationError
from cello3d_ros.evaluation.comparison import from_dataset
from cello3d_ros.evaluation.online import prepared
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.learning.measures import Figures, figures
from cello3d_ros.recordings import Recording
from cello3d_ros.registration.backends import register
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.models import (
    MODELS,
    Place,
    all_of,
    baseline,
    datasets,
    general,
    testable,
    trained,
    trained_on,
)
from cello3d_ros.reproduction.result import Result, markdown_table
from cello3d_ros.reproduction.scenes import censi_of
from cello3d_ros.reproduction.sequences import SEQUENCES

Row = dict[str, Figures]  # by method

SIGMA_M = 0.01  # that Censi assumes
_HEADS = {
    "printed": "as printed",
    "paper": "as meant",
    "relative": "relative",
    "general": "general",
}
_METHODS = ("baseline", *_HEADS, "censi")
_RATIOS = ("kl_ratio", "kl_median_ratio")
_KEPT = ("n_pairs", "kl_mean", "kl_median", "kl_trimmed_mean", "dm2_over_6", "coverage_95")


def make(places: Sequence[Place], source: str) -> Result:
    """Train and test every sequence of every place as the paper did.

    Raises DatasetError where none can be tested.
    """
    keys = testable(places[0].recordings)
    if not keys:
        raise DatasetError(
            f"{source}: no sequence is there with what the paper trained it on: "
            f"found {', '.join(SEQUENCES[key].title for key in places[0].recordings)}"
        )
    rows = [_rows(place, keys) for place in places]
    data = {
        "source": source,
        "n_samples": places[0].workshop.n_samples,
        "places": [
            {
                "seed": place.workshop.seed,
                "sequences": {key: _data(key, row) for key, row in found.items()},
            }
            for place, found in zip(places, rows, strict=True)
        ],
    }
    text = (
        f"Mean KL divergence of the predicted from the sampled covariance, {source}, "
        f"{places[0].workshop.n_samples} registrations a pair, trained on what the paper trained "
        f"on. *Baseline*: the mean of the training covariances and their turned copies. *As "
        f"printed* and *as meant*: the paper's model, see the readings. *Relative*: covariances "
        f"are averaged relative to each pair's sandwich. *General*: the shipped model, trained "
        f"elsewhere. Censi assumes {100 * SIGMA_M:g} cm of noise.\n\n"
        f"{markdown_table(_table(rows))}\n\n"
        f"Ratios to the baseline's mean KL, those of medians in brackets. The paper's are on its "
        f"own data, which are not these.{_said_of(places)}\n\n"
        f"{markdown_table(_ratios(places, rows))}"
    )
    title = "Table I: single-pair covariance prediction"
    return Result("table1", title, text, data, _csv(places, rows), _figure(rows))


def _said_of(places: Sequence[Place]) -> str:
    if len(places) == 1:
        return ""
    return (
        f" Rows are means over {len(places)} places of each kind; ± is the 95 % interval of the "
        f"mean over places."
    )


def _data(key: str, row: Row) -> dict[str, Any]:
    return {
        "trained_on": list(SEQUENCES[key].trained_on),
        "methods": {name: dataclasses.asdict(found) for name, found in row.items()},
    }


def _csv(places: Sequence[Place], rows: Sequence[dict[str, Row]]) -> list[list[Any]]:
    head: list[Any] = ["seed", "sequence", "trained_on", "method", *_KEPT]
    return [head] + [
        [place.workshop.seed, SEQUENCES[key].title, trained_on(key), name]
        + [getattr(row[name], k) for k in _KEPT]
        for place, found in zip(places, rows, strict=True)
        for key, row in found.items()
        for name in _METHODS
    ]


def _rows(place: Place, keys: Sequence[str]) -> dict[str, Row]:
    """Return the figures of every method on the sequences of one place."""
    found = datasets(place, {k for key in keys for k in (key, *SEQUENCES[key].trained_on)})
    return {key: _row(place, found, key) for key in keys}


def _row(place: Place, found: dict[str, Dataset], key: str) -> Row:
    """Return the figures of every method on one sequence."""
    models, training = trained(place, found, key, MODELS)
    models["general"] = general()
    examples = all_of([found[key]])
    mean = baseline(training)
    F = {
        name: from_dataset(model, examples, mean, MethodSettings()).covariances["cello3d"]
        for name, model in models.items()
    }
    F["baseline"] = np.tile(mean, (len(examples.covariances), 1, 1))
    F["censi"] = _censi(found[key], place.recordings[key])
    return {name: figures(F[name], examples, F["baseline"]) for name in _METHODS}


def _censi(dataset: Dataset, recording: Recording) -> Array:
    """Return Censi's covariance of every accepted pair, in the order of the examples; or NaN."""
    pairs = [key[1:] for key in dataset.pair_keys() if dataset.read(*key).accepted]
    clouds, poses = prepared(recording, dataset.pipeline, sorted({k for ij in pairs for k in ij}))
    covariances = []
    for i, j in pairs:
        rng = np.random.default_rng([i, j])
        T_mean = inverse(poses[i]) @ poses[j]
        T = register(clouds[j], clouds[i], T_mean, dataset.pipeline.icp, rng).T_ref_read
        try:
            C = censi_of(clouds[j], clouds[i], T, dataset.pipeline, SIGMA_M)
        except RegistrationError:
            C = np.full((6, 6), np.nan)
        covariances.append(C)
    return np.array(covariances)


def _table(rows: Sequence[dict[str, Row]]) -> list[list[str]]:
    """Return the mean divergences, and the paper's baseline and model."""
    head = ["sequence", "trained on", "pairs", "baseline", *_HEADS.values(), "Censi"]
    table = [[*head, "paper: baseline", "its model"]]
    for key in rows[0]:
        n_pairs = str(sum(row[key]["baseline"].n_pairs for row in rows))
        cells = [f"{np.mean([_of(row[key][name]) for row in rows]):.3g}" for name in _METHODS]
        theirs = [f"{SEQUENCES[key].kl_baseline:g}", f"{SEQUENCES[key].kl_ours:g}"]
        table.append([SEQUENCES[key].title, trained_on(key), n_pairs, *cells, *theirs])
    return table


def _of(found: Figures, name: str = "kl_mean") -> float:
    """Return a figure, NaN where the method has no answer."""
    value = getattr(found, name)
    return np.nan if value is None else float(value)


def _ratios(places: Sequence[Place], rows: Sequence[dict[str, Row]]) -> list[list[str]]:
    """Return the ratios to the baseline, beside the paper's; their means of each place and all."""
    table = [["sequence", "in the paper", *_HEADS.values()]]
    ratios = {
        name: np.array(
            [[[_of(row[name], k) for k in _RATIOS] for row in place.values()] for place in rows]
        )
        for name in _HEADS
    }  # (places, sequences, 2)
    for k, key in enumerate(rows[0]):
        cells = [_interval(r[:, k].mean(axis=0, keepdims=True)) for r in ratios.values()]
        table.append([SEQUENCES[key].title, f"{_paper_ratio(key):.2f}", *cells])
    means = {name: r.mean(axis=1) for name, r in ratios.items()}  # (places, 2)
    if len(places) > 1:
        table += [
            [
                f"mean, seed {place.workshop.seed}",
                "",
                *(_interval(m[k : k + 1]) for m in means.values()),
            ]
            for k, place in enumerate(places)
        ]
    theirs = f"{np.mean([_paper_ratio(key) for key in rows[0]]):.2f}"
    return [*table, ["mean", theirs, *(_interval(m) for m in means.values())]]


def _interval(means: Array) -> str:
    """Return the mean over places and its 95 % interval, of means and medians.  (places, 2)."""
    n = len(means)
    mean, median = means.mean(axis=0)
    if n == 1:
        return f"{mean:.2f} ({median:.2f})"
    off = stdtrit(n - 1, 0.975) * means.std(axis=0, ddof=1) / np.sqrt(n)
    return f"{mean:.2f} ± {off[0]:.2f} ({median:.2f} ± {off[1]:.2f})"


def _paper_ratio(key: str) -> float:
    return SEQUENCES[key].kl_ours / SEQUENCES[key].kl_baseline


def _figure(rows: Sequence[dict[str, Row]]) -> Any:
    figure = drawing.figure(9.0, 4.5)
    axes = figure.add_subplot()
    x = np.arange(len(rows[0]))
    axes.axhline(1.0, color="black", linewidth=1, linestyle="--", label="mean baseline")
    ratios = {
        name: [np.mean([_of(row[key][name], "kl_ratio") for row in rows]) for key in rows[0]]
        for name in _HEADS
    }
    marks: tuple[tuple[list[Any], dict[str, str]], ...] = (
        (ratios["printed"], {"label": "as printed", "marker": "v", "color": "ORANGE"}),
        (ratios["paper"], {"label": "as meant", "marker": "o", "color": "BLUE"}),
        (
            [_paper_ratio(key) for key in rows[0]],
            {"label": "the paper, its data", "marker": "s", "color": "GREY"},
        ),
        (ratios["relative"], {"label": "relative", "marker": "D", "color": "GREEN"}),
        (ratios["general"], {"label": "general", "marker": "P", "color": "RED"}),
    )
    for k, (values, style) in enumerate(marks):
        at = x + 0.17 * (k - 2)
        style["color"] = getattr(drawing, style["color"])
        axes.plot(at, values, linestyle="none", markersize=7, **style)
        over = {"textcoords": "offset points", "xytext": (0, 6), "ha": "center", "fontsize": 7}
        for place, ratio in zip(at, values, strict=True):
            axes.annotate(f"{ratio:.2f}", (place, ratio), **over)
    axes.set_yscale("log")
    ticks = [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="y", alpha=0.3)
    axes.set_xticks(x, [SEQUENCES[key].title.replace(" ", "\n") for key in rows[0]])
    axes.set_ylabel("mean KL divergence, ratio to the baseline")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=6)
    return figure
