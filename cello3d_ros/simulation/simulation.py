"""Simulated recordings: a scanner carried through a world, with ground truth and odometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cello3d_ros.clouds.point_times import UNITS, TimeLaw
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.odometry import Drift, drift_odometry
from cello3d_ros.recordings.poses import check_order, read_tum
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.recordings.tables import read_bytes
from cello3d_ros.simulation.casting import Surroundings, cast
from cello3d_ros.simulation.drives import Drive, body, trajectory
from cello3d_ros.simulation.paths import Course, Route, walk
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.scanner import Scanner, returns
from cello3d_ros.simulation.worlds import World, build_world

FIRST_STAMP_NS = 1_600_000_000_000_000_000
STEP_NS = 500_000_000


@dataclass(frozen=True)
class Simulation:
    """A recording that is computed while it is read; all of it follows from its fields.

    world: the name of a world, or a YAML file with one.  drive: how a robot carries the scanner
    along the world's route; None for a walk with a scan each 0.5 s, each taken at one instant.
    path: a TUM file with the poses of the sensor and their stamps, instead of a route.
    course: which way a walk takes through the world; None for one that the seed decides.
    title: what it is called instead of by world and seed.

    A scan depends on the seed and on its own number only: a longer simulation starts with the
    scans of a shorter one.  A scan that sweeps is stamped at its end, its points have times, and
    it has no echoes, as it cannot be scanned anew without the motion.
    """

    world: str
    seed: int
    n_scans: int
    scanner: Scanner = SCANNERS["spinning32"]
    path: Path | None = None
    title: str = ""
    drive: Drive | None = None
    course: Course | None = None

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise RecordingError(f"the seed of a simulation must not be negative: {self.seed}")
        if self.n_scans < 1:
            raise RecordingError(f"a simulation needs at least one scan, not {self.n_scans}")
        if self.path is not None and self.drive is not None:
            raise RecordingError("a simulation follows a path or a drive, not both")

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

    @property
    def n_declared(self) -> int:
        """How many scans there are."""
        return self.n_scans

    @property
    def skipped(self) -> dict[str, int]:
        """Nothing."""
        return {}

    @property
    def times(self) -> str:
        """That of a scan that sweeps; "" where points have no times."""
        sweeps = self.drive is not None and self.drive.sweeps
        return TimeLaw(UNITS["s"]).sentence if sweeps else ""

    def __len__(self) -> int:
        return self.n_scans

    def __iter__(self) -> Iterator[Scan]:
        built = self._build()
        world, stamps = built.world, self.stamps_ns()
        own = body(self.drive) if self.drive is not None and self.drive.body else None
        around = Surroundings(world.mesh, world.glass, world.movers, own)
        after = self._times() if self.drive is not None and self.drive.sweeps else None
        for k, (stamp_ns, T) in enumerate(zip(stamps, built.truth, strict=True)):
            time_s: Any = 1e-9 * (stamp_ns - stamps[0])
            if after is None:
                echoes = cast(around, self.scanner, T, k, time_s)
            else:
                T_beams = T @ _at(built.track, stamp_ns, after)
                echoes = cast(around, self.scanner, T_beams, k, time_s + after)
            points, beams = returns(echoes, np.random.default_rng([self.seed, k]))
            yield Scan(
                stamp_ns=stamp_ns,
                points=points,
                T_world_sensor=T,
                T_odom_sensor=built.odometry[k],
                time_s=None if after is None else after[beams],
                echoes=echoes if after is None else None,
                look=partial(cast, around, self.scanner, turn=k, time_s=time_s)
                if after is None
                else None,
            )

    def track(self) -> PoseTrack:
        """Return the odometry: at the stamps, of a drive each hundredth of a second.

        What it drifts from scan to scan it drifts evenly over the time between.
        """
        built, stamps = self._build(), np.array(self.stamps_ns())
        if self.drive is None:
            return PoseTrack.of_poses(stamps, built.odometry)
        first, last = int(stamps[0]), int(stamps[-1])
        times = np.union1d(built.track.stamps_ns, stamps)
        times = times[times <= last]
        after_s = 1e-9 * (times - first)
        T_odom_world = built.odometry @ se3.inverse(built.truth)
        drifted = PoseTrack.of_poses(stamps, T_odom_world, np.inf)
        ends = float(after_s.min()), float(after_s.max())
        drift = drifted.motion(first, *ends).at(np.maximum(after_s, 0.0))
        exact = built.truth[0] @ built.track.motion(first, *ends).at(after_s)
        return PoseTrack.of_poses(times, T_odom_world[0] @ drift @ exact)

    def true_track(self) -> PoseTrack:
        """Return the exact poses: at the stamps, of a drive each hundredth of a second."""
        return self._build().track

    def stamps_ns(self) -> list[int]:
        """Return the stamps of the scans."""
        if self.path is not None:
            return read_path(self.path, self.n_scans)[0]
        step = STEP_NS if self.drive is None else 1e9 / self.drive.rate_hz
        return [FIRST_STAMP_NS + round(k * step) for k in range(self.n_scans)]

    def build(self) -> tuple[World, Array, Array]:
        """Return the world, and T_world_sensor and T_odom_sensor, both (n_scans, 4, 4)."""
        built = self._build()
        return built.world, built.truth, built.odometry

    def _times(self) -> Array:
        """Return when each beam (n,) is sent, in seconds after the stamp: none is."""
        assert self.drive is not None
        sweep = min(self.scanner.sweep_s, 1.0 / self.drive.rate_hz)
        return self.scanner.times() * (sweep / self.scanner.sweep_s) - sweep

    def _build(self) -> _Built:
        layout, way, drift = np.random.default_rng(self.seed).spawn(3)
        world, stamps = build_world(self.world, layout), self.stamps_ns()
        if self.drive is not None:
            track = _driven(world.route, self.drive, stamps, float(self._times().min()), way)
            truth = np.stack([T for s in stamps if (T := track.at(s)) is not None])
        else:
            if self.path is not None:
                truth = read_path(self.path, self.n_scans)[1]
            else:
                if self.course is not None:
                    way = np.random.default_rng([self.seed, self.course.seed])
                truth = walk(world.route, self.n_scans, way.uniform(0.9, 1.5), way, self.course)
            track = PoseTrack.of_poses(stamps, truth)
        return _Built(world, track, truth, _drifting(truth, self.drive, drift))


class _Built(NamedTuple):
    world: World
    track: PoseTrack  # exact, at least at the stamps
    truth: Array
    odometry: Array


def _driven(
    route: Route, drive: Drive, stamps: list[int], start_s: float, rng: np.random.Generator
) -> PoseTrack:
    """Return the exact poses of a drive from the start of the first sweep to the last stamp."""
    end_s = 1e-9 * (stamps[-1] - stamps[0])
    times, poses = trajectory(route, drive, start_s, end_s, rng)
    return PoseTrack.of_poses(stamps[0] + np.round(1e9 * times).astype(np.int64), poses)


def _drifting(truth: Array, drive: Drive | None, rng: np.random.Generator) -> Array:
    """Return the odometry (n, 4, 4) of a walk or of a drive."""
    if drive is None:
        return drift_odometry(truth, rng)
    share, deg_per_m = drive.odometry_share, drive.odometry_deg_per_m
    return drift_odometry(truth, rng, Drift(share, float(np.radians(deg_per_m)), share))


def _at(track: PoseTrack, stamp_ns: int, after_s: Array) -> Array:
    """Return ``T(stamp)^-1 T(stamp + after)``, computed once for times that are alike."""
    times, which = np.unique(after_s, return_inverse=True)
    return track.motion(stamp_ns, float(times[0]), float(times[-1])).at(times)[which]


def n_poses(path: Path) -> int:
    """Return how many poses a TUM file has.  Raises RecordingError."""
    return len(read_tum(read_bytes(path), path).stamps_ns)


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
