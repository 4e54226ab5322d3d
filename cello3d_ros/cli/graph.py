"""``cello3d graph RECORDING --out GRAPH.g2o``: registrations with covariances for a solver."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.atomic import check_outputs
from cello3d_ros.cli.arguments import (
    add_jobs_argument,
    add_pipeline_argument,
    add_seed_argument,
    positive,
)
from cello3d_ros.cli.sources import add_source_arguments, open_source, with_progress
from cello3d_ros.errors import RecordingError, counted

if TYPE_CHECKING:
    from cello3d_ros.evaluation.graph import Graph, GraphSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="bag or data set")
    parser.add_argument(
        "--out",
        metavar="GRAPH",
        type=Path,
        required=True,
        action="append",
        help="file to write, by its ending: .g2o, .json (GTSAM), .csv, or of the poses alone .tum "
        "or .txt (KITTI); may be given several times",
    )
    parser.add_argument(
        "--model", metavar="M", default="", help="model file or name of a shipped one (general)"
    )
    add_pipeline_argument(parser, "the model's")
    add_source_arguments(parser)
    parser.add_argument(
        "--max-gap",
        type=positive,
        default=1,
        metavar="G",
        help="scans before a scan to register to",
    )
    parser.add_argument(
        "--loops",
        type=Path,
        metavar="FILE",
        help="loop closures to register: rows of i j, or of i j x y z qx qy qz qw",
    )
    parser.add_argument(
        "--odometry-drift",
        nargs=3,
        type=float,
        metavar=("SHARE", "DEG_PER_M", "TURN_SHARE"),
        help="make edges of the odometry, which errs by a share of each step's length, by degrees "
        "a metre and by a share of each turn (1 sigma)",
    )
    parser.add_argument(
        "--scale",
        type=float,
        default=1.0,
        metavar="S",
        help="factor on the covariances of registrations, which are not independent where they "
        "share a scan (docs/fusion.md)",
    )
    parser.add_argument(
        "--registration",
        choices=("icp", "external"),
        default="icp",
        help="icp, started at the poses; or external: the poses are registrations already",
    )
    add_seed_argument(parser)
    add_jobs_argument(parser)


def run(arguments: argparse.Namespace) -> None:
    """Register, write the graph and say what it holds."""
    from cello3d_ros.cli.align import posed
    from cello3d_ros.config import PIPELINES
    from cello3d_ros.covariance.case import DEFAULTS
    from cello3d_ros.covariance.estimator import Estimator
    from cello3d_ros.evaluation.graph import build_graph
    from cello3d_ros.evaluation.graph_files import check_graph_file, write_graph

    for out in arguments.out:
        check_graph_file(out)
    check_outputs(arguments.out, [arguments.recording, arguments.poses, arguments.loops])
    settings = _settings(arguments)
    poses, arguments.poses = arguments.poses, None
    source = open_source(arguments.recording, arguments)
    recording = posed(source, poses, arguments.jobs, keeps_odometry=settings.drift is not None)
    estimator = Estimator(
        arguments.model or "general",
        settings=DEFAULTS._replace(n_threads=arguments.jobs, scale=arguments.scale),
        pipeline=PIPELINES.get(arguments.pipeline),
    )
    scans = with_progress(recording, len(recording), recording.name)
    graph = build_graph(recording, estimator, settings, scans)
    for out in arguments.out:
        write_graph(graph, out)
    print(f"{', '.join(map(str, arguments.out))}: {_sentence(graph)}")


def _settings(arguments: argparse.Namespace) -> GraphSettings:
    """Return what edges are asked for.  Raises RecordingError."""
    import numpy as np

    from cello3d_ros.evaluation.graph import GraphSettings
    from cello3d_ros.evaluation.graph_files import read_loops
    from cello3d_ros.recordings.odometry import Drift

    if not 1e-6 <= arguments.scale <= 1e6:
        raise RecordingError(f"--scale must be in [1e-6, 1e6]: {arguments.scale}")
    drift = None
    if arguments.odometry_drift is not None:
        share, deg_per_m, turn_share = arguments.odometry_drift
        drift = Drift(share, float(np.radians(deg_per_m)), turn_share)
        if not all(0.0 <= value <= 100.0 for value in drift):
            raise RecordingError("--odometry-drift needs three numbers from 0 to 100")
        if str(arguments.poses) == "joint":
            raise RecordingError(
                "--odometry-drift needs odometry, and --poses joint leaves it out"
            )
    return GraphSettings(
        max_gap=arguments.max_gap,
        loops={} if arguments.loops is None else read_loops(arguments.loops),
        registers=arguments.registration == "icp",
        starts_at_odometry=arguments.poses is None,
        drift=drift,
        seed=arguments.seed,
    )


def _sentence(graph: Graph) -> str:
    kinds = [edge.kind for edge in graph.edges]
    trusts = [edge.trust for edge in graph.edges if edge.trust is not None]
    text = f"{counted(len(graph.poses), 'pose')}, {counted(len(trusts), 'registration')}"
    if n := kinds.count("loop"):
        text += f" ({n} of loops)"
    text += f", of which {sum(t.is_unknown for t in trusts)} are unlike the training data and "
    text += f"{sum(t.is_lost for t in trusts)} probably lost"
    if n := kinds.count("odometry"):
        text += f"; {n} steps of odometry"
    text += "".join(f"; {n} {reason.replace('_', ' ')}" for reason, n in graph.failures.items())
    if graph.n_parts > 1:
        text += f"; it falls into {graph.n_parts} parts that no edge connects: solve each alone"
    return text
