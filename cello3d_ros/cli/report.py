"""``cello3d report EVALUATION.json --out report.html``: one page to look at, without a network."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cello3d_ros.atomic import check_outputs, new_file
from cello3d_ros.errors import RecordingError

if TYPE_CHECKING:
    from cello3d_ros.evaluation.result import ShownPair
    from cello3d_ros.geometry.se3 import Array

_MOST_POINTS = 6000  # of a cloud on the page: twelve clouds of them are 1.2 MB


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument(
        "evaluation", type=Path, metavar="EVALUATION", help="JSON that cello3d evaluate wrote"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="HTML", help="page to write, self-contained"
    )
    parser.add_argument(
        "--recordings",
        nargs="+",
        action="extend",
        default=[],
        metavar="RECORDING",
        help="bags or data sets with the clouds of the worst pairs",
    )


def run(arguments: argparse.Namespace) -> None:
    """Write the page.  Raises EvaluationError for a file that is damaged or too old."""
    from cello3d_ros.evaluation.result import read_evaluation
    from cello3d_ros.reporting.page import page

    out: Path = arguments.out
    check_outputs([out], [arguments.evaluation, *arguments.recordings])
    found = read_evaluation(arguments.evaluation)
    clouds = _clouds(found.worst_pairs, arguments.recordings)
    text = page(found, clouds)
    with new_file(out) as partial:
        partial.write_text(text, encoding="utf-8")
    print(f"{out}: {len(text.encode()) / 1e6:.1f} MB, {len(clouds)} pairs with clouds")


def _clouds(
    pairs: Sequence[ShownPair], paths: Sequence[str]
) -> dict[tuple[str, int, int], tuple[Array, Array]]:
    """Return reading and reference, thinned, of the pairs whose recordings were given."""
    from cello3d_ros.recordings import open_recording

    found = {}
    for path in paths:
        recording = open_recording(path)
        wanted = [pair for pair in pairs if pair.recording == recording.name]
        needed = {k for pair in wanted for k in (pair.i, pair.j)}
        scans: dict[int, Array] = {}
        if needed:
            for k, scan in zip(range(max(needed) + 1), recording):
                if k in needed:
                    scans[k] = _thinned(scan.points)
        if missing := sorted(needed - set(scans)):
            raise RecordingError(f"{path} has {len(recording)} scans, no scan {missing[0]}")
        for pair in wanted:
            found[pair.recording, pair.i, pair.j] = (scans[pair.j], scans[pair.i])
    return found


def _thinned(points: Array) -> Array:
    if len(points) <= _MOST_POINTS:
        return points
    kept = np.random.default_rng(0).choice(len(points), _MOST_POINTS, replace=False)
    return points[np.sort(kept)]
