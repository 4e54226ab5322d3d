"""All methods side by side on the pairs of a dataset, with and without their clouds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.covariance.methods import METHODS, extra_runs, mean_example
from cello3d_ros.covariance.model import Model, placed
from cello3d_ros.errors import DatasetError
from cello3d_ros.evaluation.online import Answer
from cello3d_ros.evaluation.result import Calibration, Group
from cello3d_ros.geometry.gaussian import kl, larger, mahalanobis
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.learning.examples import (
    Examples,
    answers,
    check_settings,
    load_examples,
    places,
    select_inputs,
)
from cello3d_ros.learning.measures import best_scale, figures, select

BASELINE = "mean_covariance"
#: At which quantiles of D_M^2 the sampled errors are compared with chi-square.
PROBABILITIES = (0.01, *(round(0.05 * k, 2) for k in range(1, 20)), 0.975, 0.99, 0.995)
_SCALED = ("hessian", "sandwich", "censi", "sigma_points")


@dataclass
class Predictions:
    """What each method says of each of N pairs.

    covariances: name -> (N, 6, 6), NaN where there is no answer.  cpu_ms: name -> (N,), NaN where
    the method was not run on clouds.
    """

    covariances: dict[str, Array]
    cpu_ms: dict[str, Array]


def seen_recordings(model: Model, known: Mapping[str, set[str]]) -> dict[str, str]:
    """Return the recordings that the model was trained or validated on: name -> the model's name.

    known: name -> its prints (``prints_of``).  One that has the name of a recording of the model,
    or a print, is that recording or a part of it.
    """
    names: set[str] = set()
    for role in ("recordings", "validation_recordings"):
        names |= set(model.provenance.get(role, {}))
    prints = model.provenance.get("prints", {})
    twins = {found: name for name in sorted(prints) for found in prints[name]}
    seen = {
        name: [name] if name in names else sorted(twins[p] for p in found if p in twins)
        for name, found in known.items()
    }
    return {name: twin[0] for name, twin in seen.items() if twin}


def training_mean(model: Model) -> Array:
    """Return the mean of the covariances that the model was trained on, as it keeps it.  (6, 6).

    Raises DatasetError where it keeps none.
    """
    if model.shape == "none":
        return mean_example(model)
    if not len(model.training_mean):
        raise DatasetError(
            "the mean of the training covariances is the baseline, and the model does not keep "
            "it; name datasets whose mean to take by --baseline"
        )
    return model.training_mean


def mean_of(datasets: Sequence[Dataset]) -> Array:
    """Return the mean of the covariances of all accepted pairs.  (6, 6)."""
    names = {key[0] for dataset in datasets for key in dataset.pair_keys()}
    return np.asarray(load_examples(datasets, names).covariances.mean(axis=0))


def from_dataset(
    model: Model, examples: Examples, mean: Array, settings: MethodSettings
) -> Predictions:
    """Return what the methods that need no clouds say.

    mean: (6, 6), the baseline.  ``cello3d_widened`` is what the node makes of the model's answer
    by default: the larger of it and the mean of the examples beyond ``settings.unknown_quantile``.
    Raises DatasetError where the dataset's settings are not the model's: its descriptors would not
    be comparable.
    """
    check_settings(model, examples)
    if model.shape != "none" and model.shape not in examples.shapes:
        raise DatasetError(f"the dataset does not hold the {model.shape} of each pair")
    examples = select_inputs(examples, model.features)
    n = len(examples.covariances)
    found, mean_of_examples = answers(model, examples), mean_example(model)
    constant = np.array(
        [placed(model, mean_of_examples, *place) for place in places(model, examples)]
    )
    covariances = {
        BASELINE: np.tile(mean, (n, 1, 1)),
        "cello3d": np.array([answer.covariance for answer in found]),
        "cello3d_widened": np.array([answer.covariance for answer in found]),
        "constant": constant,
    }
    for k, answer in enumerate(found):
        if answer.novelty > settings.unknown_quantile:
            covariances["cello3d_widened"][k] = larger(constant[k], answer.covariance)
    if "hessian" in examples.shapes:
        covariances["hessian"] = settings.sigma_m**2 * examples.shapes["hessian"]
    if "sandwich" in examples.shapes:
        covariances["sandwich"] = examples.shapes["sandwich"]
    return Predictions(covariances, {})


def add_answers(
    predictions: Predictions, pairs: Sequence[int], answers: list[dict[str, Answer]]
) -> None:
    """Enter what methods said of some pairs, by number, from their clouds.

    Methods that ``from_dataset`` knows keep the covariance from there and get their cost.
    """
    n = len(predictions.covariances[BASELINE])
    for name in METHODS:
        if name not in predictions.covariances:
            predictions.covariances[name] = np.full((n, 6, 6), np.nan)
        predictions.cpu_ms.setdefault(name, np.full(n, np.nan))
    known = {name for name, F in predictions.covariances.items() if np.isfinite(F).all()}
    for pair, answer in zip(pairs, answers, strict=True):
        for name, (Y, cpu_ms) in answer.items():
            predictions.cpu_ms[name][pair] = cpu_ms
            if name not in known:
                predictions.covariances[name][pair] = Y


def compare(
    predictions: Predictions,
    examples: Examples,
    keep: NDArray[np.bool_],
    settings: MethodSettings,
) -> tuple[Group, dict[str, Group]]:
    """Return the figures of every method over the pairs to keep: overall and by recording.

    ``<name>_scaled`` is a baseline times the one number that suits all these pairs best: an upper
    bound of what it could do, since the number is fitted to the answers.
    """
    kept = select(examples, keep)
    F = {name: Y[keep] for name, Y in predictions.covariances.items()}
    scales = {name: best_scale(F[name], kept) for name in _SCALED if name in F}
    F |= {f"{name}_scaled": scale * F[name] for name, scale in scales.items()}
    ms = {name: values[keep] for name, values in predictions.cpu_ms.items()}

    def over(some: NDArray[np.bool_]) -> Group:
        part, methods = select(kept, some), {}
        for name, Y in F.items():
            plain = name.removesuffix("_scaled")
            times = ms.get(plain, np.full(len(kept.groups), np.nan))[some]
            ran = np.isfinite(times)
            methods[name] = replace(
                figures(Y[some], part, F[BASELINE][some]),
                n_failed=int((ran & ~np.isfinite(Y[some]).all(axis=(1, 2))).sum()),
                ms_per_pair=float(times[ran].mean()) if ran.any() else None,
                icp_runs=extra_runs(plain, settings),
                scale=scales[plain] if plain != name else None,
            )
        return Group(n_pairs=int(some.sum()), methods=methods)

    everywhere = over(np.ones(len(kept.groups), np.bool_))
    return everywhere, {str(name): over(kept.groups == name) for name in np.unique(kept.groups)}


def calibration(
    predictions: Predictions, examples: Examples, keep: NDArray[np.bool_]
) -> Calibration:
    """Return quantiles of D_M^2 of the sampled errors of all pairs to keep, by method."""
    methods = {}
    for name, F in predictions.covariances.items():
        answered = np.flatnonzero(keep & np.isfinite(F).all(axis=(1, 2)))
        if len(answered):
            dm2 = np.concatenate([mahalanobis(examples.xi[k], F[k]) ** 2 for k in answered])
            methods[name] = [float(q) for q in np.quantile(dm2, PROBABILITIES)]
    return Calibration(probabilities=list(PROBABILITIES), dm2=methods)


def divergences(predictions: Predictions, examples: Examples, pair: int) -> dict[str, float]:
    """Return the KL of one pair by every method that has an answer."""
    Y = examples.covariances[pair]
    return {name: float(kl(Y, F)) for name, F in _answers(predictions, pair)}


def fits(predictions: Predictions, examples: Examples, pair: int) -> dict[str, float]:
    """Return ``tr(F^-1 Y) / 6`` of one pair by every method that has an answer."""
    Y = examples.covariances[pair]
    return {
        name: float(np.trace(np.linalg.solve(F, Y)) / 6.0)
        for name, F in _answers(predictions, pair)
    }


def _answers(predictions: Predictions, pair: int) -> Iterator[tuple[str, Array]]:
    for name, F in predictions.covariances.items():
        if np.isfinite(F[pair]).all():
            yield name, F[pair]
