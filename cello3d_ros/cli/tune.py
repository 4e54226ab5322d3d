"""``cello3d tune RECORDING --out MODEL``: fit a model to one recording of your own."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.atomic import check_outputs
from cello3d_ros.cli.arguments import add_jobs_argument, positive

if TYPE_CHECKING:
    from cello3d_ros.learning.tune import Tuning


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="bag or data set")
    parser.add_argument(
        "--out",
        metavar="MODEL",
        type=Path,
        required=True,
        help="file to write; samples are kept in MODEL.dataset beside it",
    )
    parser.add_argument(
        "--model", metavar="M", default="", help="model to start from, file or shipped (general)"
    )
    parser.add_argument(
        "--poses",
        choices=("recorded", "joint"),
        default="joint",
        help="ground truth: joint poses found in the clouds (docs/align.md), or as recorded",
    )
    parser.add_argument(
        "--samples",
        type=positive,
        default=200,
        metavar="N",
        help="registrations of each pair (200)",
    )
    parser.add_argument("--max-gap", type=positive, metavar="G", help="largest j - i of a pair")
    add_jobs_argument(parser)


def run(arguments: argparse.Namespace) -> None:
    """Align, sample, tune and say what came of it; goes on where it was interrupted."""
    from cello3d_ros.cli.align import joint
    from cello3d_ros.cli.sample import progress_bar
    from cello3d_ros.config import Config, sections_of
    from cello3d_ros.covariance.model import find_model, load_model, save_model
    from cello3d_ros.learning.dataset import open_dataset
    from cello3d_ros.learning.sample import sample
    from cello3d_ros.learning.tune import tune

    out = arguments.out
    check_outputs([out], [arguments.recording])
    model = load_model(find_model(arguments.model))
    folder = out.with_name(f"{out.name}.dataset")
    wanted = {"n_samples": arguments.samples, "max_gap": arguments.max_gap}
    sampling = replace(
        model.sampling, precision=0.0, **{k: v for k, v in wanted.items() if v is not None}
    )
    config = Config(**sections_of(model.pipeline), sampling=sampling)
    recordings = [arguments.recording]
    if arguments.poses == "joint":
        recordings = joint(recordings, folder, config, arguments.jobs)
    with progress_bar() as report:
        sample(recordings, folder, config, arguments.jobs, report)
    dataset = open_dataset(folder)
    found = tune(model, dataset)
    save_model(found.model, out)
    print("\n".join([str(out), *sentences(found)]))


def sentences(found: Tuning) -> Iterator[str]:
    """Yield what a user should know of a tuned model."""
    before, after = found.before, found.after
    assert before.dm2_over_6 is not None
    assert after.dm2_over_6 is not None
    ratio = before.dm2_over_6**0.5
    how = "more" if ratio >= 1.0 else "less"
    times = ratio if ratio >= 1.0 else 1.0 / ratio
    yield f"your sensor scatters {times:.1f} times {how} than the model said (D2/6 {ratio**2:.2f})"
    if found.kind == "size":
        yield f"every covariance of the model is multiplied by {found.scale:.2f}"
    else:
        yield (
            f"the {before.n_pairs} pairs of the recording join the examples of the model, whose "
            f"own are multiplied by {found.scale:.2f}"
        )
    yield (
        f"on the blocks of time that were held back: D2/6 {before.dm2_over_6:.2f} -> "
        f"{after.dm2_over_6:.2f}, in 95 %: {before.coverage_95:.2f} -> {after.coverage_95:.2f}, "
        f"KL {before.kl_median:.2f} -> {after.kl_median:.2f} (median of {before.n_pairs} pairs)"
    )
    if found.rejected:
        yield (
            f"{len(found.rejected)} pairs not used, sampling gave them no covariance or no plane "
            f"holds some direction: {_named(found.rejected)}"
        )
    if found.flagged:
        yield (
            f"{len(found.flagged)} pairs not used, their registrations do not agree with their "
            f"poses: {_named(found.flagged)}"
        )
    if found.outliers:
        yield (
            f"{len(found.outliers)} pairs judged but not fitted to, their registrations scatter "
            f"far more than those of the others: {_named(found.outliers)}"
        )


def _named(pairs: Sequence[tuple[str, int, int]]) -> str:
    more = " ..." if len(pairs) > 10 else ""
    return ", ".join(f"{i}-{j}" for _, i, j in pairs[:10]) + more
