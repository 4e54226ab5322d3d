"""What one recording can teach a model: the size of its covariances, and pairs like its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.covariance.model import Model, project
from cello3d_ros.errors import DatasetError
from cello3d_ros.geometry.gaussian import kl
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.learning.examples import (
    Examples,
    answers,
    are_held,
    check_settings,
    examples_of,
    flat_features,
    load_examples,
    select_inputs,
)
from cello3d_ros.learning.measures import Figures, figures, pose_check, select

PairKey = tuple[str, int, int]

N_BLOCKS = 4  # of time, each held back once
SIZE, EXAMPLES = "size", "examples"
_FEWEST_PAIRS = 12
_FEWEST_FOR_EXAMPLES = 60
_GAIN = 0.95  # of the KL of the size alone, that examples must reach
_OUTLIER = 30.0  # times the median misfit: a pair that is not fitted to, but judged


@dataclass(frozen=True, kw_only=True, eq=False)
class Tuning:
    """A tuned model and how good it is on blocks of time that were held back.

    kind: SIZE, or EXAMPLES where the recording's own pairs joined those of the model as well.
    scale: factor on every covariance of the model.  before, after: figures of the model as it was
    and as tuned on the other blocks, over every pair that was held back but the flagged.
    rejected: pairs to which sampling gave no covariance, or with a free direction.
    flagged: pairs that were not used, whose registrations do not agree with their pose
    (``pose_check``).  outliers: pairs that were judged but not fitted to, 30 times as far from the
    model as the median pair.
    """

    model: Model
    kind: str
    scale: float
    before: Figures
    after: Figures
    rejected: tuple[PairKey, ...]
    flagged: tuple[PairKey, ...]
    outliers: tuple[PairKey, ...]


def tune(model: Model, dataset: Dataset) -> Tuning:
    """Fit a model to the pairs of one dataset, cross-validated by blocks of time.

    Raises DatasetError where the dataset's settings are not the model's, and for fewer than 12
    pairs that can be used.
    """
    found = dataset.pair_keys()
    rejected, keys = _split(found, np.array([not dataset.read(*key).accepted for key in found]))
    examples = select_inputs(load_examples([dataset], {key[0] for key in keys}), model.features)
    held = are_held(examples)
    free, keys = _split(keys, ~held)
    rejected, examples = rejected + free, select(examples, held)
    _check(model, examples, len(keys))
    agrees = np.array([not pose_check(xi).flagged for xi in examples.xi], np.bool_)
    flagged, keys = _split(keys, ~agrees)
    examples = select(examples, agrees)
    _check(model, examples, len(keys))
    F = predictions(model, examples)
    scaled, extended_F = _cross_validated(model, examples, F, keys)
    judged = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    if not judged.any():
        raise DatasetError("the pairs all share scans: no block of time can be held back")
    held_back, before = select(examples, judged), F[judged]
    scaled, extended_F = scaled[judged], extended_F[judged]
    fits = _fits(F, examples)
    outliers, fitted = _split(keys, ~fits)
    examples, F = select(examples, fits), F[fits]
    Y = held_back.covariances
    pays = _mean_kl(Y, extended_F) < _GAIN * _mean_kl(Y, scaled)
    kind = EXAMPLES if pays and len(fitted) >= _FEWEST_FOR_EXAMPLES else SIZE
    scale = _scale(F, examples)
    tuned = extended(model, examples, scale) if kind == EXAMPLES else resized(model, scale)
    tuned = _knowing(tuned, model, examples)
    return Tuning(
        model=replace(tuned, provenance=_provenance(model, dataset, fitted, kind, scale)),
        kind=kind,
        scale=scale,
        before=figures(before, held_back),
        after=figures(extended_F if kind == EXAMPLES else scaled, held_back),
        rejected=tuple(rejected),
        flagged=tuple(flagged),
        outliers=tuple(outliers),
    )


def _cross_validated(
    model: Model, examples: Examples, F: Array, keys: Sequence[PairKey]
) -> tuple[Array, Array]:
    """Return what is said of pairs, (N, 6, 6), by the model tuned to other blocks of time.

    F: (N, 6, 6), what the model says.  Once by its size alone, once with the examples of the other
    blocks; NaN for pairs that no block holds back.
    """
    scaled, extended_F = np.full_like(F, np.nan), np.full_like(F, np.nan)
    for held, rest in _blocks(keys):
        rest[rest] = _fits(F[rest], select(examples, rest))
        ours, theirs = select(examples, rest), select(examples, held)
        scale = _scale(F[rest], ours)
        scaled[held] = scale * F[held]
        extended_F[held] = predictions(extended(model, ours, scale), theirs)
    return scaled, extended_F


def predictions(model: Model, examples: Examples) -> Array:
    """Return what a model says of pairs, (N, 6, 6).  examples: after ``select_inputs``."""
    return np.array([answer.covariance for answer in answers(model, examples)])


def resized(model: Model, scale: float) -> Model:
    """Return the model with every covariance multiplied."""
    return replace(model, margin=scale * model.margin, training_mean=scale * model.training_mean)


def extended(model: Model, examples: Examples, scale: float) -> Model:
    """Return the model with its examples multiplied and those of a recording beside them."""
    X = flat_features(examples)
    own = examples_of(examples, model.shape, model.frame) / model.margin
    low, high = X.min(axis=0), X.max(axis=0)
    if len(model.input_range):
        low = np.minimum(low, model.input_range[0])
        high = np.maximum(high, model.input_range[1])
    return replace(
        model,
        projections=np.concatenate(
            [model.projections, project(X, model.theta, model.mean, model.scale)]
        ),
        covariances=np.concatenate([scale * model.covariances, own]),
        input_range=np.stack([low, high]) if len(model.input_range) else model.input_range,
        training_mean=scale * model.training_mean,
    )


def _knowing(tuned: Model, model: Model, examples: Examples) -> Model:
    """Return the tuned model with the pairs of the recording known: they have been judged."""
    if not len(model.rho_quantiles):
        return tuned
    points = project(flat_features(examples), model.theta, model.mean, model.scale)
    nearest = [((model.projections - point) ** 2).sum(axis=1).min() for point in points]
    levels = np.linspace(0.0, 1.0, len(model.rho_quantiles))
    known = np.maximum(model.rho_quantiles, np.quantile(nearest, levels))
    return replace(tuned, rho_quantiles=known)


def _check(model: Model, examples: Examples, n_pairs: int) -> None:
    check_settings(model, examples)
    if n_pairs < _FEWEST_PAIRS:
        raise DatasetError(f"{n_pairs} pairs can be used, tuning needs at least {_FEWEST_PAIRS}")
    if not np.array_equal(examples.rotations_rad, model.rotations_rad):
        raise DatasetError("the model's examples are turned otherwise than the dataset's")


def _fits(F: Array, examples: Examples) -> NDArray[np.bool_]:
    """Return which pairs are no farther from the model than 30 times the median pair."""
    misfit = _misfit(F, examples)
    return np.asarray(misfit < _OUTLIER * np.median(misfit))


def _split(keys: Sequence[PairKey], out: NDArray[np.bool_]) -> tuple[list[PairKey], list[PairKey]]:
    """Return the keys that are out, and those that are not."""
    pairs = list(zip(keys, out, strict=True))
    return [key for key, is_out in pairs if is_out], [key for key, is_out in pairs if not is_out]


def _misfit(F: Array, examples: Examples) -> Array:
    """Return ``tr(F^-1 Y) / 6`` of each pair."""
    fit = np.linalg.solve(F, examples.covariances)
    return np.asarray(np.trace(fit, axis1=1, axis2=2) / 6.0)


def _scale(F: Array, examples: Examples) -> float:
    """Return the factor on F with the least mean KL."""
    return float(_misfit(F, examples).mean())


def _mean_kl(Y: Array, F: Array) -> float:
    """Return the mean KL without the worst 10 % of the pairs."""
    divergence = np.sort(kl(Y, F))
    return float(divergence[: max(1, int(0.9 * len(divergence)))].mean())


def _blocks(
    keys: Sequence[PairKey],
) -> Sequence[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Return for each block of time its pairs, and those that share no scan with them."""
    names, references, readings = zip(*keys, strict=True)
    scans = [*zip(names, references, strict=True), *zip(names, readings, strict=True)]
    order = {scan: k for k, scan in enumerate(sorted(set(scans)))}
    i, j = np.array([order[scan] for scan in scans]).reshape(2, -1)
    edges = np.quantile(j, np.linspace(0.0, 1.0, N_BLOCKS + 1))
    edges[-1] += 1.0
    found = []
    for low, high in pairwise(edges):
        held = (j >= low) & (j < high)
        rest = (j < i[held].min(initial=len(order))) | (i > j[held].max(initial=-1))
        if held.any() and rest.any():
            found.append((held, rest))
    return found


def _provenance(
    model: Model,
    dataset: Dataset,
    keys: Sequence[PairKey],
    kind: str,
    scale: float,
) -> dict[str, Any]:
    """Return the provenance of the model with that of the recording."""
    provenance = dict(model.provenance)
    names = sorted({key[0] for key in keys})
    counts = {name: sum(key[0] == name for key in keys) for name in names}
    provenance["recordings"] = {**provenance.get("recordings", {}), **counts}
    prints = {
        name: sorted({str(facts.get("fingerprint", "")), *map(str, facts.get("scans", []))} - {""})
        for name, facts in dataset.recordings.items()
        if name in counts
    }
    provenance["prints"] = {**provenance.get("prints", {}), **prints}
    provenance["tuned"] = {"recordings": counts, "kind": kind, "scale": scale}
    return provenance
