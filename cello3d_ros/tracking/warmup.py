"""Compile or load every kernel before the first cloud comes.  Imports no ROS."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np

from cello3d_ros.config import Config
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.se3 import Array, exp, inverse, transform
from cello3d_ros.tracking.guess import Place
from cello3d_ros.tracking.tracker import Tracker


def room(rng: np.random.Generator, n_points: int = 4000, size_m: float = 6.0) -> Array:
    """Return (N, 3) points on the walls, floor and ceiling of a room and on a crate in it."""
    walls = _box(rng, n_points, np.array([size_m, 0.8 * size_m, 0.5 * size_m]))
    crate = _box(rng, n_points // 4, np.array([1.0, 0.7, 0.9]))
    return np.vstack([walls, crate + np.array([0.25, 0.2, -0.2]) * size_m])


def warm_up(model: Model, config: Config) -> None:
    """Answer one pair of scans of a simulated room, whatever the settings make of them."""
    rng = np.random.default_rng(0)
    tracker = Tracker(model, config, replace(config.node, pairing="consecutive"))
    step = exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.02])
    points = room(rng)
    for stamp_ns, T in enumerate((np.eye(4), step)):
        with contextlib.suppress(Cello3dError):
            place = Place(T, motion=Motion.constant(np.zeros(6)))
            seen = transform(inverse(T), points)
            tracker.step(stamp_ns, seen, place, time_s=np.zeros(len(points)))


def _box(rng: np.random.Generator, n_points: int, size: Array) -> Array:
    """Return points drawn evenly on the six faces of a box about the origin."""
    points = rng.uniform(-0.5, 0.5, (n_points, 3)) * size
    areas = np.repeat(np.prod(size) / size, 2)
    face = rng.choice(6, n_points, p=areas / areas.sum())
    rows = np.arange(n_points)
    points[rows, face // 2] = np.where(face % 2, 0.5, -0.5) * size[face // 2]
    return points
