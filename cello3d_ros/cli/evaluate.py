"""``cello3d evaluate DATASET... --model M``: how good covariances are, beside every baseline."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.atomic import check_outputs
from cello3d_ros.cli.arguments import add_jobs_argument, add_seed_argument, positive

if TYPE_CHECKING:
    from cello3d_ros.evaluation.result import Distances, Evaluation

_COLUMNS = (  # heading, figure, format
    ("pairs", "n_pairs", "8d"),
    ("KL mean", "kl_mean", "9.3g"),
    ("median", "kl_median", "9.3g"),
    ("trimmed", "kl_trimmed_mean", "9.3g"),
    ("90 %", "kl_90", "9.3g"),
    ("ratio", "kl_ratio", "9.3g"),
    ("D2/6", "dm2_over_6", "9.3g"),
    ("in 95 %", "coverage_95", "9.3f"),
    ("CPU ms", "ms_per_pair", "9.1f"),
    ("ICP runs", "icp_runs", "9d"),
    ("covariances are", "verdict", ">30s"),
)
_TRAJECTORY = (
    ("length m", "length_m", "10.1f"),
    ("runs", "n_runs", "10d"),
    ("failed", "n_failed", "10d"),
    ("lost", "n_lost", "10d"),
    ("found lost", "n_told", "10d"),
    ("D_M", "dm_6dof", "10.2f"),
    ("transl.", "dm_translation", "10.2f"),
    ("rotation", "dm_rotation", "10.2f"),
    ("NEES/6", "nees_over_6", "10.3g"),
    ("in 95 %", "coverage_95", "10.2f"),
    ("error m", "error_m", "10.3f"),
    ("error rad", "error_rad", "10.4f"),
    ("covariances are", "verdict", ">30s"),
)
_POSES = (
    ("pairs", "n_pairs", "10d"),
    ("offset m", "offset_m", "10.4f"),
    ("scatter m", "scatter_m", "10.4f"),
    ("offset rad", "offset_rad", "11.5f"),
    ("scatter rad", "scatter_rad", "12.5f"),
    ("flagged", "n_flagged", "8d"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("datasets", nargs="+", type=Path, metavar="DATASET", help="folder")
    parser.add_argument(
        "--model", metavar="M", default="general", help="model file, or a shipped model's name"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="all figures, to write")
    add_seed_argument(parser, "of every random draw")
    _words(parser, "--only", "PATTERN", "recordings to evaluate, such as '*_s11'; all by default")
    parser.add_argument(
        "--allow-seen",
        action="store_true",
        help="evaluate recordings that the model was trained or validated on, too",
    )
    _words(
        parser,
        "--baseline",
        "DATASET",
        "folders whose mean covariance is the baseline, in place of the one that the model was "
        "trained on",
    )
    _words(
        parser,
        "--exact-poses",
        "PATTERN",
        "recordings with exact ground truth (simulation): the pose check flags none of them",
    )
    add_jobs_argument(parser)
    _add_online_arguments(parser)


def _add_online_arguments(parser: argparse.ArgumentParser) -> None:
    _words(
        parser, "--recordings", "RECORDING", "bags or data sets, for the methods that need clouds"
    )
    parser.add_argument(
        "--online-pairs", type=positive, metavar="N", help="pairs of a recording they are run on"
    )
    parser.add_argument(
        "--registrations", type=positive, default=12, metavar="N", help="of Monte Carlo, fused"
    )
    parser.add_argument(
        "--sensor-sigma", type=float, default=0.01, metavar="M", help="noise of a point (0.01 m)"
    )
    parser.add_argument(
        "--trajectories", type=positive, metavar="N", help="runs of ICP odometry of a recording"
    )


def run(arguments: argparse.Namespace) -> None:
    """Evaluate, print tables and write the JSON."""
    from cello3d_ros.evaluation.evaluate import EvaluationSettings, evaluate
    from cello3d_ros.evaluation.result import write_evaluation

    out: Path | None = arguments.json
    if out is not None:
        check_outputs([out], [*arguments.datasets, *arguments.baseline, *arguments.recordings])
    settings = EvaluationSettings(
        only=arguments.only,
        exact_poses=arguments.exact_poses,
        allow_seen=arguments.allow_seen,
        baseline=arguments.baseline,
        recordings=arguments.recordings,
        n_online_pairs=arguments.online_pairs or 0,
        n_trajectories=arguments.trajectories or 0,
        sensor_sigma_m=arguments.sensor_sigma,
        n_registrations=arguments.registrations,
        seed=arguments.seed,
        n_threads=arguments.jobs,
    )
    progress = _progress if sys.stderr.isatty() else lambda name, done, total: None
    found = evaluate(arguments.datasets, arguments.model, settings, progress)
    print("\n".join(_tables(found)))
    if out is not None:
        write_evaluation(found, out)


def _progress(name: str, done: int, total: int) -> None:
    end = "\n" if done == total else ""
    print(f"\r\x1b[K{name}: pair {done} of {total}", end=end, file=sys.stderr, flush=True)


def _words(parser: argparse.ArgumentParser, flag: str, metavar: str, text: str) -> None:
    parser.add_argument(flag, nargs="+", action="extend", default=[], metavar=metavar, help=text)


def _tables(found: Evaluation) -> Iterator[str]:
    """Yield the lines for people."""
    yield f"{found.model} (shape {found.shape})"
    yield from _table("ground truth against registrations", _POSES, found.pose_check)
    for name, check in found.pose_check.items():
        if check.flagged:
            pairs = ", ".join(f"{i}-{j}" for i, j in check.flagged)
            yield f"  {name}: left out of the figures, suspected of wrong poses: {pairs}"
    for name, part in found.recordings.items():
        yield from _table(f"{name} ({part.n_pairs} pairs)", _COLUMNS, part.methods)
        if part.trained_on:
            yield f"  {name}: the model was trained or validated on it, which flatters the model"
    yield from _table(f"all ({found.n_pairs} pairs)", _COLUMNS, found.methods)
    if (all_pairs := found.with_flagged_pairs) is not None:
        yield from _table(f"flagged too ({all_pairs.n_pairs} pairs)", _COLUMNS, all_pairs.methods)
    if found.trajectories:
        rows: dict[str, Distances] = {}
        for name, row in found.trajectories.items():
            rows[name] = row
            if row.n_lost:
                rows[f"{name}, not the lost"] = row.without_lost
        yield from _table("trajectories", _TRAJECTORY, rows)
    model = found.methods["cello3d"]
    yield ""
    if found.n_free:
        yield (
            f"{found.n_free} pairs are left out: no plane holds some direction, so the node "
            "gives them no answer."
        )
    yield (
        f"On these {found.n_pairs} pairs the model's covariances are {model.verdict} "
        f"(D2/6 {model.dm2_over_6:.2g}); {model.coverage_95:.0%} of the errors lie within its "
        "95 % ellipsoids."
    )


def _table(
    title: str, columns: Sequence[tuple[str, str, str]], rows: Mapping[str, object]
) -> Iterator[str]:
    """Yield a table; a figure that is not there leaves its place empty."""
    yield ""
    widths = [int(form.rstrip("dfgs").split(".")[0].lstrip(">")) for _, _, form in columns]
    heads = (f"{head:>{width}}" for (head, _, _), width in zip(columns, widths, strict=True))
    yield f"{title:36}" + "".join(heads)
    for name, row in rows.items():
        cells = (
            " " * width if (value := getattr(row, key, None)) is None else format(value, form)
            for (_, key, form), width in zip(columns, widths, strict=True)
        )
        yield f"  {name.replace('_', ' '):34}" + "".join(cells).rstrip()
