"""What different readings of the paper's training make of its model, on the pairs of Table I."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cello3d_ros.config import TrainingConfig
from cello3d_ros.errors import DatasetError
from cello3d_ros.geometry.gaussian import kl
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.learning.examples import Examples, answers
from cello3d_ros.learning.measures import Figures, figures
from cello3d_ros.learning.training import fit
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.models import (
    MEANT,
    PRINTED,
    Place,
    all_of,
    baseline,
    datasets,
    in_groups,
    testable,
)
from cello3d_ros.reproduction.result import Result, markdown_table
from cello3d_ros.reproduction.sequences import SEQUENCES


class Reading(NamedTuple):
    """One way to train.  by_pair: whether each pair is predicted from all others, not only from
    other recordings or the other half of its own.
    """

    title: str
    config: TrainingConfig
    by_pair: bool = False


class Found(NamedTuple):
    """figures: over the pairs of a sequence; n_neighbors: the median over them of 1 / sum w^2;
    worst: the share of the sum of all divergences that the worst 5 % of the pairs have.
    """

    figures: Figures
    n_neighbors: float
    worst: float


_DIAGONAL = dataclasses.replace(PRINTED, theta="diagonal", loss="log_det")
_MINIMISED = replace(MEANT, mean_weight=0.0)
READINGS = (
    Reading("printed: det F, 100 passes at 1e-5 from near 0", PRINTED),
    Reading("log det F, diagonal", _DIAGONAL),
    Reading("log det F, diagonal, from a median rho of 1", replace(_DIAGONAL, start_rho=1.0)),
    Reading("log det F, minimised, predicted from another recording", _MINIMISED),
    Reading("the same, predicted from any other pair", _MINIMISED, by_pair=True),
    Reading("the same, standardised descriptors", replace(_MINIMISED, standardize=True)),
    Reading("as meant: minimised, a tenth of the mean in each", MEANT),
)


def make(place: Place, source: str) -> Result:
    """Train by each reading for each sequence.  Raises DatasetError where none can be tested."""
    keys = testable(place.recordings)
    if not keys:
        raise DatasetError(f"{source}: no sequence is there with what the paper trained it on")
    found = datasets(place, {k for key in keys for k in (key, *SEQUENCES[key].trained_on)})
    rows = {
        key: {reading.title: _found(place, found, key, reading) for reading in READINGS}
        for key in keys
    }
    data = {
        "source": source,
        "n_samples": place.workshop.n_samples,
        "sequences": {key: {t: _data(f) for t, f in row.items()} for key, row in rows.items()},
    }
    text = (
        f"Ratio of the mean KL divergence to the baseline's, that of medians in brackets; D2/6, "
        f"the mean of tr(F^-1 Y) / 6, above 1 where predictions are too small; and how many "
        f"examples make a prediction, 1 / sum w^2, the median over pairs, each averaged over the "
        f"sequences, {source}. Theta has 16 rows where nothing else is said, descriptors are as "
        f"they are.\n\n"
        f"{markdown_table(_table(rows))}"
    )
    title = "Readings of the paper's training"
    return Result("readings", title, text, data, _csv(rows), _figure(rows))


def _found(place: Place, found: dict[str, Dataset], key: str, reading: Reading) -> Found:
    training = all_of([found[other] for other in SEQUENCES[key].trained_on])
    grouped = _apart(training) if reading.by_pair else in_groups(training)
    with place.workshop.costs.of(f"reading {reading.title} {key}-{place.workshop.seed}"):
        model = fit(grouped, reading.config).model
    examples = all_of([found[key]])
    said = answers(model, examples)
    F = np.array([answer.covariance for answer in said])
    base = np.tile(baseline(training), (len(F), 1, 1))
    each = np.sort(kl(examples.covariances, F))
    return Found(
        figures(F, examples, base),
        float(np.median([answer.effective_neighbors for answer in said])),
        float(each[int(0.95 * len(each)) :].sum() / each.sum()),
    )


def _apart(examples: Examples) -> Examples:
    """Return the examples with each pair as a group of its own."""
    names = [f"{name} {k}" for k, name in enumerate(examples.groups)]
    return dataclasses.replace(examples, groups=np.array(names))


def _data(found: Found) -> dict[str, Any]:
    return {**found._asdict(), "figures": dataclasses.asdict(found.figures)}


def _csv(rows: dict[str, dict[str, Found]]) -> list[list[Any]]:
    head: list[Any] = ["sequence", "reading", "kl_ratio", "kl_median_ratio", "dm2_over_6"]
    return [[*head, "n_neighbors", "worst"]] + [
        [SEQUENCES[key].title, title, f.figures.kl_ratio, f.figures.kl_median_ratio]
        + [f.figures.dm2_over_6, f.n_neighbors, f.worst]
        for key, row in rows.items()
        for title, f in row.items()
    ]


def _table(rows: dict[str, dict[str, Found]]) -> list[list[str]]:
    titles = [SEQUENCES[key].title for key in rows]
    table = [["reading", *titles, "mean", "D2/6", "examples"]]
    for reading in READINGS:
        some = [row[reading.title] for row in rows.values()]
        ratios = np.array([(f.figures.kl_ratio, f.figures.kl_median_ratio) for f in some])
        cells = [f"{mean:.2f} ({median:.2f})" for mean, median in (*ratios, ratios.mean(axis=0))]
        size = f"{np.mean([f.figures.dm2_over_6 for f in some if f.figures.dm2_over_6]):.3g}"
        n = f"{np.mean([f.n_neighbors for f in some]):.0f}"
        table.append([reading.title, *cells, size, n])
    theirs = [SEQUENCES[key].kl_ours / SEQUENCES[key].kl_baseline for key in rows]
    return [*table, ["the paper", *(f"{r:.2f}" for r in (*theirs, np.mean(theirs))), "", ""]]


def _figure(rows: dict[str, dict[str, Found]]) -> Any:
    """Draw the ratio of the means over how many examples make a prediction."""
    figure = drawing.figure(7.5, 4.5)
    axes = figure.add_subplot()
    axes.axhline(1.0, color="black", linewidth=1, linestyle="--")
    for reading in READINGS:
        some = [row[reading.title] for row in rows.values()]
        axes.plot(
            [f.n_neighbors for f in some],
            [f.figures.kl_ratio for f in some],
            "o",
            markersize=6,
            alpha=0.8,
            label=reading.title,
        )
    axes.set(xscale="log", yscale="log", xlabel="examples that make a prediction")
    axes.set_ylabel("mean KL divergence, ratio to the baseline")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return figure
