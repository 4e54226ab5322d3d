"""Learn a model from datasets on disk, with recordings kept apart by their use."""

from __future__ import annotations

import dataclasses
import fnmatch
import glob
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cello3d_ros.atomic import check_outputs, new_file
from cello3d_ros.config import TrainingConfig
from cello3d_ros.covariance.model import save_model
from cello3d_ros.errors import DatasetError
from cello3d_ros.learning.dataset import Dataset, open_dataset
from cello3d_ros.learning.examples import load_examples, lost_errors
from cello3d_ros.learning.identity import check_apart, recordings_of
from cello3d_ros.learning.training import Progress, Training, fit

FARTHER = "farther_starts"  # in the provenance: datasets of them, and their lost registrations


class Split(NamedTuple):
    """Names of recordings by their use; what is excluded is in neither."""

    training: list[str]
    validation: list[str]


def train(
    datasets: Sequence[Path | str],
    out: Path | str,
    config: TrainingConfig | None = None,
    validation: Sequence[Path | str] = (),
    exclude: Sequence[Path | str] = (),
    progress: Progress | None = None,
) -> Training:
    """Learn a model from datasets and write it to ``out``, and beside it its learning curve.

    validation: recordings (names or patterns) or dataset folders that say when to stop, never
    trained on; exclude: those that are not looked at.  Datasets may differ in the variance of
    their starts: the pairs of the nearest starts are the examples, and of the others only the
    registrations count that ended in another minimum.
    Raises DatasetError for what cannot be trained on or kept apart, WriteError before training
    where ``out`` cannot be written.
    """
    out = Path(out)
    folders = [*datasets, *filter(_is_dataset, validation)]
    check_outputs([out], folders)
    opened = [open_dataset(path) for path in {Path(f).resolve(): f for f in folders}.values()]
    known = recordings_of(opened)
    split = split_recordings(known, _patterns(validation), _patterns(exclude))
    excluded = sorted(set(known) - set(split.training) - set(split.validation))
    check_apart(known, split.training, split.validation, excluded)
    near, far = _by_starts(opened, {Path(f).resolve() for f in datasets}, split)
    examples = load_examples(near, split.training)
    lost = [lost_errors(other, split.training, near[0]) for other in far]
    examples = dataclasses.replace(examples, lost_xi=np.concatenate([examples.lost_xi, *lost]))
    judging = load_examples(near, split.validation) if split.validation else None
    training = fit(examples, config or TrainingConfig(), judging, progress)
    prints = {name: sorted(known[name]) for name in (*split.training, *split.validation)}
    counts = [[other.path.name, len(xi)] for other, xi in zip(far, lost, strict=True)]
    provenance = {**training.model.provenance, "prints": prints, FARTHER: counts}
    model = dataclasses.replace(training.model, provenance=provenance)
    save_model(model, out)
    judged_by = "validation recordings" if judging else "training, regularised"
    _plot(training, judged_by, curve_beside(out))
    return dataclasses.replace(training, model=model)


def curve_beside(model: Path) -> Path:
    """Return where the learning curve of a model is drawn."""
    return model.with_suffix(".learning_curve.png")


def split_recordings(
    names: Iterable[str], validation: Sequence[str], exclude: Sequence[str]
) -> Split:
    """Divide recordings by patterns; to exclude wins over to validate, both over training.

    Raises DatasetError for a pattern that matches nothing: a misspelt one would train on tests.
    """
    names = sorted(set(names))
    for pattern in (*validation, *exclude):
        if not any(fnmatch.fnmatchcase(name, pattern) for name in names):
            raise DatasetError(f"no recording matches {pattern!r}: there are {', '.join(names)}")
    excluded = {name for name in names if _matches(name, exclude)}
    validating = [name for name in names if _matches(name, validation) and name not in excluded]
    training = [name for name in names if name not in excluded and name not in validating]
    if not training:
        raise DatasetError("no recording is left to train on")
    return Split(training, validating)


def _by_starts(
    opened: Sequence[Dataset], training: set[Path], split: Split
) -> tuple[list[Dataset], list[Dataset]]:
    """Return the datasets of the nearest starts in training and for validation, and the others.

    Raises DatasetError where the first leave nothing to train on or to validate by.
    """
    to_train_on = [dataset for dataset in opened if dataset.path.resolve() in training]
    least = min(dataset.sampling.variance for dataset in to_train_on)
    far = [dataset for dataset in to_train_on if dataset.sampling.variance > least]
    near = [dataset for dataset in opened if dataset not in far]
    known = {name for dataset in near for name in dataset.recordings}
    if known.isdisjoint(split.training):
        raise DatasetError(f"no recording is left to train on whose starts have variance {least}")
    if missing := sorted(set(split.validation) - known):
        raise DatasetError(
            f"{missing[0]} cannot validate: its starts are farther than in training"
        )
    keys = [key for dataset in far for key in dataset.pair_keys()]
    if len(set(keys)) < len(keys):
        raise DatasetError("two datasets of farther starts hold the same pair")
    return near, far


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _is_dataset(word: Path | str) -> bool:
    return (Path(word) / "manifest.json").is_file()


def _patterns(words: Sequence[Path | str]) -> list[str]:
    """Return patterns of recordings: those given, and every name in the folders given."""
    patterns: list[str] = []
    for word in words:
        if _is_dataset(word):
            patterns += map(glob.escape, open_dataset(word).recordings)
        else:
            patterns.append(str(word))
    return patterns


def _plot(training: Training, judged_by: str, path: Path) -> None:
    """Write a PNG of the losses over the iterations.  judged_by: name of what judged Theta."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    iterations, losses, judged = zip(*training.curve)
    axes.plot(iterations, losses, label="training recordings, each from the others")
    axes.plot(iterations, judged, label=judged_by)
    axes.axvline(training.best_iteration, color="grey", linestyle=":", label="kept")
    axes.set(xlabel="iteration", ylabel="loss")
    axes.grid(alpha=0.3)
    axes.legend()
    with new_file(path) as partial:
        figure.savefig(partial, format="png", metadata={"Software": None})
