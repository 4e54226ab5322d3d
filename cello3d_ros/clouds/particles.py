"""Returns of snow, rain and dust: single points in the air, before what is seen around them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array

_CELL_RAD = 0.03  # side of a cell of directions
_ALIKE = 1.5 * _CELL_RAD  # largest difference of ln(range) of points that support each other
_LEAST = 2  # fewest points that support another


def without_particles(points: Array, min_share: float) -> Array:
    """Return the points that others in the same direction, as far away, support.  (N, 3).

    Of the points within the 3 x 3 cells of directions about a point, at least ``min_share`` and at
    least two must be about as far away; a share that does not depend on how dense the beams are.
    """
    ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
    n_azimuths, n_elevations = int(2.0 * np.pi / _CELL_RAD), int(np.pi / _CELL_RAD) + 1
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5
    columns = np.minimum((turns * n_azimuths).astype(np.int64), n_azimuths - 1)
    sines = np.clip(points[:, 2] / np.maximum(ranges, 1e-9), -1.0, 1.0)
    rows = ((np.arcsin(sines) + 0.5 * np.pi) / _CELL_RAD).astype(np.int64)
    cells = rows * n_azimuths + columns
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(n_azimuths * n_elevations + 1))
    logs = np.log(np.maximum(ranges, 1e-9))[order]
    kept = np.empty(len(points), np.bool_)
    kept[order] = _supported(logs, cells[order], starts, n_azimuths, min_share)
    return points[kept]


@kernel()
def _supported(
    logs: Array,
    cells: NDArray[np.int64],
    starts: NDArray[np.int64],
    n_azimuths: int,
    min_share: float,
) -> NDArray[np.bool_]:
    """Return which points have support; all are in the order of their cells."""
    n_rows = (len(starts) - 1) // n_azimuths
    kept = np.empty(len(logs), np.bool_)
    for i in range(len(logs)):
        row, column = cells[i] // n_azimuths, cells[i] % n_azimuths
        n, n_alike = -1, -1  # without the point itself
        for r in range(max(row - 1, 0), min(row + 2, n_rows)):
            for c in range(column - 1, column + 2):
                cell = r * n_azimuths + c % n_azimuths
                for j in range(starts[cell], starts[cell + 1]):
                    n += 1
                    n_alike += abs(logs[j] - logs[i]) < _ALIKE
        kept[i] = n_alike >= max(_LEAST, math.ceil(min_share * n))
    return kept
