"""``cello3d info SOURCE``: what a model or a recording holds, for people or machines."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cello3d_ros.cli.recording_info import describe_recording, is_recording
from cello3d_ros.cli.sources import add_source_arguments
from cello3d_ros.config import PIPELINE, config_to, pipeline_name
from cello3d_ros.covariance.model import FORMAT_VERSION, SHIPPED, Model, find_model, load_model
from cello3d_ros.errors import Cello3dError

_MOST_ROWS = 20  # of a table of recordings


class Kind(NamedTuple):
    """One kind of file: which paths are of it, and what is known of one, as nested mappings."""

    name: str
    matches: Callable[[Path], bool]
    describe: Callable[[Path, argparse.Namespace], dict[str, Any]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("path", metavar="SOURCE", type=Path, help="model, recording or dataset")
    add_source_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> None:
    """Print the description of a file.  Raises Cello3dError if it is of no known kind."""
    description = describe(arguments.path, arguments)
    if arguments.json:
        print(json.dumps(description, indent=2))
    else:
        print("\n".join(table(abridged(description))))


def describe(path: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what is known of a file, in the form that JSON prints; ``kind`` says what it is."""
    if str(path) in SHIPPED and not path.exists():
        path = find_model(path)
    if not path.exists():
        raise Cello3dError(f"{path}: no such file or folder")
    for kind in KINDS:
        if kind.matches(path):
            return {"kind": kind.name, "path": str(path), **kind.describe(path, arguments)}
    names = " or ".join(kind.name for kind in KINDS)
    raise Cello3dError(f"{path} is not a {names}")


def abridged(description: dict[str, Any]) -> dict[str, Any]:
    """Return the description with counts in place of the long lists that a model keeps."""
    provenance = dict(description.get("provenance", {}))
    for name, found in provenance.items():
        if not isinstance(found, dict) or len(found) <= _MOST_ROWS:
            continue
        counts = [n for n in found.values() if isinstance(n, int)]
        of = f"{sum(counts)} pairs of " if len(counts) == len(found) else "of "
        provenance[name] = f"{of}{len(found)} recordings (--json lists them)"
    return {**description, "provenance": provenance} if provenance else description


def table(description: dict[str, Any]) -> Iterator[str]:
    """Yield lines: a heading for each nested mapping, names and values in two columns."""
    plain = {key: value for key, value in description.items() if not _nested(value)}
    yield from _rows(plain, "")
    for heading, values in description.items():
        if _nested(values):
            yield ""
            yield heading
            yield from _rows(values, "  ")


def _rows(values: dict[str, Any], indent: str) -> Iterator[str]:
    width = max((len(key) for key in values if not _nested(values[key])), default=0)
    for key, value in values.items():
        if _nested(value):
            yield f"{indent}{key}"
            yield from _rows(value, indent + "  ")
        else:
            yield f"{indent}{key:{width}}  {_text(value)}".rstrip()


def _nested(value: object) -> bool:
    return isinstance(value, dict) and bool(value)


def _text(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return json.dumps(value) if isinstance(value, (bool, dict)) else str(value)


def _describe_model(path: Path, _: argparse.Namespace) -> dict[str, Any]:
    model = load_model(path)
    config = config_to(model.pipeline)
    return {
        "format_version": FORMAT_VERSION,
        "size_bytes": path.stat().st_size,
        "n_examples": model.n_examples,
        "n_features": model.n_features,
        "rank": len(model.theta),
        "relative_to": model.shape,
        "looks_at": model.features,
        "mean_weight": model.mean_weight,
        "margin": model.margin,
        "pipeline_name": pipeline_name(model.pipeline),
        "prior_variance": model.sampling.variance,
        **_mean_sigmas(model),
        **_lost(model),
        "bias_share": model.bias.share,
        "bias_way_m": model.bias.way_m,
        "provenance": model.provenance,
        "pipeline": {name: config[name] for name in PIPELINE},
        "sampling": _settings(model.sampling),
    }


def _mean_sigmas(model: Model) -> dict[str, Any]:
    """Return standard deviations of the mean covariance, in the units they have."""
    sigmas = [float(value) for value in np.sqrt(np.diag(model.mean_covariance))]
    if model.shape != "none":
        return {"mean_sigmas_relative": sigmas}
    return {"mean_sigmas_m": sigmas[:3], "mean_sigmas_rad": sigmas[3:]}


def _lost(model: Model) -> dict[str, Any]:
    """Return beyond which sandwich a registration is lost, and how far such ones scatter."""
    if model.lost is None:
        return {"lost": None}
    sigmas = [float(value) for value in np.sqrt(np.diag(model.lost.covariance))]
    return {
        "lost_beyond_sandwich_m": model.lost.limit_m,
        "lost_sigmas_m": sigmas[:3],
        "lost_sigmas_rad": sigmas[3:],
    }


def _settings(section: Any) -> dict[str, Any]:
    return {key: list(v) if isinstance(v, tuple) else v for key, v in vars(section).items()}


def _describe_dataset(path: Path, _: argparse.Namespace) -> dict[str, Any]:
    from cello3d_ros.learning.dataset import open_dataset

    dataset = open_dataset(path)
    keys = dataset.pair_keys()
    outcomes = Counter(dataset.read(*key).reason or "accepted" for key in keys)
    pairs = Counter(name for name, *_ in keys)
    return {
        "n_pairs": len(keys),
        "outcomes": dict(sorted(outcomes.items())),
        "recordings": {
            name: f"{pairs[name]} pairs of {facts.get('n_scans', 'unknown')} scans"
            for name, facts in dataset.recordings.items()
        },
        "sampling": _settings(dataset.sampling),
    }


KINDS = (
    Kind("model file (.npz)", lambda path: path.suffix == ".npz", _describe_model),
    Kind("dataset", lambda path: (path / "manifest.json").is_file(), _describe_dataset),
    Kind("recording", is_recording, describe_recording),
)
