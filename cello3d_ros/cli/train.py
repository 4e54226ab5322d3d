"""``cello3d train DATASET... --out MODEL``: learn which pairs resemble each other."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.config import TrainingConfig, load_config
from cello3d_ros.errors import counted

if TYPE_CHECKING:
    from cello3d_ros.learning.measures import Figures

_FLAGS = ("shape", "features", "theta", "loss", "optimizer")
_DATASETS = (
    "folder; of those sampled from farther starts than another only the lost registrations count"
)
_COLUMNS = (  # heading, figure
    ("KL mean", "kl_mean"),
    ("median", "kl_median"),
    ("trimmed", "kl_trimmed_mean"),
    ("D2/6", "dm2_over_6"),
    ("in 95 %", "coverage_95"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("datasets", nargs="+", type=Path, metavar="DATASET", help=_DATASETS)
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
    from cello3d_ros.learning.train import FARTHER, curve_beside, train

    training = train(
        arguments.datasets,
        arguments.out,
        _settings(arguments),
        arguments.validation,
        arguments.exclude,
        _report if sys.stderr.isatty() else None,
    )
    if training.interrupted:
        print("\ninterrupted: the model is the best so far", file=sys.stderr)
    n_pairs = training.model.provenance["recordings"]
    steps = f"Theta of step {training.best_iteration} of {training.n_iterations}"
    print(f"{arguments.out}: {sum(n_pairs.values())} pairs of {len(n_pairs)} recordings, {steps}")
    for path, n_lost in training.model.provenance[FARTHER]:
        print(
            f"{path}: its starts are farther from the truth than those of another dataset: its "
            f"pairs are no examples, its {counted(n_lost, 'lost registration')} count"
        )
    print(f"{curve_beside(arguments.out)}: the loss over its steps")
    for name, figures in training.figures.items():
        print("\n".join(_table(name, figures)))


def _settings(arguments: argparse.Namespace) -> TrainingConfig:
    config = load_config(arguments.config).training if arguments.config else TrainingConfig()
    flags = {name: getattr(arguments, name) for name in _FLAGS}
    return replace(config, **{name: value for name, value in flags.items() if value})


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
