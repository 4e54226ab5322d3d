"""Whether scans hold points that move with the sensor: the vehicle that carries it.

Registrations find such points where they were and are pulled towards no motion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.neighbors import build_tree, nearest
from cello3d_ros.geometry.se3 import Array, inverse, transform
from cello3d_ros.learning.align_scans import ShapedScan

_APART_M = 0.5  # between the two scans of a pair
_N_PAIRS = 6
_SAME_M = 0.05  # from a point of the other scan, as if nothing had moved
_OFF_M, _NEAR_M = 0.15, 1.0  # off every plane of the nearest 3 points, or as far from them
_MANY = 0.03  # share of the points: docs/align.md


class Carried(NamedTuple):
    """share: of the points that move with the sensor; reach_m: range within which 80 % are."""

    share: float
    reach_m: float

    @property
    def is_many(self) -> bool:
        """Whether they pull registrations."""
        return self.share > _MANY


def carried_of(
    poses: Array, members: NDArray[np.int64], shaped: Callable[[int], ShapedScan]
) -> Carried | None:
    """Compare scans half a metre apart; None where no two are.

    poses: (n, 4, 4), of the members at least.  shaped: gives a scan with its own normals.
    """
    shares, ranges = [], []
    for i in members[:: max(1, len(members) // _N_PAIRS)].tolist():
        later = members[members > i]
        away = np.linalg.norm(poses[later, :3, 3] - poses[i, :3, 3], axis=1) > _APART_M
        if away.any():
            j = int(later[np.argmax(away)])
            points = shaped(j).points
            stays = _stays(points, inverse(poses[i]) @ poses[j], shaped(i))
            shares.append(float(stays.mean()))
            ranges.append(np.linalg.norm(points[stays], axis=1))
    if not shares:
        return None
    found = np.concatenate(ranges)
    reach_m = float(np.quantile(found, 0.8)) if len(found) else 0.0
    return Carried(float(np.median(shares)), reach_m)


def _stays(points: Array, T: Array, other: ShapedScan) -> NDArray[np.bool_]:
    """Return which points (N, 3) fit another scan only if the sensor has not moved by T."""
    tree = build_tree(other.points)
    same = nearest(tree, points, 1)[0][:, 0] < _SAME_M**2
    moved = transform(T, points)
    distances2, near = nearest(tree, moved, 3)
    normals = other.normals[tree.order][near]  # 0, a plane through all, on a ring of few beams
    off = np.abs(np.einsum("nki,nki->nk", normals, moved[:, None] - tree.points[near]))
    return np.asarray(same & ((distances2[:, 0] > _NEAR_M**2) | (off.min(axis=1) > _OFF_M)))
