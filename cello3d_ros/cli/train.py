"""``cello3d train DATASET... --out MODEL``: learn which pairs resemble each other."""

from __future__ import annotations

import argparse
import fnmatch
import glob
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cello3d_ros.config import TrainingConfig, load_config
from cello3d_ros.errors import Cello3dError, DatasetError

if TYPE_CHECKING:
    from cello3d_ros.learning.measures import Figures

_FLAGS = ("shape", "features", "theta", "loss", "optimizer")
_COLUMNS = (  # heading, figure
    ("KL mean", "kl_mean"),
    ("median", "kl_median"),
    ("trimmed", "kl_trimmed_mean"),
    ("D2/6", "dm2_over_6"),
    ("in 95 %", "coverage_95"),
)


class Split(NamedTuple):
    """Names of recordings by their use; what is excluded is in neither."""

    training: list[str]
    validation: list[str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("datasets", nargs="+", type=Path, metavar="DATASET", help="folder")
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="MODEL",
        help="file to write, and beside it MODEL.learning_curve.png",
    )
    parser.add_argument(
        "--validation",
        nargs="+",
        action="extend",
        default=[],
        metavar="WHAT",
        help="recordings (names or patterns such as '*_s3') or dataset folders that say when to "
        "stop; never trained on",
    )
    parser.add_argument(
        "--exclude",
        nargs="+",
        action="extend",
        default=[],
        metavar="WHAT",
        help="recordings, the same way, that are not looked at: those kept for tests",
    )
    parser.add_argument("--config", metavar="FILE", help="YAML settings, section training")
    for name in _FLAGS:
        choices = TrainingConfig.__dataclass_fields__[name].metadata["choices"]
        parser.add_argument(f"--{name}", choices=choices, help="in place of the setting")


def run(arguments: argparse.Namespace) -> None:
    """Train, write the model and print how good it is on recordings that it has not seen."""
    from cello3d_ros.covariance.model import save_model
    from cello3d_ros.learning.dataset import open_dataset
    from cello3d_ros.learning.examples import load_examples
    from cello3d_ros.learning.identity import check_apart, recordings_of
    from cello3d_ros.learning.learning_curve import plot_learning_curve
    from cello3d_ros.learning.training import train

    config = _settings(arguments)
    _check_writable(arguments.out)
    folders = [word for word in arguments.validation if _is_dataset(word)]
    paths = {path.resolve(): path for path in [*arguments.datasets, *map(Path, folders)]}
    datasets = [open_dataset(path) for path in paths.values()]
    known = recordings_of(datasets)
    split = split_recordings(known, _names(arguments.validation), _names(arguments.exclude))
    excluded = sorted(set(known) - set(split.training) - set(split.validation))
    check_apart(known, split.training, split.validation, excluded)
    examples = load_examples(datasets, split.training)
    validation = load_examples(datasets, split.validation) if split.validation else None
    training = train(examples, config, validation, _report if sys.stderr.isatty() else None)
    prints = {name: sorted(known[name]) for name in (*split.training, *split.validation)}
    provenance = {**training.model.provenance, "prints": prints}
    save_model(replace(training.model, provenance=provenance), arguments.out)
    judged_by = "validation recordings" if validation else "training, regularised"
    picture = arguments.out.with_suffix(".learning_curve.png")
    plot_learning_curve(training.curve, training.best_iteration, judged_by, picture)
    if training.interrupted:
        print("\ninterrupted: the model is the best so far", file=sys.stderr)
    pairs, recordings = len(examples.covariances), len(examples.n_pairs)
    steps = f"Theta of step {training.best_iteration} of {training.n_iterations}"
    print(f"{arguments.out}: {pairs} pairs of {recordings} recordings, {steps}")
    print(f"{picture}: the loss over its steps")
    for name, figures in training.figures.items():
        print("\n".join(_table(name, figures)))


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


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _is_dataset(word: str) -> bool:
    return (Path(word) / "manifest.json").is_file()


def _names(words: Sequence[str]) -> list[str]:
    """Return patterns of recordings: those given, and every name in the folders given."""
    from cello3d_ros.learning.dataset import open_dataset

    patterns: list[str] = []
    for word in words:
        if _is_dataset(word):
            patterns += map(glob.escape, open_dataset(word).recordings)
        else:
            patterns.append(word)
    return patterns


def _settings(arguments: argparse.Namespace) -> TrainingConfig:
    config = load_config(arguments.config).training if arguments.config else TrainingConfig()
    flags = {name: getattr(arguments, name) for name in _FLAGS}
    return replace(config, **{name: value for name, value in flags.items() if value})


def _check_writable(path: Path) -> None:
    """Raise before hours of training, not after."""
    if path.is_dir() or not path.parent.is_dir():
        raise Cello3dError(f"cannot write the model {path}: not a file in an existing folder")


def _report(iteration: int, training: float, validation: float) -> None:
    line = f"step {iteration}: loss {training:.3f}, judged {validation:.3f}"
    print(f"\r\x1b[K{line}\r", end="", file=sys.stderr, flush=True)


def _table(name: str, figures: dict[str, Figures]) -> Iterator[str]:
    """Yield the lines of one table: a predictor a row, the paper's baseline among them."""
    n_pairs = figures["cello3d"].n_pairs
    yield ""
    heading = f"{name.replace('_', ' ')} ({n_pairs} pairs)"
    yield f"{heading:40}" + "".join(f"{title:>10}" for title, _ in _COLUMNS)
    for predictor, measures in figures.items():
        values = (getattr(measures, key) for _, key in _COLUMNS)
        cells = (" " * 10 if value is None else f"{value:10.4g}" for value in values)
        yield f"  {predictor.replace('_', ' '):38}" + "".join(cells) + f"  {measures.verdict}"
