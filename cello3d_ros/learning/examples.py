"""What a model is trained on: the accepted pairs of some recordings, and their turned copies."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.config import Pipeline, SamplingConfig, differences, pipeline_name
from cello3d_ros.covariance.features import is_free, model_inputs
from cello3d_ros.covariance.heading import blended, into_motion, motion_of, out_of_motion
from cello3d_ros.covariance.model import Model, Prediction, predict
from cello3d_ros.errors import DatasetError
from cello3d_ros.geometry.gaussian import matrix_inverse_sqrt, matrix_sqrt, symmetrized
from cello3d_ros.geometry.se3 import Array, adjoint, exp
from cello3d_ros.learning.clustering import far_from_truth
from cello3d_ros.learning.dataset import Dataset, PairRecord

Indices = NDArray[np.intp]

# sampling settings in which datasets may differ
_FREE = ("seed", "n_samples", "min_samples", "precision", "max_gap", "n_views")
_MAX_SAMPLES = 200  # errors of each pair kept for the coverage


@dataclass(frozen=True, kw_only=True, eq=False)
class Examples:
    """Accepted pairs of some recordings; nothing is relative or turned yet but the features.

    features: (N, n_rotations, D) descriptors of the pair turned about z by ``rotations_rad``;
    after ``select_inputs`` what a model looks at.  global_features: (N, G).  motions: (N, 2), what
    ``motion_of`` finds in the true T_ref_read.
    covariances: (N, 6, 6).  groups: (N,) names of recordings.  shapes: name -> (N, 6, 6).
    scans: (N, 2), numbers of the reference and of the reading; T_mean: (N, 4, 4), true T_ref_read.
    xi: N arrays (n, 6), some of the errors that made each covariance.  lost_xi: (M, 6), the errors
    of all their registrations that ended in another minimum.
    """

    features: NDArray[np.floating[Any]]
    covariances: Array
    motions: Array
    groups: NDArray[np.str_]
    shapes: dict[str, Array]
    rotations_rad: Array
    global_features: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    scans: NDArray[np.int64] = dataclasses.field(default_factory=lambda: np.zeros((0, 2), int))
    T_mean: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 4, 4)))
    xi: tuple[Array, ...] = ()
    lost_xi: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 6)))
    rejected: dict[str, int] = dataclasses.field(default_factory=dict)  # reason -> pairs
    pipeline: Pipeline = dataclasses.field(default_factory=Pipeline)
    sampling: SamplingConfig = dataclasses.field(default_factory=SamplingConfig)

    @property
    def n_pairs(self) -> dict[str, int]:
        """Accepted pairs of each recording."""
        return dict(sorted(Counter(self.groups.tolist()).items()))


def load_examples(datasets: Sequence[Dataset], recordings: Iterable[str]) -> Examples:
    """Read the accepted pairs of the named recordings.

    Raises DatasetError where datasets were made with different settings, share a pair, hold a
    damaged pair, or have no accepted pair of these recordings.
    """
    for other in datasets[1:]:
        _check_alike(datasets[0], other)
    wanted = set(recordings)
    records: dict[tuple[str, int, int], PairRecord] = {}
    lost: dict[tuple[str, int, int], Array] = {}
    for dataset in datasets:
        for key in dataset.pair_keys():
            if key[0] in wanted:
                if key in records:
                    raise DatasetError(f"{dataset.path} repeats the pair {key} of another dataset")
                records[key] = _slim(record := dataset.read(*key))
                lost[key] = _lost(record, dataset.sampling)
    found = _stacked([records[key] for key in sorted(records)], datasets[0])
    lost_xi = np.concatenate([np.zeros((0, 6)), *(lost[key] for key in sorted(lost))])
    return dataclasses.replace(found, lost_xi=lost_xi)


def lost_errors(dataset: Dataset, recordings: Iterable[str], like: Dataset) -> Array:
    """Return the errors (M, 6) of the registrations that ended in another minimum.

    Raises DatasetError where it differs from a dataset in other settings than that of its starts.
    """
    _check_alike(like, dataset, (*_FREE, "variance"))
    wanted = set(recordings)
    keys = sorted(key for key in dataset.pair_keys() if key[0] in wanted)
    found = [_lost(dataset.read(*key), dataset.sampling) for key in keys]
    return np.concatenate([np.zeros((0, 6)), *found])


def select_inputs(examples: Examples, kind: str) -> Examples:
    """Return the examples with what a model of ``kind`` looks at as their features."""
    if kind == "descriptor":
        return examples
    if len(examples.global_features) != len(examples.features):
        raise DatasetError("the examples hold no global features: train with features descriptor")
    first = unturned_rows(examples).start
    descriptors = examples.features[:, first:].astype(np.float64)
    inputs = model_inputs(kind, descriptors, examples.global_features)
    return dataclasses.replace(examples, features=inputs, rotations_rad=np.zeros(1))


def are_held(examples: Examples) -> NDArray[np.bool_]:
    """Return which pairs have no free direction: others have no answer, and no size to learn."""
    if not len(examples.global_features):
        return np.ones(len(examples.covariances), np.bool_)
    return ~is_free(examples.global_features)


def to_relative(examples: Examples, shape: str) -> Array:
    """Return ``S^-1/2 Y S^-1/2`` of every pair, or Y if the shape is none."""
    if shape == "none":
        return examples.covariances
    try:
        root = matrix_inverse_sqrt(examples.shapes[shape])
    except np.linalg.LinAlgError:
        raise DatasetError(f"the {shape} of a pair is singular to rounding") from None
    except KeyError:
        raise DatasetError(f"the dataset does not hold the {shape} of each pair") from None
    return symmetrized(root @ examples.covariances @ root)


def targets_of(examples: Examples, shape: str, frame: str) -> Array:
    """Return what a model is to predict of each pair: relative, along the axes of the frame."""
    Y = to_relative(examples, shape)
    return into_motion(Y, examples.motions) if frame == "motion" else Y


def examples_of(examples: Examples, shape: str, frame: str) -> Array:
    """Return the covariances that a model holds, of each pair its turns.  (N R, 6, 6).

    In the motion frame a pair turned about z is the same pair.
    """
    Y = targets_of(examples, shape, frame)
    if frame == "sensor":
        return turn(Y, examples.rotations_rad)
    return np.repeat(blended(Y, examples.motions), len(examples.rotations_rad), axis=0)


def motions_of(examples: Examples, frame: str) -> Array | None:
    """Return the motions (N, 2) along which predictions lie; None in the sensor's frame."""
    return examples.motions if frame == "motion" else None


def to_absolute(relative: Array, examples: Examples, shape: str, frame: str) -> Array:
    """Return the covariances of pairs from what ``targets_of`` makes of them."""
    if frame == "motion":
        relative = out_of_motion(relative, examples.motions)
    if shape == "none":
        return relative
    root = matrix_sqrt(examples.shapes[shape])
    return symmetrized(root @ relative @ root)


def places(model: Model, examples: Examples) -> list[tuple[Array | None, Array | None]]:
    """Return what places a covariance of the model for each pair: its shape and its motion."""
    n = len(examples.covariances)
    shapes = [None] * n if model.shape == "none" else list(examples.shapes[model.shape])
    motions = [None] * n if model.frame == "sensor" else list(examples.motions)
    return list(zip(shapes, motions, strict=True))


def answers(model: Model, examples: Examples) -> list[Prediction]:
    """Return what a model says of each pair.  examples: after ``select_inputs``."""
    row = unturned_rows(examples).start
    pairs = zip(examples.features, places(model, examples), strict=True)
    return [predict(model, d[row], *place) for d, place in pairs]


def turn(Y: Array, rotations_rad: Array) -> Array:
    """Return ``Ad_R Y Ad_R^T`` for each turn R about z of the reading frame.

    A shape turns with its covariance, so what is relative turns the same way.
    (N, 6, 6), (R,) -> (N R, 6, 6), the turns of a pair side by side.
    """
    xi = np.zeros((len(rotations_rad), 6))
    xi[:, 5] = rotations_rad
    Ad = adjoint(exp(xi))
    return symmetrized(Ad @ Y[:, None] @ np.swapaxes(Ad, 1, 2)).reshape(-1, 6, 6)


def flat_features(examples: Examples) -> Array:
    """Return the features of every pair and turn.  (N n_rotations, D) in float64."""
    return examples.features.reshape(-1, examples.features.shape[-1]).astype(np.float64)


def unturned_rows(examples: Examples) -> slice:
    """Return which rows of ``flat_features`` are pairs as they were recorded."""
    turns = np.flatnonzero(examples.rotations_rad == 0.0)
    if len(turns) == 0:
        raise DatasetError("the dataset holds turned descriptors only, none at 0 rad")
    return slice(int(turns[0]), None, len(examples.rotations_rad))


def feature_scaler(examples: Examples) -> tuple[Array, Array, Indices]:
    """Return mean and scale (1 for constants) of the features, and which of them vary."""
    X = flat_features(examples)
    mean, std = X.mean(axis=0), X.std(axis=0)
    varies = std > 1e-6 * (np.abs(mean) + 1e-6)
    return mean, np.where(varies, std, 1.0), np.flatnonzero(varies)


def check_settings(model: Model, examples: Examples) -> None:
    """Raise DatasetError where pairs were sampled with other settings than a model's."""
    found = differences(examples.pipeline, model.pipeline)
    if model.features == "global":
        found = [difference for difference in found if not difference.startswith("grid.")]
    if found:
        raise DatasetError(
            f"the dataset was sampled with other settings than the model's (pipeline "
            f"{pipeline_name(model.pipeline)}): {found[0]}"
        )


def _check_alike(ours: Dataset, theirs: Dataset, free: tuple[str, ...] = _FREE) -> None:
    """Raise DatasetError naming the first setting in which two datasets differ."""
    found = differences(theirs.pipeline, ours.pipeline)
    a, b = dataclasses.asdict(theirs.sampling), dataclasses.asdict(ours.sampling)
    found += [
        f"sampling.{name} is {value}, not {b[name]}"
        for name, value in a.items()
        if value != b[name] and name not in free
    ]
    if found:
        raise DatasetError(f"{theirs.path} does not go with {ours.path}: {found[0]}")


def _lost(record: PairRecord, sampling: SamplingConfig) -> Array:
    """Return the errors (n, 6) of an accepted, held pair that ended in another minimum."""
    if not record.accepted or is_free(record.features).any():
        return np.zeros((0, 6))
    far = far_from_truth(record.xi, sampling.cluster_scale_m, sampling.cluster_scale_rad)
    return record.xi[far]


def _slim(record: PairRecord) -> PairRecord:
    """Return the record with at most 200 errors, evenly spaced, of those that were kept."""
    kept = record.xi[record.kept]
    return dataclasses.replace(record, xi=kept[:: -(-len(kept) // _MAX_SAMPLES) or 1])


def _stacked(records: list[PairRecord], dataset: Dataset) -> Examples:
    """Return the accepted of some records of datasets with the settings of ``dataset``."""
    accepted = [record for record in records if record.accepted]
    if not accepted:
        raise DatasetError(f"{dataset.path}: no accepted pair among {len(records)}")
    first = accepted[0]
    for record in accepted:
        same_turns = np.array_equal(record.rotations_rad, first.rotations_rad)
        if record.descriptors.shape != first.descriptors.shape or not same_turns:
            raise DatasetError(f"pairs {first.key} and {record.key} have unlike descriptors")
    names = set.intersection(*(set(record.shapes) for record in accepted))
    return Examples(
        features=np.array([record.descriptors for record in accepted]),
        covariances=np.array([record.covariance for record in accepted]),
        global_features=np.array([record.features for record in accepted]),
        motions=np.array([motion_of(record.T_mean) for record in accepted]),
        groups=np.array([record.recording for record in accepted]),
        shapes={n: np.array([record.shapes[n] for record in accepted]) for n in sorted(names)},
        rotations_rad=first.rotations_rad,
        scans=np.array([record.key[1:] for record in accepted]),
        T_mean=np.array([record.T_mean for record in accepted]),
        xi=tuple(record.xi for record in accepted),
        rejected=dict(sorted(Counter(r.reason for r in records if not r.accepted).items())),
        pipeline=dataset.pipeline,
        sampling=dataset.sampling,
    )
