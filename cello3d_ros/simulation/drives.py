"""How a robot carries a scanner through a world: its motion, and where the scanner is mounted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cello3d_ros.errors import ConfigError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh, box, cylinder, join, painted
from cello3d_ros.simulation.paths import Route

_FACING_RAD = {"forward": 0.0, "reverse": np.pi, "sideways": np.pi / 2, "stop_and_go": 0.0}
MOTIONS = (*_FACING_RAD, "spin", "still")
_KNOT_S = 0.01
_N_WAVES = 4


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Motion of a robot and the mount of its scanner.

    motion: "forward", "reverse" or "sideways" along the route; "stop_and_go", forward at a speed
    that swings between 0 and twice the mean; "spin", turning on the spot; "still".
    rate_hz: scans a second.  speed_m_s: mean along the route.  turn_rad_s: rate of a spin; curves
    are driven more slowly where they would turn faster.
    sway_deg: deviation of roll, pitch and yaw while it moves.
    height_m, roll_deg, pitch_deg, yaw_deg: mount of the scanner above the ground.
    sweeps: whether each beam is sent from where the robot is at its own time, and points carry
    times; else a scan is taken at one instant.
    body: whether the scanner sees parts of the robot.
    odometry_share, odometry_deg_per_m: how odometry drifts from scan to scan, as ``Drift`` of
    ``recordings.odometry`` says: share of the motion, of length and of angle, degrees per metre.
    """

    motion: str = "forward"
    rate_hz: float = 10.0
    speed_m_s: float = 1.0
    turn_rad_s: float = 0.7
    sway_deg: float = 0.5
    height_m: float = 1.2
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    sweeps: bool = True
    body: bool = False
    odometry_share: float = 0.005
    odometry_deg_per_m: float = 0.05

    def __post_init__(self) -> None:
        laws = {
            "motion": self.motion in MOTIONS,
            "rate_hz": 0.01 <= self.rate_hz <= 100,
            "speed_m_s": 0 < self.speed_m_s <= 100,
            "turn_rad_s": 0 < self.turn_rad_s <= 10,
            "sway_deg": 0 <= self.sway_deg <= 10,
            "height_m": 0 < self.height_m <= 100,
            "roll_deg": abs(self.roll_deg) <= 180,
            "pitch_deg": abs(self.pitch_deg) <= 180,
            "yaw_deg": abs(self.yaw_deg) <= 360,
            "odometry_share": 0 <= self.odometry_share <= 1,
            "odometry_deg_per_m": 0 <= self.odometry_deg_per_m <= 100,
        }
        for name, holds in laws.items():
            if not holds:
                known = f"; known are {', '.join(MOTIONS)}" if name == "motion" else ""
                raise ConfigError(f"Drive.{name} is out of range: {getattr(self, name)}{known}")

    @property
    def T_base_sensor(self) -> Array:
        """Pose of the scanner on the robot, whose origin is on the ground."""
        T = np.eye(4)
        angles = [self.yaw_deg, self.pitch_deg, self.roll_deg]
        T[:3, :3] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        T[2, 3] = self.height_m
        return T


def trajectory(
    route: Route, drive: Drive, start_s: float, end_s: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return times (K,) and sensor poses T_world_sensor (K, 4, 4), a hundredth of a second apart.

    The first time is at or before ``start_s`` <= 0, the last at or after ``end_s``; a later end
    changes none of the earlier poses.  An open route is driven to and fro, facing the same way.
    """
    t = _KNOT_S * np.arange(np.floor(start_s / _KNOT_S), np.ceil(end_s / _KNOT_S) + 1)
    place_rng, pace_rng, sway_rng = rng.spawn(3)
    pace, progress = _pace(drive, t, pace_rng)
    at = place_rng.uniform(0.02, 0.3) * route.arc_m[-1]
    if drive.motion in ("spin", "still"):
        places, heading = route.at(np.full(len(t), at))
        slope = np.zeros(len(t))
        facing = heading + place_rng.uniform(-np.pi, np.pi)
        facing = facing + (drive.turn_rad_s * progress if drive.motion == "spin" else 0.0)
    else:
        places, heading, slope = _along(route, drive, at, progress)
        facing = heading
    still = drive.motion == "still"
    sway = np.zeros((4, len(t))) if still else pace * _waves(t, sway_rng) * drive.sway_deg
    tilt = Rotation.from_euler("ZY", np.stack([facing, -slope], axis=1))
    turn = Rotation.from_euler("Z", _FACING_RAD.get(drive.motion, 0.0))
    rock = Rotation.from_euler("ZYX", np.radians(sway[:3].T))
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = (tilt * turn * rock).as_matrix()
    T[:, :3, 3] = places
    T[:, 2, 3] += 0.02 * sway[3]
    return t, T @ drive.T_base_sensor


def _pace(drive: Drive, t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the speed relative to its mean, and its integral over time."""
    phase = rng.uniform(0, 2 * np.pi)
    swing, omega = (1.0, 2 * np.pi / 8.0) if drive.motion == "stop_and_go" else (0.15, 1.3)
    return 1 + swing * np.cos(omega * t + phase), t + swing / omega * np.sin(omega * t + phase)


def _along(
    route: Route, drive: Drive, start_m: float, progress: Array
) -> tuple[Array, Array, Array]:
    """Return places (K, 3), headings and slopes (K,) after ``progress`` seconds of driving."""
    s = route.arc_m
    bend = np.abs(np.gradient(route.heading_rad, s))
    inverse_speed = np.maximum(1.0 / drive.speed_m_s, bend / drive.turn_rad_s)
    tau = np.concatenate(
        [[0.0], np.cumsum(0.5 * (inverse_speed[1:] + inverse_speed[:-1]) * np.diff(s))]
    )
    after = np.interp(start_m, s, tau) + progress
    lap = tau[-1]
    within = after % lap if route.closed else lap - np.abs(after % (2 * lap) - lap)
    places, heading = route.at(np.minimum(np.interp(within, tau, s), s[-1] * (1 - 1e-12)))
    width = max(1, min(int(1.0 / (s[1] - s[0])), len(s) // 3))  # smoothed over a metre
    rise = np.convolve(route.points[:, 2], np.ones(width) / width, mode="same")
    slope = np.gradient(rise, s)
    slope[:width], slope[-width:] = slope[width], slope[-width - 1]
    return places, heading, np.arctan(np.interp(within, tau, slope))


def _waves(t: Array, rng: np.random.Generator) -> Array:
    """Return smooth noise (4, K) of deviation 1."""
    frequency = rng.uniform(0.3, 2.0, size=(4, _N_WAVES, 1))
    phase = rng.uniform(0, 2 * np.pi, size=(4, _N_WAVES, 1))
    waves = np.sin(2 * np.pi * frequency * t + phase)
    return np.asarray(np.sqrt(2 / _N_WAVES) * waves.sum(axis=1))


def body(drive: Drive) -> Mesh:
    """Return what the scanner sees of its robot, in the sensor frame: a deck and two posts."""
    length, width, below = (2.2, 1.5, 0.45) if drive.height_m > 1.4 else (0.7, 0.5, 0.15)
    deck = box([0.0, 0.0, drive.height_m - below], [length, width, 0.04])
    posts = [
        cylinder([-0.4 * length, y * width, drive.height_m - below], below + 0.3, 0.02)
        for y in (-0.4, 0.4)
    ]
    mesh = painted(join([deck, *posts]), 0.2)
    T = se3.inverse(drive.T_base_sensor)
    return Mesh(se3.transform(T, mesh.vertices), mesh.triangles, mesh.reflectance)
