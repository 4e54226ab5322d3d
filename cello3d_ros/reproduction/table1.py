"""Table I: divergence of predicted from sampled covariances, beside the baseline and Censi."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cello3d_ros.covariance.methods import MethodSettings
from cello3d_ros.errors import DatasetError, RegistrationError
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.learning.comparison import from_dataset
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.learning.evaluation import figures
from cello3d_ros.learning.examples import load_examples
from cello3d_ros.learning.online import prepared
from cello3d_ros.recordings import Recording
from cello3d_ros.registration.backends import register
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import Recordings, Workshop
from cello3d_ros.reproduction.models import datasets, names_of, testable, trained, trained_on
from cello3d_ros.reproduction.result import Result, markdown_table
from cello3d_ros.reproduction.scenes import censi_of
from cello3d_ros.reproduction.sequences import SEQUENCES

SIGMA_M = 0.01  # that Censi assumes
_METHODS = ("baseline", "paper", "relative", "censi")
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
        "sequences": {
            key: {"trained_on": list(SEQUENCES[key].trained_on), "methods": row}
            for key, row in rows.items()
        },
    }
    text = (
        f"Mean KL divergence of the predicted from the sampled covariance, {source}, "
        f"{workshop.n_samples} registrations a pair, trained on what the paper trained on. "
        f"*Baseline* is the mean of the training covariances, *paper's model* has the log-det "
        f"loss and nothing relative, *relative* averages covariances relative to each pair's "
        f"sandwich. Censi assumes {100 * SIGMA_M:g} cm of noise. The paper's ratios are "
        f"on its own data, which are not these.\n\n" + markdown_table(_table(rows))
    )
    csv: list[list[Any]] = [["sequence", "trained_on", "method", *_KEPT]]
    csv += [
        [SEQUENCES[key].title, trained_on(key), name, *(row[name].get(k) for k in _KEPT)]
        for key, row in rows.items()
        for name in _METHODS
    ]
    return Result(
        "table1", "Table I: single-pair covariance prediction", text, data, csv, _figure(rows)
    )


def _row(
    workshop: Workshop, found: dict[str, Dataset], recordings: Recordings, key: str
) -> dict[str, dict[str, Any]]:
    """Return the figures of every method on one sequence."""
    models, training = trained(workshop, found, key)
    examples = load_examples([found[key]], names_of(found[key]))
    mean = training.covariances.mean(axis=0)
    F = {
        name: from_dataset(model, examples, mean, MethodSettings()).covariances["model"]
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


def _table(rows: dict[str, dict[str, Any]]) -> list[list[str]]:
    table = [
        [
            *("sequence", "trained on", "pairs", "baseline", "paper's model", "relative"),
            *("Censi", "paper's model / baseline", "in the paper", "relative / baseline"),
        ]
    ]
    for key, row in rows.items():
        s, kl = SEQUENCES[key], {name: row[name]["kl_mean"] for name in _METHODS}
        table.append(
            [
                *(s.title, trained_on(key), str(row["baseline"]["n_pairs"])),
                *(f"{kl[name]:.1f}" for name in ("baseline", "paper", "relative")),
                f"{kl['censi']:.3g}",
                f"{kl['paper'] / kl['baseline']:.2f}",
                f"{s.kl_ours / s.kl_baseline:.2f}",
                f"**{kl['relative'] / kl['baseline']:.2f}**",
            ]
        )
    ratios = [[row[n]["kl_ratio"] for row in rows.values()] for n in ("paper", "relative")]
    theirs = [SEQUENCES[key].kl_ours / SEQUENCES[key].kl_baseline for key in rows]
    means = [f"{np.mean(r):.2f}" for r in (ratios[0], theirs, ratios[1])]
    table.append(["mean of the ratios", "", "", "", "", "", "", *means])
    return table


def _figure(rows: dict[str, dict[str, Any]]) -> Any:
    figure = drawing.figure(9.0, 4.5)
    axes = figure.add_subplot()
    x = np.arange(len(rows))
    series = (
        ("paper's model here", [r["paper"]["kl_ratio"] for r in rows.values()], drawing.BLUE),
        (
            "paper, its own data",
            [SEQUENCES[key].kl_ours / SEQUENCES[key].kl_baseline for key in rows],
            drawing.GREY,
        ),
        ("relative (sandwich)", [r["relative"]["kl_ratio"] for r in rows.values()], drawing.GREEN),
    )
    for k, (label, ratios, color) in enumerate(series):
        bars = axes.bar(x + 0.27 * (k - 1), ratios, 0.25, color=color, label=label)
        axes.bar_label(bars, fmt="%.2f", fontsize=7)
    axes.axhline(1.0, color="black", linewidth=1, linestyle="--", label="mean baseline")
    axes.set_xticks(x, [SEQUENCES[key].title.replace(" ", "\n") for key in rows])
    axes.set_ylabel("mean KL divergence, ratio to the baseline")
    axes.set_ylim(0, 1.25 * max(1.0, *(max(ratios) for _, ratios, _ in series)))
    axes.legend(ncols=4, loc="upper center", fontsize=8)
    return figure
