"""A pose graph of a recording: measured poses between scans, with their covariances."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.covariance.case import DEFAULTS
from cello3d_ros.covariance.estimator import (
    Estimate,
    Estimator,
    Trust,
    draws,
    registered_elsewhere,
)
from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.geometry.gaussian import bounded
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.recordings.odometry import Drift
from cello3d_ros.recordings.recording import Recording, Scan

Pairs = Mapping[tuple[int, int], Array | None]  # (i, j): T_ij to start at, None for the poses'


class Edge(NamedTuple):
    """A measured pose of scan j in scan i.

    kind: registration, loop or odometry.  T: (4, 4), ``p_i = T p_j``.  Y: (6, 6), of xi in
    ``T exp(xi)``, translation first.  trust: of a registration; None of odometry.
    """

    i: int
    j: int
    kind: str
    T: Array
    Y: Array
    trust: Trust | None = None


@dataclass
class Graph:
    """Scans, by their numbers in the recording, and the edges between them.

    stamps_ns, poses: of each scan with a pose, (4, 4) in one frame: what registrations start from.
    failures: how many scans have no pose and how many pairs no edge, by reason.
    """

    stamps_ns: dict[int, int] = field(default_factory=dict)
    poses: dict[int, Array] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)

    @property
    def n_parts(self) -> int:
        """Into how many parts it falls that no edge connects."""
        row = {k: n for n, k in enumerate(self.poses)}
        ends = np.array([(row[e.i], row[e.j]) for e in self.edges], dtype=int).reshape(-1, 2)
        links = coo_array((np.ones(len(ends)), ends.T), shape=(len(row), len(row)))
        return int(connected_components(links, directed=False)[0])


@dataclass(frozen=True, kw_only=True)
class GraphSettings:
    """What edges a graph has.

    max_gap: each scan is registered to so many before it.  loops: pairs of scans far apart in
    time.  registers: whether ICP runs; else the poses are taken as registrations and get
    covariances.  starts_at_odometry: else at the recorded poses.  drift: of the odometry, whose
    steps become edges; None for no such edges.  seed: of the random subsamples.
    """

    max_gap: int = 1
    loops: Pairs = field(default_factory=dict)
    registers: bool = True
    starts_at_odometry: bool = True
    drift: Drift | None = None
    seed: int = 0


class _Node(NamedTuple):
    """A scan that waits for its partners.  cloud: None where too little of it is left."""

    T: Array
    T_odom: Array | None
    cloud: Cloud | None
    rng: np.random.Generator


def build_graph(
    recording: Recording,
    estimator: Estimator,
    settings: GraphSettings | None = None,
    scans: Iterable[Scan] | None = None,
) -> Graph:
    """Register each scan to those before it, and give every pose a covariance.

    scans: those of the recording, when something is to see them pass.
    Scans without a pose are left out and counted, as are pairs without an answer.  Memory holds
    max_gap scans and those of loops.  Raises RecordingError where no scan has a pose, no pair an
    answer, a loop names a scan that is not there, or odometry is asked for and there is none.
    """
    settings = settings or GraphSettings()
    _check(recording, settings)
    graph, waiting = Graph(), dict[int, _Node]()
    pairs, last = _pairs(len(recording), settings)
    for n, scan in enumerate(recording if scans is None else scans):
        if (T := _start(scan, settings.starts_at_odometry)) is None:
            graph.failures["no_pose"] += 1
            continue
        graph.stamps_ns[n], graph.poses[n] = scan.stamp_ns, T
        waiting[n] = _node(scan, T, estimator, settings.seed, graph.failures)
        if settings.drift is not None and n - 1 in waiting:
            graph.edges += _odometry_edges(n, waiting, settings.drift)
        for i, j in pairs[n]:
            if i in waiting and j in waiting:
                graph.edges += _edges(i, j, waiting, estimator, settings, graph.failures)
        for k in [k for k in waiting if last[k] <= n]:
            del waiting[k]
    if not graph.poses:
        raise RecordingError(
            f"{recording.name} has no poses to start from; name them, or find them (--poses joint)"
        )
    if not any(edge.kind != "odometry" for edge in graph.edges):
        reasons = ", ".join(f"{n} {k.replace('_', ' ')}" for k, n in graph.failures.items())
        raise RecordingError(
            f"no pair of {recording.name} has an answer: {reasons or 'there is only one scan'}"
        )
    return graph


def _check(recording: Recording, settings: GraphSettings) -> None:
    n = len(recording)
    for i, j in settings.loops:
        if i == j or not (0 <= i < n and 0 <= j < n):
            raise RecordingError(
                f"{recording.name} has scans 0 to {n - 1}: there is no loop from {i} to {j}"
            )
    if settings.drift is not None and not recording.has_odometry:
        raise RecordingError(f"{recording.name} has no odometry to make edges of")


def _start(scan: Scan, starts_at_odometry: bool) -> Array | None:
    if starts_at_odometry and scan.T_odom_sensor is not None:
        return scan.T_odom_sensor
    return scan.T_world_sensor


def _node(scan: Scan, T: Array, estimator: Estimator, seed: int, failures: Counter[str]) -> _Node:
    rng, cloud = draws(scan.points, seed), None
    try:
        cloud = prepare(scan.points, estimator.pipeline.cloud, rng, estimator.settings.n_threads)
    except Cello3dError as error:
        failures[error.reason] += 1
    return _Node(T, scan.T_odom_sensor, cloud, rng)


def _pairs(n: int, settings: GraphSettings) -> tuple[list[list[tuple[int, int]]], list[int]]:
    """Return for each of n scans the pairs (i, j) that it completes, and its last partner.

    A loop that is near counts once.
    """
    pairs = [[(i, j) for i in range(max(0, j - settings.max_gap), j)] for j in range(n)]
    last = [k + settings.max_gap for k in range(n)]
    for i, j in settings.loops:
        if abs(i - j) > settings.max_gap:
            pairs[max(i, j)].append((i, j))
            last[min(i, j)] = max(last[min(i, j)], i, j)
    return pairs, last


def _odometry_edges(n: int, nodes: Mapping[int, _Node], drift: Drift) -> Iterator[Edge]:
    """Yield the step of the odometry to scan n, where both ends have one."""
    before, after = nodes[n - 1].T_odom, nodes[n].T_odom
    if before is not None and after is not None:
        step = inverse(before) @ after
        floors = DEFAULTS.floor_sigma_m, DEFAULTS.floor_sigma_rad
        Y = bounded(np.diag(drift.sigma(step) ** 2), *floors, DEFAULTS.ceiling)
        yield Edge(n - 1, n, "odometry", step, Y)


def _edges(
    i: int,
    j: int,
    nodes: Mapping[int, _Node],
    estimator: Estimator,
    settings: GraphSettings,
    failures: Counter[str],
) -> Iterator[Edge]:
    """Yield the registration of scan j to scan i, or count why there is none."""
    T = settings.loops.get((i, j))
    if T is None:
        T = inverse(nodes[i].T) @ nodes[j].T
    reference, reading = nodes[i].cloud, nodes[j].cloud
    if reference is None or reading is None:
        return
    try:
        found = _estimate(estimator, reading, reference, T, settings, nodes[j].rng)
    except Cello3dError as error:
        failures[error.reason] += 1
        return
    kind = "registration" if 0 < j - i <= settings.max_gap else "loop"
    yield Edge(i, j, kind, found.T_ref_read, found.covariance, found.trust)


def _estimate(
    estimator: Estimator,
    reading: Cloud,
    reference: Cloud,
    T: Array,
    settings: GraphSettings,
    rng: np.random.Generator,
) -> Estimate:
    """Return what the estimator says of the two scans when it is called with them and the seed."""
    T, rng = np.ascontiguousarray(T), deepcopy(rng)
    if settings.registers:
        return estimator.register(reading, reference, T, rng)
    return estimator.judge(reading, reference, registered_elsewhere(T), rng)
