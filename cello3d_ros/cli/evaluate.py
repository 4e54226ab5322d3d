"""``cello3d evaluate DATASET... --model M``: how good covariances are, beside every baseline."""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cello3d_ros.atomic import new_file
from cello3d_ros.errors import Cello3dError, DatasetError, RecordingError

if TYPE_CHECKING:
    from cello3d_ros.covariance.case import MethodSettings
    from cello3d_ros.covariance.model import Model
    from cello3d_ros.evaluation.comparison import Predictions
    from cello3d_ros.learning.dataset import Dataset
    from cello3d_ros.learning.examples import Examples
    from cello3d_ros.recordings.recording import Recording

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
)
_TRAJECTORY = (
    ("length m", "length_m", "10.1f"),
    ("runs", "n_runs", "10d"),
    ("failed", "n_failed", "10d"),
    ("lost", "n_lost", "10d"),
    ("told lost", "n_told", "10d"),
    ("D_M", "dm_6dof", "10.2f"),
    ("transl.", "dm_translation", "10.2f"),
    ("rotation", "dm_rotation", "10.2f"),
    ("in 95 %", "coverage_95", "10.2f"),
    ("error m", "error_m", "10.3f"),
    ("error rad", "error_rad", "10.4f"),
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
    parser.add_argument("--seed", type=int, default=0, help="of every random draw")
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
    _words(
        parser, "--recordings", "RECORDING", "bags or data sets, for the methods that need clouds"
    )
    parser.add_argument(
        "--online-pairs", type=_positive, metavar="N", help="pairs of a recording they are run on"
    )
    parser.add_argument(
        "--registrations", type=_positive, default=12, metavar="N", help="of Monte Carlo, fused"
    )
    parser.add_argument(
        "--sensor-sigma", type=float, default=0.01, metavar="M", help="noise of a point (0.01 m)"
    )
    parser.add_argument(
        "--trajectories", type=_positive, metavar="N", help="runs of ICP odometry of a recording"
    )
    parser.add_argument(
        "--jobs", type=_positive, default=os.cpu_count() or 1, metavar="N", help="threads"
    )


def run(arguments: argparse.Namespace) -> None:
    """Evaluate, print tables and write the JSON."""
    from cello3d_ros.covariance.case import MethodSettings
    from cello3d_ros.covariance.model import find_model, load_model
    from cello3d_ros.evaluation.comparison import (
        from_dataset,
        mean_of,
        seen_recordings,
        training_mean,
    )
    from cello3d_ros.learning.dataset import open_dataset
    from cello3d_ros.learning.examples import load_examples
    from cello3d_ros.learning.identity import prints_of

    if arguments.trajectories and not arguments.recordings:
        raise Cello3dError("trajectories need clouds: name their --recordings")
    if not arguments.sensor_sigma > 0.0:
        raise Cello3dError(f"the sensor's noise must be positive: {arguments.sensor_sigma:g}")
    if arguments.json is not None:
        _check_writable(arguments.json)
    path = find_model(arguments.model)
    model = load_model(path)
    settings = MethodSettings(arguments.sensor_sigma, arguments.registrations, widen_unknown=False)
    datasets = [open_dataset(folder) for folder in dict.fromkeys(arguments.datasets)]
    names = chosen(datasets, arguments.only)
    known = prints_of(datasets, names)
    seen = seen_recordings(model, {name: known[name] for name in names})
    if seen and not arguments.allow_seen:
        raise DatasetError(
            f"the model was trained or validated on {_named(seen)}: choose others with --only, "
            "or say --allow-seen"
        )
    recordings = _recordings(arguments.recordings, names)
    baseline = [open_dataset(folder) for folder in arguments.baseline]
    mean = mean_of(baseline) if baseline else training_mean(model)
    examples = load_examples(datasets, names)
    keys = _accepted(datasets, names)
    predictions = from_dataset(model, examples, mean, settings)
    _add_online(predictions, keys, recordings, model, settings, arguments)
    assumed = {name: getattr(settings, name) for name in ("sigma_m", "n_registrations")}
    report: dict[str, Any] = {"model": str(path), "shape": model.shape, "settings": assumed}
    report |= _pairs_report(predictions, examples, keys, settings, arguments.exact_poses)
    for name, part in report["recordings"].items():
        part["trained_on"] = name in seen
    report["worst_pairs"] = _worst_pairs(datasets, report["pairs"], keys, predictions)
    report["trajectories"] = _trajectories(recordings, model, arguments)
    print("\n".join(_tables(report)))
    if arguments.json is not None:
        write_json(arguments.json, report)


def chosen(datasets: Sequence[Dataset], only: Sequence[str]) -> list[str]:
    """Return the recordings to evaluate.  Raises DatasetError for a pattern that matches none."""
    names = sorted({key[0] for dataset in datasets for key in dataset.pair_keys()})
    for pattern in only:
        if not any(fnmatch.fnmatchcase(name, pattern) for name in names):
            raise DatasetError(f"no recording matches {pattern!r}: there are {', '.join(names)}")
    names = [name for name in names if not only or _matches(name, only)]
    if not names:
        raise DatasetError(f"{datasets[0].path} holds no pair")
    return names


def _named(seen: dict[str, str]) -> str:
    """Return recordings that a model has seen, with its own name where that is another."""
    return ", ".join(n if n == twin else f"{n} (as {twin})" for n, twin in sorted(seen.items()))


def write_json(path: Path, report: dict[str, Any]) -> None:
    """Write the report in one piece.  Raises WriteError where the disk refuses."""
    with new_file(path) as partial:
        partial.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _words(parser: argparse.ArgumentParser, flag: str, metavar: str, text: str) -> None:
    parser.add_argument(flag, nargs="+", action="extend", default=[], metavar=metavar, help=text)


def _positive(word: str) -> int:
    if (number := int(word)) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1: {word}")
    return number


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _check_writable(path: Path) -> None:
    """Raise before the work, not after."""
    if path.is_dir() or not path.parent.is_dir():
        raise Cello3dError(f"cannot write {path}: not a file in an existing folder")


def _recordings(paths: Sequence[str], names: Sequence[str]) -> dict[str, Recording]:
    """Open recordings.  Raises RecordingError for one that is not evaluated."""
    from cello3d_ros.recordings import open_recording

    found: dict[str, Recording] = {}
    for path in paths:
        recording = open_recording(path)
        if recording.name not in names:
            raise RecordingError(
                f"{path}: recording {recording.name!r} is not among those evaluated, "
                f"{', '.join(names)}"
            )
        found[recording.name] = recording
    return found


def _accepted(datasets: Sequence[Dataset], names: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return the accepted pairs, in the order of the examples."""
    wanted = set(names)
    return sorted(
        key
        for dataset in datasets
        for key in dataset.pair_keys()
        if key[0] in wanted and dataset.read(*key).accepted
    )


def _add_online(
    predictions: Predictions,
    keys: list[tuple[str, int, int]],
    recordings: dict[str, Recording],
    model: Model,
    settings: MethodSettings,
    arguments: argparse.Namespace,
) -> None:
    """Run the methods that need clouds on the pairs of the recordings that were given."""
    from tqdm import tqdm

    from cello3d_ros.evaluation.comparison import add_answers
    from cello3d_ros.evaluation.online import answers

    for name, recording in recordings.items():
        rows = [row for row, key in enumerate(keys) if key[0] == name]
        if (n := arguments.online_pairs) and n < len(rows):
            rows = [rows[k] for k in np.linspace(0, len(rows) - 1, n).astype(int)]
        run = answers(recording, [keys[row][1:] for row in rows], model, settings, arguments.seed)
        bar = tqdm(run, total=len(rows), desc=name, disable=not sys.stderr.isatty(), leave=False)
        add_answers(predictions, rows, list(bar))


def _pairs_report(
    predictions: Predictions,
    examples: Examples,
    keys: list[tuple[str, int, int]],
    settings: MethodSettings,
    exact_poses: Sequence[str],
) -> dict[str, Any]:
    """Return the pose check, the figures without the flagged pairs and with all, and every KL."""
    from cello3d_ros.evaluation.comparison import compare, divergences
    from cello3d_ros.evaluation.evidence import calibration, fits
    from cello3d_ros.learning.measures import pose_check

    checks = [pose_check(xi) for xi in examples.xi]
    for (name, _, _), check in zip(keys, checks, strict=True):
        check["flagged"] &= not _matches(name, exact_poses)
    flagged = np.array([check["flagged"] for check in checks])
    if flagged.all():
        raise DatasetError("the pose check flags every pair: ground truth is not usable")
    report = compare(predictions, examples, ~flagged, settings)
    if flagged.any():
        everything = compare(predictions, examples, np.ones_like(flagged), settings)
        report["with_flagged_pairs"] = {k: everything[k] for k in ("n_pairs", "methods")}
    report["pose_check"] = _pose_checks(keys, checks)
    report["calibration"] = calibration(predictions, examples, ~flagged)
    report["pairs"] = [
        {
            **{"recording": name, "i": i, "j": j},
            **check,
            "kl": divergences(predictions, examples, k),
            "dm2_over_6": fits(predictions, examples, k),
        }
        for k, ((name, i, j), check) in enumerate(zip(keys, checks, strict=True))
    ]
    return report


def _worst_pairs(
    datasets: Sequence[Dataset],
    pairs: list[dict[str, Any]],
    keys: list[tuple[str, int, int]],
    predictions: Predictions,
) -> list[dict[str, Any]]:
    """Return what there is to see of the pairs whose covariances the model misses most."""
    from cello3d_ros.evaluation.evidence import N_WORST, seen

    order = sorted(
        (k for k, pair in enumerate(pairs) if not pair["flagged"]),
        key=lambda k: -pairs[k]["kl"]["cello3d"],
    )
    holders = {key: dataset for dataset in datasets for key in dataset.pair_keys()}
    return [
        seen(holders[keys[k]].read(*keys[k]), predictions.covariances["cello3d"][k])
        | {"kl": pairs[k]["kl"]["cello3d"]}
        for k in order[:N_WORST]
    ]


def _pose_checks(
    keys: list[tuple[str, int, int]], checks: list[dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Return medians of each recording and its flagged pairs."""
    grouped: dict[str, list[tuple[int, int, dict[str, Any]]]] = defaultdict(list)
    for (name, i, j), check in zip(keys, checks, strict=True):
        grouped[name].append((i, j, check))
    return {
        name: {
            "n_pairs": len(rows),
            **{
                key: float(np.median([check[key] for _, _, check in rows]))
                for key in ("offset_m", "scatter_m", "offset_rad", "scatter_rad")
            },
            "n_flagged": sum(check["flagged"] for _, _, check in rows),
            "flagged": [[i, j] for i, j, check in rows if check["flagged"]],
        }
        for name, rows in grouped.items()
    }


def _trajectories(
    recordings: dict[str, Recording], model: Model, arguments: argparse.Namespace
) -> dict[str, Any]:
    from cello3d_ros.evaluation.evidence import drawn
    from cello3d_ros.evaluation.online import prepared
    from cello3d_ros.evaluation.trajectories import consistency, length_m, odometry_runs

    report: dict[str, Any] = {}
    for name, recording in recordings.items() if arguments.trajectories else ():
        if len(recording) < 2:
            raise RecordingError(f"{name} has {len(recording)} scan: no trajectory")
        clouds, poses = prepared(recording, model.pipeline, range(len(recording)), arguments.seed)
        T = np.array([poses[k] for k in range(len(recording))])
        runs = odometry_runs(
            [clouds[k] for k in range(len(recording))],
            T,
            model,
            arguments.trajectories,
            arguments.seed,
            arguments.jobs,
        )
        report[name] = {"length_m": length_m(T), **consistency(runs), "paths": drawn(T, runs)}
    return report


def _tables(report: dict[str, Any]) -> Iterator[str]:
    """Yield the lines for people."""
    yield f"{report['model']} (shape {report['shape']})"
    yield from _table("ground truth against registrations", _POSES, report["pose_check"])
    for name, check in report["pose_check"].items():
        if check["flagged"]:
            pairs = ", ".join(f"{i}-{j}" for i, j in check["flagged"])
            yield f"  {name}: left out of the figures, suspected of wrong poses: {pairs}"
    for name, part in report["recordings"].items():
        yield from _table(f"{name} ({part['n_pairs']} pairs)", _COLUMNS, part["methods"])
        if part["trained_on"]:
            yield f"  {name}: the model was trained or validated on it, which flatters the model"
    yield from _table(f"all ({report['n_pairs']} pairs)", _COLUMNS, report["methods"])
    if "with_flagged_pairs" in report:
        part = report["with_flagged_pairs"]
        yield from _table(f"flagged too ({part['n_pairs']} pairs)", _COLUMNS, part["methods"])
    if report["trajectories"]:
        rows = {}
        for name, row in report["trajectories"].items():
            rows[name] = row
            if row["n_lost"]:
                rows[f"{name}, not the lost"] = row["without_lost"]
        yield from _table("trajectories", _TRAJECTORY, rows)


def _table(
    title: str, columns: Sequence[tuple[str, str, str]], rows: dict[str, dict[str, Any]]
) -> Iterator[str]:
    """Yield a table; a figure that is not there leaves its place empty."""
    yield ""
    widths = [int(form.rstrip("dfg").split(".")[0]) for _, _, form in columns]
    heads = (f"{head:>{width}}" for (head, _, _), width in zip(columns, widths, strict=True))
    yield f"{title:36}" + "".join(heads)
    for name, row in rows.items():
        cells = (
            " " * width if row.get(key) is None else format(row[key], form)
            for (_, key, form), width in zip(columns, widths, strict=True)
        )
        yield f"  {name.replace('_', ' '):34}" + "".join(cells)
