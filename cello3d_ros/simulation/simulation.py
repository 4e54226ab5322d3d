"""Simulated recordings: a scanner carried through a world, with ground truth and odometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.odometry import drift_odometry
from cello3d_ros.recordings.poses import check_order, read_tum
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.recordings.tables import read_bytes
from cello3d_ros.simulation.paths import walk
from cello3d_ros.simulation.scanner import SCANNERS, Scanner, cast, measure, raycasting_scene
from cello3d_ros.simulation.worlds import World, build_world

FIRST_STAMP_NS = 1_600_000_000_000_000_000
STEP_NS = 500_000_000


@dataclass(frozen=True)
class Simulation:
    """A recording that is computed while it is read; all of it follows from the first five.

    world: the name of a world, or a YAML file with one.  path: a TUM file with the poses of the
    sensor and their stamps, instead of a walk along the world's route with a scan each 0.5 s.
    title: what it is called instead of by world and seed.

    A scan depends on the seed and on its own number only: a longer simulation starts with the
    scans of a shorter one.
    """

    world: str
    seed: int
    n_scans: int
    scanner: Scanner = SCANNERS["spinning32"]
    path: Path | None = None
    title: str = ""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise RecordingError(f"the seed of a simulation must not be negative: {self.seed}")
        if self.n_scans < 1:
            raise RecordingError(f"a simulation needs at least one scan, not {self.n_scans}")

    @property
    def name(self) -> str:
        """World and seed, if it has no title."""
        return self.title or f"{Path(self.world).stem}-{self.seed}"

    @property
    def n_projected(self) -> int:
        """0: poses are exact."""
        return 0

    @property
    def has_odometry(self) -> bool:
        """True: it drifts from the exact poses."""
        return True

    def __len__(self) -> int:
        return self.n_scans

    def __iter__(self) -> Iterator[Scan]:
        world, truth, odometry = self.build()
        scene, stamps = raycasting_scene(world.mesh), self.stamps_ns()
        for k in range(self.n_scans):
            echoes = cast(scene, self.scanner, truth[k])
            yield Scan(
                stamp_ns=stamps[k],
                points=measure(echoes, np.random.default_rng([self.seed, k])),
                T_world_sensor=truth[k],
                T_odom_sensor=odometry[k],
                echoes=echoes,
            )

    def track(self) -> PoseTrack:
        """Return the odometry at the stamps."""
        return PoseTrack.of_poses(self.stamps_ns(), self.build()[2])

    def stamps_ns(self) -> list[int]:
        """Return the stamps of the scans."""
        if self.path is not None:
            return read_path(self.path, self.n_scans)[0]
        return [FIRST_STAMP_NS + k * STEP_NS for k in range(self.n_scans)]

    def build(self) -> tuple[World, Array, Array]:
        """Return the world, and T_world_sensor and T_odom_sensor, both (n_scans, 4, 4)."""
        layout, way, drift = np.random.default_rng(self.seed).spawn(3)
        world = build_world(self.world, layout)
        if self.path is not None:
            truth = read_path(self.path, self.n_scans)[1]
        else:
            truth = walk(world.route, self.n_scans, way.uniform(0.9, 1.5), way)
        return world, truth, drift_odometry(truth, drift)


def read_path(path: Path, n_scans: int) -> tuple[list[int], Array]:
    """Return the first stamps and poses (n_scans, 4, 4) of a TUM file.  Raises RecordingError."""
    found = read_tum(read_bytes(path), path)
    if len(found.stamps_ns) < n_scans:
        raise RecordingError(f"{path}: has {len(found.stamps_ns)} poses for {n_scans} scans")
    rows = found.rows[:n_scans]
    return check_order(found.stamps_ns, path)[:n_scans], se3.pose(rows[:, :3], rows[:, 3:])


def simulate(
    world: str, seed: int, n_scans: int, scanner: Scanner = SCANNERS["spinning32"]
) -> Iterator[Scan]:
    """Yield the scans of a simulated world, 0.5 s apart; the same arguments give the same bits."""
    return iter(Simulation(world, seed, n_scans, scanner))
