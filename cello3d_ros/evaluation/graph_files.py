"""Files of pose graphs, as g2o, GTSAM, evo and tables read them, and files of loops."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from cello3d_ros.atomic import check_outputs, new_file
from cello3d_ros.errors import RecordingError
from cello3d_ros.evaluation.graph import Graph, Pairs
from cello3d_ros.geometry.gaussian import rotation_first, symmetrized
from cello3d_ros.geometry.se3 import Array, pose, quaternion
from cello3d_ros.recordings.poses import kitti_line, tum_line
from cello3d_ros.recordings.tables import numbers, read_bytes


def read_loops(path: Path) -> Pairs:
    """Return the pairs of scans in a file of rows ``i j`` or ``i j x y z qx qy qz qw``.

    Scans count from 0; the pose is that of j in i, where its registration starts.  Raises
    RecordingError.
    """
    data = read_bytes(path)
    words = (line.split(b"#")[0].split() for line in data.splitlines())
    n_columns = len(next((row for row in words if row), []))
    if n_columns not in (2, 9):
        raise RecordingError(f"{path}: expected rows of i j, or of i j x y z qx qy qz qw")
    rows = numbers(data, n_columns, path)
    loops: dict[tuple[int, int], Array | None] = {}
    for k, row in enumerate(rows, start=1):
        if not np.isfinite(row).all() or (row[:2] % 1).any():
            raise RecordingError(f"{path}: row {k} has no whole numbers of two scans")
        if n_columns == 9 and abs(np.linalg.norm(row[5:]) - 1.0) > 1e-3:
            raise RecordingError(f"{path}: row {k} has no unit quaternion")
        T = pose(row[2:5], row[5:]) if n_columns == 9 else None
        loops[int(row[0]), int(row[1])] = T
    return loops


def check_graph_file(path: Path) -> None:
    """Raise RecordingError or WriteError where a graph cannot be written to a path."""
    if path.suffix not in WRITERS:
        raise RecordingError(f"{path}: a graph is written as {', '.join(WRITERS)}")
    check_outputs([path])


def write_graph(graph: Graph, path: Path) -> None:
    """Write a graph as its file's ending says.  Raises RecordingError, WriteError."""
    check_graph_file(path)
    with new_file(path) as partial:
        partial.write_text("".join(WRITERS[path.suffix](graph)), encoding="utf-8")


def _g2o(graph: Graph) -> Iterator[str]:
    """Yield VERTEX_SE3:QUAT and EDGE_SE3:QUAT.

    g2o's error of an edge is ``T_ij^-1 T_i^-1 T_j``, its translation and the vector part of its
    quaternion, half of the rotation vector: the information of rotations is four times that of
    rotation vectors.
    """
    half = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    for k, T in graph.poses.items():
        yield f"VERTEX_SE3:QUAT {k} {_words(_pose(T))}\n"
    for edge in graph.edges:
        upper = symmetrized(np.linalg.inv(half @ edge.Y @ half))[np.triu_indices(6)]
        yield f"EDGE_SE3:QUAT {edge.i} {edge.j} {_words([*_pose(edge.T), *upper])}\n"


def _json(graph: Graph) -> Iterator[str]:
    """Yield JSON with the covariances of GTSAM: rotation first, on the side of the reading."""
    vertices = [
        {"id": k, "stamp_ns": graph.stamps_ns[k], "T": T.ravel().tolist()}
        for k, T in graph.poses.items()
    ]
    edges = [
        {
            "i": edge.i,
            "j": edge.j,
            "kind": edge.kind,
            "T": edge.T.ravel().tolist(),
            "covariance_gtsam": rotation_first(edge.Y).ravel().tolist(),
            "trust": None if edge.trust is None else edge.trust._asdict(),
        }
        for edge in graph.edges
    ]
    yield json.dumps({"vertices": vertices, "edges": edges}, indent=1) + "\n"


def _csv(graph: Graph) -> Iterator[str]:
    """Yield a row an edge: pose of j in i, covariance (u, omega) on the side of j, row by row.

    Odometry has no trust: its cells are empty.
    """
    cells = [f"c{row}{column}" for row in range(6) for column in range(6)]
    heading = ["i", "j", "stamp_i_ns", "stamp_j_ns", "kind", *"xyz", "qx", "qy", "qz", "qw"]
    yield ",".join([*heading, *cells, "overlap", "novelty", "is_unknown", "is_lost"]) + "\n"
    for edge in graph.edges:
        i, j, trust = edge.i, edge.j, edge.trust
        measured = _words([*_pose(edge.T), *edge.Y.ravel()], ",")
        known = ["", "", "", ""]
        if trust is not None:
            known = [_words([trust.overlap]), _words([trust.novelty])]
            known += [str(int(trust.is_unknown)), str(int(trust.is_lost))]
        row = [i, j, graph.stamps_ns[i], graph.stamps_ns[j], edge.kind, measured, *known]
        yield ",".join(map(str, row)) + "\n"


def _tum(graph: Graph) -> Iterator[str]:
    """Yield the poses of scans, a row of stamp, position and quaternion each."""
    return (tum_line(graph.stamps_ns[k], T) for k, T in graph.poses.items())


def _kitti(graph: Graph) -> Iterator[str]:
    """Yield the poses of scans, a 3x4 matrix each.

    Raises RecordingError where a scan has none, because rows tell scans by their order.
    """
    if graph.failures["no_pose"]:
        raise RecordingError(
            f"KITTI's poses are a row a scan, and {graph.failures['no_pose']} have no pose: "
            "write .tum"
        )
    return (kitti_line(T) for T in graph.poses.values())


def _pose(T: Array) -> list[float]:
    return [*T[:3, 3], *quaternion(T)]


def _words(values: Sequence[float], separator: str = " ") -> str:
    return separator.join(repr(float(value)) for value in values)


WRITERS: dict[str, Callable[[Graph], Iterator[str]]] = {
    ".g2o": _g2o,
    ".json": _json,
    ".csv": _csv,
    ".tum": _tum,
    ".txt": _kitti,
}
