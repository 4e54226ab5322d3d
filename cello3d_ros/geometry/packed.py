"""Symmetric 6x6 matrices as their upper triangles, 21 numbers, where many are summed."""

from __future__ import annotations

import numpy as np

from cello3d_ros.geometry.se3 import Array

_ROWS, _COLUMNS = np.triu_indices(6)
_PLACES = 6 * _ROWS + _COLUMNS

#: (21,) how often each packed number stands in its matrix: ``tr(A B) = (A * TWICE) @ B``, packed.
TWICE: Array = np.where(_ROWS == _COLUMNS, 1.0, 2.0)


def pack(Y: Array) -> Array:
    """Return the upper triangles, row by row.  (..., 6, 6) -> (..., 21)."""
    return np.take(Y.reshape(*Y.shape[:-2], 36), _PLACES, axis=-1)


def unpack(packed: Array) -> Array:
    """Return the symmetric matrices of which these are the upper triangles."""
    Y = np.empty((*packed.shape[:-1], 6, 6))
    Y[..., _ROWS, _COLUMNS] = packed
    Y[..., _COLUMNS, _ROWS] = packed
    return Y
