"""A lidar scanner: where and when its beams go, and what comes back of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.errors import ConfigError
from cello3d_ros.geometry.se3 import Array

PATTERNS = ("spinning", "tilting", "rosette", "ring_rosette")
_PULSE_M = 1.5  # two surfaces nearer than this along a beam give one return between them


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """Beams and errors of a scanner, a table of values.

    pattern: "spinning", beams at fixed elevations that turn about the vertical; "tilting", a fan
    of beams across (azimuth) that nods about the sensor's y axis through the elevations;
    "rosette", ``n_beams`` lines behind two turning prisms, around x; "ring_rosette", lines that
    swing between the elevations while they turn.  A rosette never repeats itself.
    elevations_deg: one for each beam of a spinning scanner; else ``n_beams`` of them, evenly from
    the least to the greatest.
    azimuth_step_deg, azimuth_span_deg: between the columns of a scan, and of all of them.
    n_columns: number of columns, where it is not span / step.
    sweep_s: duration of a scan.  Azimuth (a tilting fan: elevation) grows with time.
    range_noise_m, range_noise_per_m: standard deviation of a range near the sensor, and what is
    added to it, in quadrature, per metre of range.
    range_offset_m, elevation_error_deg: standard deviations of the constant errors of each beam's
    range and elevation, which calibration leaves.  serial: the individual that has drawn them.
    missing_share: share of the returns that get lost whatever they hit.
    grazing_deg: angle of incidence (0 is head-on) beyond which the chance of a return falls,
    linearly in the cosine, to 0 at 90 degrees.
    reach_m: range at which a surface of reflectance 0.1 hit head-on still returns.  The light
    that comes back goes with reflectance, cosine of incidence and range^-2, and the chance of a
    return with its square.
    divergence_deg: width of a beam; at an edge it gives points between the two surfaces.
    particle_share, particle_range_m: share of the beams that rain, snow or dust sends back, and
    the mean distance, exponential, beyond the least range.
    """

    pattern: str = "spinning"
    n_beams: int = 32
    min_elevation_deg: float = -25.0
    max_elevation_deg: float = 15.0
    elevations_deg: tuple[float, ...] = ()
    azimuth_step_deg: float = 0.6
    azimuth_span_deg: float = 360.0
    n_columns: int = 0
    sweep_s: float = 0.1
    min_range_m: float = 0.5
    max_range_m: float = 30.0
    range_noise_m: float = 0.01
    range_noise_per_m: float = 0.0
    range_offset_m: float = 0.0
    elevation_error_deg: float = 0.0
    serial: int = 0
    missing_share: float = 0.03
    grazing_deg: float = 80.0
    reach_m: float = np.inf
    divergence_deg: float = 0.0
    particle_share: float = 0.0
    particle_range_m: float = 2.0

    def __post_init__(self) -> None:
        table = tuple(float(e) for e in self.elevations_deg)
        object.__setattr__(self, "elevations_deg", table)
        laws = {
            "pattern": self.pattern in PATTERNS,
            "n_beams": self.n_beams >= 1,
            "min_elevation_deg": -90 <= self.min_elevation_deg <= self.max_elevation_deg,
            "max_elevation_deg": self.max_elevation_deg <= 90,
            "elevations_deg": all(-90 <= e <= 90 for e in table),
            "azimuth_step_deg": 0.01 <= self.azimuth_step_deg <= self.azimuth_span_deg,
            "azimuth_span_deg": self.azimuth_span_deg <= 360,
            "n_columns": self.n_columns >= 0,
            "sweep_s": 0 < self.sweep_s <= 60,
            "min_range_m": 0 <= self.min_range_m < self.max_range_m,
            "max_range_m": self.max_range_m <= 10_000,
            "range_noise_m": 0 <= self.range_noise_m <= 10,
            "range_noise_per_m": 0 <= self.range_noise_per_m <= 1,
            "range_offset_m": 0 <= self.range_offset_m <= 10,
            "elevation_error_deg": 0 <= self.elevation_error_deg <= 10,
            "serial": isinstance(self.serial, int) and self.serial >= 0,
            "missing_share": 0 <= self.missing_share <= 1,
            "grazing_deg": 0 <= self.grazing_deg < 90,
            "reach_m": self.reach_m > 0,
            "divergence_deg": 0 <= self.divergence_deg <= 10,
            "particle_share": 0 <= self.particle_share <= 1,
            "particle_range_m": 0 < self.particle_range_m <= 1000,
        }
        for name, holds in laws.items():
            if not holds:
                raise ConfigError(f"Scanner.{name} is out of range: {getattr(self, name)}")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (beams, or steps of a tilting fan) and columns of a scan."""
        columns = self.n_columns or max(1, round(self.azimuth_span_deg / self.azimuth_step_deg))
        return len(self.elevations_deg) or self.n_beams, columns

    def elevations(self) -> Array:
        """Return the elevation (rows,) of each beam, in degrees."""
        if self.elevations_deg:
            return np.array(self.elevations_deg)
        return np.linspace(self.min_elevation_deg, self.max_elevation_deg, self.n_beams)

    def times(self) -> Array:
        """Return when each beam (n,) is sent, in seconds of the sweep, 0 to below ``sweep_s``."""
        rows, columns = self.shape
        if self.pattern == "tilting":
            return self.sweep_s * np.arange(rows * columns) / (rows * columns)
        return np.tile(self.sweep_s * np.arange(columns) / columns, rows)

    def directions(self, turn: int = 0) -> Array:
        """Return the unit vectors (n, 3) of the beams of one scan in the sensor frame.

        Row after row.  turn: number of the scan, which changes those of a rosette.
        """
        if self.pattern == "rosette":
            return self._rosette(turn)
        if self.pattern == "ring_rosette":
            return self._ring_rosette(turn)
        n = self.shape[1]
        azimuth = np.radians((np.arange(n) + 0.5) / n - 0.5) * self.azimuth_span_deg
        e, a = (
            g.ravel() for g in np.meshgrid(np.radians(self.elevations()), azimuth, indexing="ij")
        )
        if self.pattern == "tilting":
            ahead = np.cos(a)
            return np.stack([np.cos(e) * ahead, np.sin(a), np.sin(e) * ahead], axis=1)
        return _spherical(a, e)

    def _rosette(self, turn: int) -> Array:
        """Two prisms that turn against each other; the lines stand side by side in azimuth."""
        rows, columns = self.shape
        t = turn * self.sweep_s + self.times().reshape(rows, columns)
        first, second = 2 * np.pi * _PRISMS_HZ[0] * t, 2 * np.pi * _PRISMS_HZ[1] * t
        line = (np.arange(rows) - (rows - 1) / 2)[:, None] * _LINE_STEP_DEG
        across = 0.5 * self.azimuth_span_deg - 0.5 * (rows - 1) * _LINE_STEP_DEG
        up = 0.5 * (self.max_elevation_deg - self.min_elevation_deg)
        middle = 0.5 * (self.max_elevation_deg + self.min_elevation_deg)
        a = line + across * 0.5 * (np.cos(first) + np.cos(second))
        e = middle + up * 0.5 * (np.sin(first) + np.sin(second))
        return _spherical(np.radians(a.ravel()), np.radians(e.ravel()))

    def _ring_rosette(self, turn: int) -> Array:
        """Lines that turn about the vertical and swing up and down.

        They stand evenly around, and pass one azimuth evenly over the swing.
        """
        rows, columns = self.shape
        line = np.arange(rows)[:, None] / rows
        t = turn * self.sweep_s + self.times().reshape(rows, columns) + line / _TURN_HZ
        share = 1.0 - np.abs(2.0 * ((_SWING_HZ * t + line) % 1.0) - 1.0)
        e = self.min_elevation_deg + share * (self.max_elevation_deg - self.min_elevation_deg)
        return _spherical((2 * np.pi * _TURN_HZ * t).ravel(), np.radians(e.ravel()))


_PRISMS_HZ = (121.567, -77.733)  # 7294 and -4664 turns a minute
_LINE_STEP_DEG = 0.7
_SWING_HZ, _TURN_HZ = 301.7, 10.17


def _spherical(azimuth: Array, elevation: Array) -> Array:
    e, a = elevation, azimuth
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


class Echoes(NamedTuple):
    """What a scan's beams meet, before any error: enough to scan again without the world.

    distances: (n,) metres along the beams, inf where there is nothing; cosines: (n,) of the angles
    of incidence.  turn: number of the scan.  reflectances: (n,), or None for 0.3 everywhere.
    """

    scanner: Scanner
    distances: Array
    cosines: Array
    turn: int = 0
    reflectances: Array | None = None


def measure(echoes: Echoes, rng: np.random.Generator, range_noise_m: float | None = None) -> Array:
    """Return the points (N, 3) of one scan in the sensor frame, each a float32 number.

    A range is the distance along the beam, the offset of the beam and Gaussian noise;
    ``range_noise_m`` stands in for the scanner's own.  A point lies where the scanner believes its
    beam to go.  A range outside the scanner's limits, a grazing, dark or randomly missing
    return gives no point.
    """
    return returns(echoes, rng, range_noise_m)[0]


def returns(
    echoes: Echoes, rng: np.random.Generator, range_noise_m: float | None = None
) -> tuple[Array, NDArray[np.int64]]:
    """Return the points that ``measure`` returns, and the beam (N,) of each."""
    scanner, distance, cosine = echoes[:3]
    sigma_m = scanner.range_noise_m if range_noise_m is None else range_noise_m
    n = len(distance)
    unit = rng.normal(size=n)
    luck, gloss = rng.uniform(size=(2, n))
    chance = np.minimum(1.0, cosine / np.cos(np.radians(scanner.grazing_deg)))
    if np.isfinite(scanner.reach_m):
        reflectance = 0.3 if echoes.reflectances is None else echoes.reflectances
        with np.errstate(divide="ignore"):
            light = reflectance / 0.1 * cosine * (scanner.reach_m / distance) ** 2
        chance = np.minimum(chance, light**2)
    beams = scanner.directions(echoes.turn)
    if scanner.divergence_deg > 0.0:
        distance = _mixed(scanner, distance, beams, rng)
    if scanner.particle_share > 0.0:
        near = scanner.min_range_m + rng.exponential(scanner.particle_range_m, size=n)
        hit = (rng.uniform(size=n) < scanner.particle_share) & (near < distance)
        distance, chance = np.where(hit, near, distance), np.where(hit, 1.0, chance)
    noise = sigma_m * unit
    if scanner.range_noise_per_m > 0.0:
        seen = np.where(np.isfinite(distance), distance, 0.0)
        noise = np.hypot(sigma_m, scanner.range_noise_per_m * seen) * unit
    if scanner.range_offset_m > 0.0 or scanner.elevation_error_deg > 0.0:
        offset, elevation = _errors_of_beams(scanner)
        noise, beams = noise + offset, _raised(beams, elevation)
    kept = (
        (distance + noise >= scanner.min_range_m)
        & (distance + noise <= scanner.max_range_m)
        & (luck >= scanner.missing_share)
        & (gloss <= chance)
    )
    points = (distance[kept] + noise[kept])[:, None] * beams[kept]
    return np.asarray(points.astype(np.float32), dtype=np.float64), np.flatnonzero(kept)


def _errors_of_beams(scanner: Scanner) -> tuple[Array, Array]:
    """Return the constant errors of the range (m) and elevation (rad) of each direction (n,).

    A row of directions is one beam; all of a nodding fan are.
    """
    rows, columns = scanner.shape
    rng = np.random.default_rng(scanner.serial)
    units = rng.normal(size=(2, 1 if scanner.pattern == "tilting" else rows))
    offset, elevation = np.repeat(np.broadcast_to(units, (2, rows)), columns, axis=1)
    return scanner.range_offset_m * offset, np.radians(scanner.elevation_error_deg) * elevation


def _raised(beams: Array, angle: Array) -> Array:
    """Return unit vectors (n, 3) turned up by small angles (n,) in rad."""
    z = beams[:, 2:]
    up = (np.array([0.0, 0.0, 1.0]) - z * beams) / np.sqrt(np.maximum(1.0 - z**2, 1e-12))
    return np.asarray(np.cos(angle)[:, None] * beams + np.sin(angle)[:, None] * up)


def _mixed(scanner: Scanner, distance: Array, beams: Array, rng: np.random.Generator) -> Array:
    """Return the distances, some of those at an edge between the surfaces on its two sides.

    A beam lies across the edge between it and the next of its row as often as it is wide against
    the angle between the two.
    """
    rows = distance.reshape(scanner.shape)
    following = np.roll(beams.reshape(*scanner.shape, 3), -1, axis=1)
    step = np.linalg.norm(following - beams.reshape(following.shape), axis=2)
    beyond = np.roll(rows, -1, axis=1)
    cut, share = rng.uniform(size=(2, *rows.shape))
    with np.errstate(invalid="ignore"):  # inf - inf where there is nothing
        between = beyond - rows
        hit = (np.abs(between) < _PULSE_M) & (cut * step < np.radians(scanner.divergence_deg))
    return np.asarray(rows + share * np.where(hit, between, 0.0)).ravel()
