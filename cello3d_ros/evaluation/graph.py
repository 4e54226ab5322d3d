"""A pose graph of a recording: registrations with their covariances, and files for solvers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cello3d_ros.atomic import new_file
from cello3d_ros.clouds.shape import prepare
from cello3d_ros.covariance.estimator import Estimate, Estimator, draws, registered_elsewhere
from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.geometry.gaussian import symmetrized
from cello3d_ros.geometry.se3 import Array, inverse, quaternion
from cello3d_ros.recordings.recording import Recording, Scan


class Edge(NamedTuple):
    """A registration: scan j is the reading, scan i the reference."""

    i: int
    j: int
    estimate: Estimate


@dataclass
class Graph:
    """Poses of scans and the registrations between them.

    stamps_ns: n; poses: n of (4, 4), in one frame: what registrations started from.
    failures: how many pairs have no edge, by reason.
    """

    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)


def build_graph(
    recording: Recording,
    estimator: Estimator,
    max_gap: int = 1,
    registers: bool = True,
    seed: int = 0,
    progress: Callable[[int], None] = lambda n: None,
) -> Graph:
    """Register each scan to the ``max_gap`` before it; the first guesses are the poses of scans.

    Poses are those of odometry, else the recorded ones; scans without are left out and counted.
    registers: whether ICP runs; else the poses are taken as registrations and get covariances.
    Raises RecordingError where no scan has a pose or no pair an answer.
    """
    graph, window = Graph(), dict[int, tuple[Scan, Array]]()
    n = 0
    for scan in recording:
        progress(1)
        T = scan.T_odom_sensor if scan.T_odom_sensor is not None else scan.T_world_sensor
        if T is None:
            graph.failures["no_pose"] += 1
            continue
        graph.stamps_ns.append(scan.stamp_ns)
        graph.poses.append(T)
        window[n] = scan, T
        window.pop(n - max_gap - 1, None)
        for i in range(max(0, n - max_gap), n):
            try:
                found = _estimate(estimator, window[i], window[n], registers, seed)
            except Cello3dError as error:
                graph.failures[error.reason] += 1
                continue
            graph.edges.append(Edge(i, n, found))
        n += 1
    if not graph.poses:
        raise RecordingError(
            f"{recording.name} has no poses to start from; name them, or find them (--poses joint)"
        )
    if not graph.edges:
        raise RecordingError(f"no pair of {recording.name} has an answer: {dict(graph.failures)}")
    return graph


def _estimate(
    estimator: Estimator,
    reference: tuple[Scan, Array],
    reading: tuple[Scan, Array],
    registers: bool,
    seed: int,
) -> Estimate:
    (ref, T_ref), (read, T_read) = reference, reading
    T = np.ascontiguousarray(inverse(T_ref) @ T_read)
    if registers:
        return estimator(read.points, ref.points, T, seed)
    config = estimator.pipeline.cloud
    P, Q = (prepare(s.points, config, draws(s.points, seed)) for s in (read, ref))
    return estimator.judge(P, Q, registered_elsewhere(T), draws(read.points, seed))


def write_graph(graph: Graph, path: Path) -> None:
    """Write a graph as its file's ending says: .g2o, .json or .csv.  Raises RecordingError."""
    if path.suffix not in WRITERS:
        raise RecordingError(f"{path}: a graph is written as {', '.join(WRITERS)}")
    with new_file(path) as partial:
        partial.write_text("".join(WRITERS[path.suffix](graph)), encoding="utf-8")


def _g2o(graph: Graph) -> Iterator[str]:
    """Yield VERTEX_SE3:QUAT and EDGE_SE3:QUAT.

    g2o's error of an edge is ``T_ij^-1 T_i^-1 T_j``, its translation and the vector part of its
    quaternion, half of the rotation vector: the information of rotations is four times that of
    rotation vectors.
    """
    half = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    for k, T in enumerate(graph.poses):
        yield f"VERTEX_SE3:QUAT {k} {_numbers(_pose(T))}\n"
    for i, j, estimate in graph.edges:
        information = symmetrized(np.linalg.inv(half @ estimate.covariance @ half))
        upper = information[np.triu_indices(6)]
        yield f"EDGE_SE3:QUAT {i} {j} {_numbers([*_pose(estimate.T_ref_read), *upper])}\n"


def _json(graph: Graph) -> Iterator[str]:
    """Yield JSON with the covariances of GTSAM: rotation first, on the side of the reading."""
    edges = [
        {
            "i": i,
            "j": j,
            "T": estimate.T_ref_read.ravel().tolist(),
            "covariance_gtsam": estimate.covariance_gtsam().ravel().tolist(),
            "overlap": estimate.trust.overlap,
            "novelty": estimate.trust.novelty,
            "is_unknown": bool(estimate.is_unknown),
            "is_lost": bool(estimate.is_lost),
        }
        for i, j, estimate in graph.edges
    ]
    vertices = [
        {"stamp_ns": stamp_ns, "T": T.ravel().tolist()}
        for stamp_ns, T in zip(graph.stamps_ns, graph.poses, strict=True)
    ]
    yield json.dumps({"vertices": vertices, "edges": edges}, indent=1) + "\n"


def _csv(graph: Graph) -> Iterator[str]:
    """Yield a row an edge: pose of j in i, covariance (u, omega) on the side of j, row by row."""
    cells = [f"c{row}{column}" for row in range(6) for column in range(6)]
    heading = ["i", "j", "stamp_i_ns", "stamp_j_ns", *"xyz", "qx", "qy", "qz", "qw", *cells]
    yield ",".join([*heading, "overlap", "novelty", "is_unknown", "is_lost"]) + "\n"
    for i, j, estimate in graph.edges:
        numbers = [*_pose(estimate.T_ref_read), *estimate.covariance.ravel()]
        trust = estimate.trust
        row = [
            *(i, j, graph.stamps_ns[i], graph.stamps_ns[j]),
            *(repr(float(number)) for number in numbers),
            *(repr(float(trust.overlap)), repr(float(trust.novelty))),
            *(int(trust.is_unknown), int(trust.is_lost)),
        ]
        yield ",".join(map(str, row)) + "\n"


def _pose(T: Array) -> list[float]:
    return [*T[:3, 3], *quaternion(T)]


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


WRITERS: dict[str, Callable[[Graph], Iterator[str]]] = {
    ".g2o": _g2o,
    ".json": _json,
    ".csv": _csv,
}
