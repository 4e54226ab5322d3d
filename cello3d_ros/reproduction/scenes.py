"""Small scenes whose registration is understood: a cube, a cylinder, a hallway."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import Pipeline, SamplingConfig
from cello3d_ros.covariance.closed_form import censi
from cello3d_ros.geometry.se3 import Array, exp, log
from cello3d_ros.learning.clustering import nearest_cluster
from cello3d_ros.registration.backends import register_many
from cello3d_ros.registration.overlap import find_overlap
from cello3d_ros.reproduction.datasets import PAPER

_EVERY_POINT = replace(PAPER.cloud, min_range_m=0.0, max_points_per_voxel=1_000_000)


def cube(rng: np.random.Generator, n: int, sigma_m: float, side_m: float = 1.0) -> Cloud:
    """Return ``n`` points on the faces of a cube around the origin, with noise on each axis."""
    points = rng.uniform(-0.5, 0.5, (n, 3))
    face = rng.integers(6, size=n)
    points[np.arange(n), face // 2] = face % 2 - 0.5
    return cloud(side_m * points + sigma_m * rng.normal(size=points.shape), rng)


def cylinder(
    rng: np.random.Generator, n: int, sigma_m: float, radius_m: float = 0.5, height_m: float = 2.0
) -> Cloud:
    """Return ``n`` points on an upright cylinder with both caps, around the origin."""
    side = 2.0 * np.pi * radius_m * height_m
    caps = 2.0 * np.pi * radius_m**2
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    on_cap = rng.uniform(size=n) < caps / (side + caps)
    r = np.where(on_cap, radius_m * np.sqrt(rng.uniform(size=n)), radius_m)
    ends = rng.choice([-0.5, 0.5], n)
    z = height_m * np.where(on_cap, ends, rng.uniform(-0.5, 0.5, n))
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return cloud(points + sigma_m * rng.normal(size=points.shape), rng)


def hallway(
    rng: np.random.Generator, n: int, sigma_m: float, pitch_m: float, half_length_m: float = 6.0
) -> Cloud:
    """Return ``n`` points of a hallway along x, as seen from its middle.

    It is 2 m wide and 2.4 m high; square pillars stand out by 0.15 m of both walls at
    ``x = 0, +-pitch, ...``.
    """
    depth, half_width, half_height = 0.15, 1.0, 1.2
    x = rng.uniform(-half_length_m, half_length_m, n)
    on_pillar = np.abs((x + 0.5 * pitch_m) % pitch_m - 0.5 * pitch_m) < depth
    side = rng.choice([-1.0, 1.0], n)
    wall = np.stack(
        [
            x,
            side * (half_width - depth * on_pillar),
            rng.uniform(-half_height, half_height, n),
        ],
        axis=1,
    )
    flat = np.stack([x, rng.uniform(-half_width, half_width, n), half_height * side], axis=1)
    ends = rng.choice([-depth, depth], n) + pitch_m * np.round(x / pitch_m)
    flank = np.stack(
        [
            ends,
            side * (half_width - depth * rng.uniform(size=n)),
            rng.uniform(-half_height, half_height, n),
        ],
        axis=1,
    )
    kind = rng.uniform(size=n)[:, None]
    points = np.where(kind < 0.45, wall, np.where(kind < 0.9, flat, flank))
    return cloud(points + sigma_m * rng.normal(size=points.shape), rng)


def cloud(points: Array, rng: np.random.Generator) -> Cloud:
    """Return all points with their normals."""
    return prepare(points, _EVERY_POINT, rng)


def errors(
    reading: Cloud,
    reference: Cloud,
    starts: Array,
    pipeline: Pipeline,
    n_threads: int,
    seed: int = 0,
) -> Array:
    """Return where ICP ends, about a truth of identity.  starts: (n, 6) twists; (m, 6), m <= n.

    Registrations without an answer are left out.
    """
    seeds = [[seed, k] for k in range(len(starts))]
    found = register_many(reading, reference, exp(starts), seeds, pipeline.icp, n_threads)
    T = [r.T_ref_read for r in found if r.has_answer]
    return np.asarray(log(np.array(T).reshape(-1, 4, 4)))


def censi_of(
    reading: Cloud, reference: Cloud, T: Array, pipeline: Pipeline, sigma_m: float
) -> Array:
    """Return Censi's covariance of a registration T_ref_read (4, 4).  (6, 6)."""
    icp = pipeline.icp
    found = find_overlap(reading, reference, T, pipeline.overlap.radius_m, icp.n_neighbors)
    return censi(reading, reference, T, found, icp, sigma_m)


def kept_of(xi: Array) -> NDArray[np.bool_]:
    """Return which registrations training would keep: the cluster nearest to the truth.  (n,)."""
    sampling = SamplingConfig()
    return nearest_cluster(
        xi, sampling.cluster_scale_m, sampling.cluster_scale_rad, sampling.cluster_min_share
    )
