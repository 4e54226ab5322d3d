"""Filters of points: range crop, maximum density, random subsample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.geometry.se3 import Array


def crop_range(points: Array, min_m: float, max_m: float) -> Array:
    """Return the points whose distance from the sensor is in [min_m, max_m].  (N, 3) -> (M, 3)."""
    with np.errstate(over="ignore"):
        range2 = np.einsum("ij,ij->i", points, points)
    return np.asarray(points[(range2 >= min_m**2) & (range2 <= max_m**2)])


def limit_density(
    points: Array, voxel_m: float, max_points: int, rng: np.random.Generator
) -> Array:
    """Return the points with at most ``max_points`` in each cube of side ``voxel_m``.

    Those kept in a crowded cube are a uniform random draw.  (N, 3) -> (M, 3), order kept.
    """
    if len(points) == 0:
        return points
    cells = np.floor((points - points.min(axis=0)) / voxel_m).astype(np.int64)
    sides = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]
    shuffled = rng.permutation(len(points))
    order = shuffled[np.argsort(keys[shuffled], kind="stable")]
    ordered = keys[order]
    first = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
    rank = np.arange(len(points)) - np.repeat(first, np.diff(np.r_[first, len(points)]))
    return points[np.sort(order[rank < max_points])]


def subsample(n_points: int, n_kept: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return ``n_kept`` of ``n_points`` indices, drawn without repetition, in increasing order.

    All of them when there are no more than ``n_kept``.
    """
    if n_points <= n_kept:
        return np.arange(n_points)
    return np.sort(rng.choice(n_points, n_kept, replace=False, shuffle=False))
