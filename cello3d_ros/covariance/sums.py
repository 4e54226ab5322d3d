"""Two sums over very many examples: where a prediction spends its time.

There is no spatial index.  Projections have a dozen dimensions and more, in which the boxes of a
tree exclude next to nothing around a query, and under the Theta that training finds most examples
have a weight that counts.  So a prediction reads every example once, 128 bytes of projections
and 168 of covariances, and its time is that of memory (``benchmarks/prediction.py``); those that
underflow leaves without weight are passed over.  Covariances are summed as their upper
triangles, 21 numbers in place of 36.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array

_ROWS, _COLUMNS = np.triu_indices(6)
_PLACES = 6 * _ROWS + _COLUMNS

#: (21,) how often each packed number stands in its matrix: ``tr(A B) = (A * TWICE) @ B``, packed.
TWICE: Array = np.where(_ROWS == _COLUMNS, 1.0, 2.0)

_BLOCK = 1024  # rows summed apart, so that rounding does not grow with the number of rows


def pack(Y: Array) -> Array:
    """Return the upper triangles, row by row.  (..., 6, 6) -> (..., 21)."""
    return np.take(Y.reshape(*Y.shape[:-2], 36), _PLACES, axis=-1)


def unpack(packed: Array) -> Array:
    """Return the symmetric matrices of which these are the upper triangles."""
    Y = np.empty((*packed.shape[:-1], 6, 6))
    Y[..., _ROWS, _COLUMNS] = packed
    Y[..., _COLUMNS, _ROWS] = packed
    return Y


def squared_distances(points: Array, query: Array) -> Array:
    """Return ``|p_k - query|^2`` of each point.  (N, r), (r,) -> (N,)."""
    found = np.empty(len(points))
    _squared_distances(points, np.ascontiguousarray(query, dtype=np.float64), found)
    return found


def weighted_sum(weights: Array, rows: Array) -> Array:
    """Return ``sum_k w_k row_k``; rows without weight are not read.  (N,), (N, m) -> (m,)."""
    total = np.zeros(rows.shape[1])
    _weighted_sum(weights, rows, total)
    return total


# reassociation lets the sum over r be done in vectors; no law rests on its order
@kernel(fastmath={"reassoc", "contract"})
def _squared_distances(
    points: NDArray[np.float64], query: NDArray[np.float64], found: NDArray[np.float64]
) -> None:
    for k in range(points.shape[0]):
        total = 0.0
        for r in range(points.shape[1]):
            d = points[k, r] - query[r]
            total += d * d
        found[k] = total


@kernel()
def _weighted_sum(
    weights: NDArray[np.float64], rows: NDArray[np.float64], total: NDArray[np.float64]
) -> None:
    n, m = rows.shape
    part = np.empty(m)
    for start in range(0, n, _BLOCK):
        part[:] = 0.0
        for k in range(start, min(start + _BLOCK, n)):
            w = weights[k]
            if w > 0.0:
                for i in range(m):
                    part[i] += w * rows[k, i]
        for i in range(m):
            total[i] += part[i]
