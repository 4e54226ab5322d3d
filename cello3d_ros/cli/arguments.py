"""Arguments that several verbs share, and the words they are checked with."""

from __future__ import annotations

import argparse
import os

from cello3d_ros.config import PIPELINES


def natural(word: str) -> int:
    """Return a whole number that is not negative."""
    if (number := int(word)) < 0:
        raise argparse.ArgumentTypeError(f"must not be negative: {word}")
    return number


def positive(word: str) -> int:
    """Return a whole number of at least 1."""
    if (number := int(word)) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1: {word}")
    return number


def add_seed_argument(
    parser: argparse.ArgumentParser,
    what: str = "of the random subsamples",
    default: int | None = 0,
) -> None:
    """Declare the seed; what: what is drawn from it."""
    parser.add_argument("--seed", type=natural, default=default, metavar="N", help=what)


def add_jobs_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the number of threads, as many as the machine has by default."""
    parser.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="threads"
    )


def add_pipeline_argument(parser: argparse.ArgumentParser, default: str) -> None:
    """Declare the option that names a pipeline; default: where the settings are from without."""
    parser.add_argument(
        "--pipeline",
        choices=tuple(PIPELINES),
        default="",
        help=f"settings of clouds and ICP, in place of {default}",
    )
