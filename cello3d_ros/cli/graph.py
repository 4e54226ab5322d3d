"""``cello3d graph RECORDING --out GRAPH.g2o``: registrations with covariances for a solver."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from cello3d_ros.cli.sources import add_source_arguments, open_source
from cello3d_ros.errors import RecordingError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="bag or data set")
    parser.add_argument(
        "--out", metavar="GRAPH", type=Path, required=True, help=".g2o, .json (GTSAM) or .csv"
    )
    parser.add_argument(
        "--model", metavar="M", default="", help="model file or name of a shipped one (general)"
    )
    add_source_arguments(parser)
    parser.add_argument(
        "--max-gap", type=int, default=1, metavar="G", help="scans before a scan to register to"
    )
    parser.add_argument(
        "--registration",
        choices=("icp", "external"),
        default="icp",
        help="icp, started at the poses; or external: the poses are registrations already",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random subsamples")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="threads"
    )


def run(arguments: argparse.Namespace) -> None:
    """Register, write the graph and say what it holds."""
    from tqdm import tqdm

    from cello3d_ros.cli.align import posed
    from cello3d_ros.covariance.case import DEFAULTS
    from cello3d_ros.covariance.estimator import Estimator
    from cello3d_ros.evaluation.graph import WRITERS, build_graph, write_graph

    out = arguments.out
    if out.suffix not in WRITERS:
        raise RecordingError(f"{out}: a graph is written as {', '.join(WRITERS)}")
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise RecordingError(f"cannot write {out}: not a file in an existing folder")
    if arguments.max_gap < 1:
        raise RecordingError(f"--max-gap must be at least 1: {arguments.max_gap}")
    poses, arguments.poses = arguments.poses, None
    recording = posed(open_source(arguments.recording, arguments), poses, arguments.jobs)
    estimator = Estimator(
        arguments.model or "general", settings=DEFAULTS._replace(n_threads=arguments.jobs)
    )
    with tqdm(
        total=len(recording), unit="scan", disable=not sys.stderr.isatty(), leave=False
    ) as bar:
        graph = build_graph(
            recording,
            estimator,
            arguments.max_gap,
            arguments.registration == "icp",
            arguments.seed,
            bar.update,
        )
    write_graph(graph, out)
    n_unknown = sum(edge.estimate.is_unknown for edge in graph.edges)
    n_lost = sum(edge.estimate.is_lost for edge in graph.edges)
    failed = "".join(f"; {n} {reason.replace('_', ' ')}" for reason, n in graph.failures.items())
    print(
        f"{out}: {len(graph.poses)} poses, {len(graph.edges)} edges, of which {n_unknown} are "
        f"unlike the training data and {n_lost} probably lost{failed}"
    )
