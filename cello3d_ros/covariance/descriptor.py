"""The voxel descriptor of an overlap (Sec. IV-C): 11 numbers a cell, 704 for the paper's grid."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.shape import Cloud, has_shape
from cello3d_ros.compiled import kernel
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


def describe_clouds(
    clouds: Sequence[Cloud],
    overlaps: Sequence[NDArray[np.bool_]],
    Ts: Sequence[Array],
    grid: GridConfig,
) -> Array:
    """Return the descriptor of those points of some clouds that overlap, cell by cell, x-major.

    overlaps: (N,) of each cloud; Ts: (4, 4), each takes its cloud to the reading frame, or to a
    turned one.  Returns (n_features,): for each cell the mean planarity, the mean cylindricality
    and the normalised histogram of unsigned normals; zeros for an empty cell.  Cells are
    half-open, the grid is centred on the origin and points outside it are ignored.
    Source: Sec. IV-C and V-A.
    """
    assert all(has_shape(cloud) for cloud in clouds)
    n_cells = np.array(grid.n_cells)
    extent = np.array(grid.extent_m)
    sums = np.zeros((int(n_cells.prod()), N_CELL))
    counts = np.zeros(len(sums))
    for cloud, overlap, T in zip(clouds, overlaps, Ts):
        of_points = cloud.points, cloud.normals, cloud.planarity, cloud.cylindricality, overlap
        T = np.array(T, np.float64, order="C")
        _sum_cells(*of_points, T, n_cells, extent, BINS, sums, counts)
    return (sums / np.maximum(counts, 1.0)[:, None]).ravel()


@kernel()
def _sum_cells(
    points: Array,
    normals: Array,
    planarity: Array,
    cylindricality: Array,
    overlap: NDArray[np.bool_],
    T: Array,
    n_cells: NDArray[np.int64],
    extent: Array,
    bins: Array,
    sums: Array,
    counts: Array,
) -> None:
    """Add planarity, cylindricality and nearest bin of each overlapping plane to its cell."""
    for i in range(len(points)):
        if not overlap[i]:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cell = 0
        for a in range(3):
            moved = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]
            place = math.floor((moved / extent[a] + 0.5) * n_cells[a])
            if place < 0 or place >= n_cells[a]:
                cell = -1
                break
            cell = cell * n_cells[a] + place
        if cell < 0:
            continue
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        if x == 0.0 and y == 0.0 and z == 0.0:
            continue
        nx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
        ny = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
        nz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
        nearest, cosine = 0, -1.0
        for b in range(len(bins)):
            c = abs(nx * bins[b, 0] + ny * bins[b, 1] + nz * bins[b, 2])
            if c > cosine:
                nearest, cosine = b, c
        counts[cell] += 1.0
        sums[cell, 0] += planarity[i]
        sums[cell, 1] += cylindricality[i]
        sums[cell, 2 + nearest] += 1.0
