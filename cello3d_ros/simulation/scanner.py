"""A lidar scanner: where its beams go, and what comes back of them."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from cello3d_ros.errors import ConfigError, RecordingError, how_to_install
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """Beams and errors of a scanner; a scan is taken at one instant, without motion.

    pattern: "spinning", beams at fixed elevations that turn about the vertical; or "tilting", a
    fan of beams across (azimuth) that nods about the sensor's y axis through the elevations.
    range_noise_m: standard deviation of a range.
    missing_share: share of the returns that get lost whatever they hit.
    grazing_deg: angle of incidence (0 is head-on) beyond which the chance of a return falls,
    linearly in the cosine, to 0 at 90 degrees.
    """

    pattern: str = "spinning"
    n_beams: int = 32
    min_elevation_deg: float = -25.0
    max_elevation_deg: float = 15.0
    azimuth_step_deg: float = 0.6
    azimuth_span_deg: float = 360.0
    min_range_m: float = 0.5
    max_range_m: float = 30.0
    range_noise_m: float = 0.01
    missing_share: float = 0.03
    grazing_deg: float = 80.0

    def __post_init__(self) -> None:
        laws = {
            "pattern": self.pattern in ("spinning", "tilting"),
            "n_beams": self.n_beams >= 1,
            "min_elevation_deg": -90 <= self.min_elevation_deg <= self.max_elevation_deg,
            "max_elevation_deg": self.max_elevation_deg <= 90,
            "azimuth_step_deg": 0.01 <= self.azimuth_step_deg <= self.azimuth_span_deg,
            "azimuth_span_deg": self.azimuth_span_deg <= 360,
            "min_range_m": 0 <= self.min_range_m < self.max_range_m,
            "max_range_m": self.max_range_m <= 10_000,
            "range_noise_m": 0 <= self.range_noise_m <= 10,
            "missing_share": 0 <= self.missing_share <= 1,
            "grazing_deg": 0 <= self.grazing_deg < 90,
        }
        for name, holds in laws.items():
            if not holds:
                raise ConfigError(f"Scanner.{name} is out of range: {getattr(self, name)}")

    def directions(self) -> Array:
        """Return the unit vectors (n, 3) of the beams in the sensor frame."""
        elevation = np.radians(
            np.linspace(self.min_elevation_deg, self.max_elevation_deg, self.n_beams)
        )
        n = max(1, round(self.azimuth_span_deg / self.azimuth_step_deg))
        azimuth = np.radians((np.arange(n) + 0.5) / n - 0.5) * self.azimuth_span_deg
        e, a = (g.ravel() for g in np.meshgrid(elevation, azimuth, indexing="ij"))
        if self.pattern == "tilting":
            ahead = np.cos(a)
            return np.stack([np.cos(e) * ahead, np.sin(a), np.sin(e) * ahead], axis=1)
        return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


SCANNERS = MappingProxyType(
    {
        "spinning16": Scanner(
            n_beams=16, min_elevation_deg=-15, max_elevation_deg=15, azimuth_step_deg=0.4
        ),
        "spinning32": Scanner(),
        "spinning64": Scanner(
            n_beams=64, min_elevation_deg=-22.5, max_elevation_deg=22.5, azimuth_step_deg=0.36
        ),
        "wide": Scanner(
            n_beams=90, min_elevation_deg=-50, max_elevation_deg=85, azimuth_step_deg=1.2
        ),
        "tilting_hokuyo": Scanner(  # UTM-30LX on a tilting unit, thinned to a quarter
            pattern="tilting",
            n_beams=172,
            min_elevation_deg=-60,
            max_elevation_deg=60,
            azimuth_step_deg=0.5,
            azimuth_span_deg=270,
            min_range_m=0.1,
        ),
        "narrow": Scanner(  # the field of view of a Livox Avia
            n_beams=110,
            min_elevation_deg=-38.6,
            max_elevation_deg=38.6,
            azimuth_step_deg=0.7,
            azimuth_span_deg=70.4,
            max_range_m=100.0,
            range_noise_m=0.02,
        ),
    }
)


def raycasting_scene(mesh: Mesh) -> Any:
    """Return Open3D's ``RaycastingScene`` of a mesh, ready for ``cast``.

    Raises RecordingError where Open3D cannot be imported.
    """
    o3d = import_open3d("simulated worlds")
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor(mesh.triangles.astype(np.uint32)),
    )
    return scene


class Echoes(NamedTuple):
    """What a scan's beams meet, before any error: enough to scan again without the world.

    distances: (n,) metres along the beams, inf where there is nothing; cosines: (n,) of the angles
    of incidence.
    """

    scanner: Scanner
    distances: Array
    cosines: Array


def cast(scene: Any, scanner: Scanner, T_world_sensor: Array) -> Echoes:
    """Return what the scanner's beams meet from a pose."""
    o3d = import_open3d("simulated worlds")
    beams = scanner.directions()
    rays = np.empty((len(beams), 6), dtype=np.float32)
    rays[:, :3] = T_world_sensor[:3, 3]
    rays[:, 3:] = beams @ T_world_sensor[:3, :3].T
    hits = scene.cast_rays(o3d.core.Tensor(rays))
    normal = hits["primitive_normals"].numpy().astype(np.float64)
    cosines = np.abs(np.einsum("ij,ij->i", normal, rays[:, 3:].astype(np.float64)))
    return Echoes(scanner, hits["t_hit"].numpy().astype(np.float64), cosines)


def measure(echoes: Echoes, rng: np.random.Generator, range_noise_m: float | None = None) -> Array:
    """Return the points (N, 3) of one scan in the sensor frame, each a float32 number.

    range = distance + N(0, range_noise_m^2) along the beam, the scanner's own noise if not said; a
    range outside the scanner's limits, a grazing or a randomly missing return gives no point.
    """
    scanner, distance, cosine = echoes
    sigma_m = scanner.range_noise_m if range_noise_m is None else range_noise_m
    beams = scanner.directions()
    noise = sigma_m * rng.normal(size=len(beams))
    luck, gloss = rng.uniform(size=(2, len(beams)))
    kept = (
        (distance + noise >= scanner.min_range_m)
        & (distance + noise <= scanner.max_range_m)
        & (luck >= scanner.missing_share)
        & (gloss * np.cos(np.radians(scanner.grazing_deg)) <= cosine)
    )
    points = (distance[kept] + noise[kept])[:, None] * beams[kept]
    return np.asarray(points.astype(np.float32), dtype=np.float64)


def scan(scene: Any, scanner: Scanner, T_world_sensor: Array, rng: np.random.Generator) -> Array:
    """Return the points (N, 3) of one scan as ``measure`` does."""
    return measure(cast(scene, scanner, T_world_sensor), rng)


def import_open3d(purpose: str) -> Any:
    """Return the module ``open3d``; raises RecordingError that says how to get it."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise RecordingError(
            f"{purpose} need Open3D: {how_to_install('open3d', error)}"
        ) from error
    return open3d
