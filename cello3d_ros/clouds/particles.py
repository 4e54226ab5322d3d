"""Returns of snow, rain and dust: single points in the air, before what is seen around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array

Counts = NDArray[np.int64]

_CELL_RAD = 0.03  # side of a cell of directions
_ALIKE = 1.5 * _CELL_RAD  # largest difference of ln(range) of points that support each other
_LEAST = 2  # fewest points that support another
_N_LOOKED_AT = 16_000  # points that tell whether there are particles at all
_FEW = 0.065  # share of them that are alone and near, below which there are none
_MOST = 0.7  # share of them that are alone, above which there are no surfaces either
_MANY = 10  # others in its direction that let a point be alone
_NEAR = 0.5  # times the median range of the cloud


def without_particles(points: Array, min_share: float) -> Array:
    """Return the points that others in the same direction, as far away, support.  (N, 3).

    Of the points within the 3 x 3 cells of directions about a point, at least ``min_share`` and at
    least two must be about as far away; a share that does not depend on how dense the beams are.
    Those left are asked again, as particles support each other by chance.  A cloud of which few
    are alone near the sensor among many others, even by half that share, has no particles and
    stays as it is; so does a cloud of which most are alone, as it is too sparse to tell.
    """
    n = len(points)
    n_looked_at = min(n, _N_LOOKED_AT)
    some = points[np.arange(n_looked_at) * n // max(n_looked_at, 1)]
    ranges = _ranges(some)
    n_others, n_alike = _neighbors(some)
    alone = n_alike < _needed(n_others, 0.5 * min_share)
    if n == 0 or alone.mean() > _MOST:
        return points
    alone &= (n_others >= _MANY) & (ranges < _NEAR * np.median(ranges))
    if alone.mean() < _FEW:
        return points
    for _ in range(2):
        n_others, n_alike = _neighbors(points)
        points = points[n_alike >= _needed(n_others, min_share)]
    return points


def _needed(n_others: Counts, min_share: float) -> Array:
    """Return how many of the others must support a point."""
    return np.asarray(np.maximum(_LEAST, min_share * n_others))


def _ranges(points: Array) -> Array:
    """Return the distances from the sensor, three times as fast as numpy's norm."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", points, points)))


def _neighbors(points: Array) -> tuple[Counts, Counts]:
    """Return how many others are in the direction of each point, and how many as far away."""
    ranges = _ranges(points)
    n_azimuths, n_elevations = int(2.0 * np.pi / _CELL_RAD), int(np.pi / _CELL_RAD) + 1
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5
    columns = np.minimum((turns * n_azimuths).astype(np.int64), n_azimuths - 1)
    sines = np.clip(points[:, 2] / np.maximum(ranges, 1e-9), -1.0, 1.0)
    rows = ((np.arcsin(sines) + 0.5 * np.pi) / _CELL_RAD).astype(np.int64)
    cells = rows * n_azimuths + columns
    order = np.argsort(cells.astype(np.uint16), kind="stable")  # by radix
    starts = np.zeros(n_azimuths * n_elevations + 1, np.int64)
    np.cumsum(np.bincount(cells, minlength=len(starts) - 1), out=starts[1:])
    logs = np.log(np.maximum(ranges, 1e-9))[order]
    n_others, n_alike = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    n_others[order], n_alike[order] = _counted(logs, cells[order], starts, n_azimuths)
    return n_others, n_alike


@kernel()
def _counted(
    logs: Array, cells: NDArray[np.int64], starts: NDArray[np.int64], n_azimuths: int
) -> tuple[Counts, Counts]:
    """Count the others about each point; all are in the order of their cells."""
    n_rows = (len(starts) - 1) // n_azimuths
    n_others, n_alike = np.empty(len(logs), np.int64), np.empty(len(logs), np.int64)
    for i in range(len(logs)):
        row, column = cells[i] // n_azimuths, cells[i] % n_azimuths
        n_all, n_near = 0, 0
        for r in range(max(row - 1, 0), min(row + 2, n_rows)):
            for c in range(column - 1, column + 2):
                cell = r * n_azimuths + c % n_azimuths
                for j in range(starts[cell], starts[cell + 1]):
                    n_all += 1
                    n_near += abs(logs[j] - logs[i]) < _ALIKE
        n_others[i], n_alike[i] = n_all - 1, n_near - 1  # without the point itself
    return n_others, n_alike
