"""The voxel descriptor of an overlap (Sec. IV-C): 11 numbers a cell, 704 for the paper's grid."""

from __future__ import annotations

import numpy as np

from cello3d_ros.config import GridConfig
from cello3d_ros.geometry.se3 import Array

_S2, _S3 = 1 / np.sqrt(2), 1 / np.sqrt(3)

#: (9, 3) unit directions of the histogram's bins, unsigned.
BINS: Array = np.array(
    [
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (_S2, _S2, 0.0),
        (-_S2, _S2, 0.0),
        (0.0, 0.0, 1.0),
        (_S3, _S3, _S3),
        (-_S3, _S3, _S3),
        (_S3, -_S3, _S3),
        (-_S3, -_S3, _S3),
    ]
)
N_CELL = 2 + len(BINS)  # planarity, cylindricality, histogram


def n_features(grid: GridConfig) -> int:
    """Return the length of a descriptor."""
    return int(np.prod(grid.n_cells)) * N_CELL


def describe_overlap(
    points: Array, normals: Array, planarity: Array, cylindricality: Array, grid: GridConfig
) -> Array:
    """Return the descriptor of overlapping points, cell by cell, x-major.

    points, normals: (N, 3) of both clouds in the reading frame; planarity, cylindricality: (N,).
    Returns (n_features,): for each cell the mean planarity, the mean cylindricality and the
    normalised histogram of unsigned normals; zeros for an empty cell.  Cells are half-open, the
    grid is centred on the origin and points outside it are ignored.  Source: Sec. IV-C and V-A.
    """
    n_cells = np.array(grid.n_cells)
    extent = np.array(grid.extent_m)
    place = np.floor((points / extent + 0.5) * n_cells).astype(np.int64)
    inside = ((place >= 0) & (place < n_cells)).all(axis=1)
    place = place[inside]
    cell = (place[:, 0] * n_cells[1] + place[:, 1]) * n_cells[2] + place[:, 2]
    total = int(n_cells.prod())
    nearest_bin = np.abs(normals[inside] @ BINS.T).argmax(axis=1)
    histogram = np.bincount(cell * len(BINS) + nearest_bin, minlength=total * len(BINS))
    count = np.maximum(np.bincount(cell, minlength=total), 1)
    cells = np.empty((total, N_CELL))
    cells[:, 0] = np.bincount(cell, planarity[inside], total) / count
    cells[:, 1] = np.bincount(cell, cylindricality[inside], total) / count
    cells[:, 2:] = histogram.reshape(total, len(BINS)) / count[:, None]
    return cells.ravel()
