"""Table I: divergence of predicted from sampled covariances, beside the baseline and Censi."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.errors import DatasetError, RegistrationError
from cello3d_ros.evaluation.comparison import from_dataset
from cello3d_ros.evaluation.online import prepared
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.learning.examples import load_examples
from cello3d_ros.learning.measures import Figures, figures
from cello3d_ros.recordings import Recording
from cello3d_ros.registration.backends import register
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import Recordings, Workshop
from cello3d_ros.reproduction.models import (
    MODELS,
    datasets,
    names_of,
    testable,
    trained,
    trained_on,
)
from cello3d_ros.reproduction.result import Result, markdown_table
from cello3d_ros.reproduction.scenes import censi_of
from cello3d_ros.reproduction.sequences import SEQUENCES

Row = dict[str, Figures]  # by method

SIGMA_M = 0.01  # that Censi assumes
_METHODS = ("baseline", "letter", "paper", "relative", "censi")
_KEPT = ("n_pairs", "kl_mean", "kl_median", "kl_trimmed_mean", "dm2_over_6", "coverage_95")


def make(workshop: Workshop, recordings: Recordings, source: str) -> Result:
    """Train and test every sequence as the paper did.  Raises DatasetError without any."""
    keys = testable(recordings)
    if not keys:
        raise DatasetError(
            f"{source}: no sequence is there with what the paper trained it on: "
            f"found {', '.join(SEQUENCES[key].title for key in recordings)}"
        )
    needed = {k: recordings[k] for key in keys for k in (key, *SEQUENCES[key].trained_on)}
    found = datasets(workshop, needed)
    rows = {key: _row(workshop, found, recordings, key) for key in keys}
    data = {
        "source": source,
        "n_samples": workshop.n_samples,
        "sequences": {key: _data(key, row) for key, row in rows.items()},
    }
    text = (
        f"Mean KL divergence of the predicted from the sampled covariance, {source}, "
        f"{workshop.n_samples} registrations a pair, trained on what the paper trained on. "
        f"*Baseline*: the mean of the training covariances. *To the letter*: the paper's model "
        f"with the log-det loss, but for a Theta of low rank and a quasi-Newton search. "
        f"*Regularised*: the same with a diagonal Theta, lambda "
        f"{MODELS['paper'].regularization:g} and {MODELS['paper'].mean_weight:.0%} of the "
        f"training mean in each prediction, as docs/evaluation.md found best. *Relative*: "
        f"covariances are averaged relative to each pair's sandwich. Censi assumes "
        f"{100 * SIGMA_M:g} cm of noise.\n\n{markdown_table(_table(rows))}\n\n"
        f"Ratios to the baseline's mean KL, those of medians in brackets. The paper's are on its "
        f"own data, which are not these.\n\n{markdown_table(_ratios(rows))}"
    )
    return Result(
        "table1",
        "Table I: single-pair covariance prediction",
        text,
        data,
        _csv(rows),
        _figure(rows),
    )


def _data(key: str, row: Row) -> dict[str, Any]:
    return {
        "trained_on": list(SEQUENCES[key].trained_on),
        "methods": {name: dataclasses.asdict(found) for name, found in row.items()},
    }


def _csv(rows: dict[str, Row]) -> list[list[Any]]:
    head: list[Any] = ["sequence", "trained_on", "method", *_KEPT]
    return [head] + [
        [SEQUENCES[key].title, trained_on(key), name, *(getattr(row[name], k) for k in _KEPT)]
        for key, row in rows.items()
        for name in _METHODS
    ]


def _row(workshop: Workshop, found: dict[str, Dataset], recordings: Recordings, key: str) -> Row:
    """Return the figures of every method on one sequence."""
    models, training = trained(workshop, found, key)
    examples = load_examples([found[key]], names_of(found[key]))
    mean = training.covariances.mean(axis=0)
    F = {
        name: from_dataset(model, examples, mean, MethodSettings()).covariances["cello3d"]
        for name, model in models.items()
    }
    F["baseline"] = np.tile(mean, (len(examples.covariances), 1, 1))
    F["censi"] = _censi(found[key], recordings[key])
    return {name: figures(F[name], examples, F["baseline"]) for name in _METHODS}


def _censi(dataset: Dataset, recordings: Sequence[Recording]) -> Array:
    """Return Censi's covariance of every accepted pair, in the order of the examples; or NaN."""
    covariances = []
    by_name: dict[str, Recording] = {recording.name: recording for recording in recordings}
    accepted = [key for key in dataset.pair_keys() if dataset.read(*key).accepted]
    for name in sorted(by_name):
        pairs = [(i, j) for recording, i, j in accepted if recording == name]
        scans = sorted({k for pair in pairs for k in pair})
        clouds, poses = prepared(by_name[name], dataset.pipeline, scans)
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


def _table(rows: dict[str, Row]) -> list[list[str]]:
    """Return the mean divergences."""
    heads = ("baseline", "to the letter", "regularised", "relative", "Censi")
    table = [["sequence", "trained on", "pairs", *heads]]
    for key, row in rows.items():
        n_pairs = str(row["baseline"].n_pairs)
        cells = [f"{row[name].kl_mean:.3g}" for name in _METHODS]
        table.append([SEQUENCES[key].title, trained_on(key), n_pairs, *cells])
    return table


def _ratios(rows: dict[str, Row]) -> list[list[str]]:
    """Return the ratios to the baseline, beside the paper's."""
    table = [["sequence", "to the letter", "regularised", "in the paper", "relative"]]
    names = ("letter", "paper", "relative")
    for key, row in rows.items():
        ours = [f"{row[n].kl_ratio:.2f} ({row[n].kl_median_ratio:.2f})" for n in names]
        theirs = f"{_paper_ratio(key):.2f}"
        table.append([SEQUENCES[key].title, ours[0], ours[1], theirs, f"**{ours[2]}**"])
    means = [
        f"{np.mean([r[n].kl_ratio for r in rows.values()]):.2f} "
        f"({np.mean([r[n].kl_median_ratio for r in rows.values()]):.2f})"
        for n in names
    ]
    theirs = f"{np.mean([_paper_ratio(key) for key in rows]):.2f}"
    return [*table, ["mean", means[0], means[1], theirs, f"**{means[2]}**"]]


def _paper_ratio(key: str) -> float:
    return SEQUENCES[key].kl_ours / SEQUENCES[key].kl_baseline


def _figure(rows: dict[str, Row]) -> Any:
    figure = drawing.figure(9.0, 4.5)
    axes = figure.add_subplot()
    x = np.arange(len(rows))
    axes.axhline(1.0, color="black", linewidth=1, linestyle="--", label="mean baseline")
    ratios = {n: [row[n].kl_ratio for row in rows.values()] for n in _METHODS}
    marks: tuple[tuple[list[Any], dict[str, str]], ...] = (
        (ratios["letter"], {"label": "to the letter", "marker": "v", "color": "ORANGE"}),
        (ratios["paper"], {"label": "regularised", "marker": "o", "color": "BLUE"}),
        (
            [_paper_ratio(key) for key in rows],
            {"label": "the paper, its data", "marker": "s", "color": "GREY"},
        ),
        (ratios["relative"], {"label": "relative", "marker": "D", "color": "GREEN"}),
    )
    for k, (values, style) in enumerate(marks):
        at = x + 0.17 * (k - 1.5)
        style["color"] = getattr(drawing, style["color"])
        axes.plot(at, values, linestyle="none", markersize=7, **style)
        over = {"textcoords": "offset points", "xytext": (0, 6), "ha": "center", "fontsize": 7}
        for place, ratio in zip(at, values, strict=True):
            axes.annotate(f"{ratio:.2f}", (place, ratio), **over)
    axes.set_yscale("log")
    ticks = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="y", alpha=0.3)
    axes.set_xticks(x, [SEQUENCES[key].title.replace(" ", "\n") for key in rows])
    axes.set_ylabel("mean KL divergence, ratio to the baseline")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=5)
    return figure
