"""What the errors of registrations that follow each other have in common, found in examples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.geometry.gaussian import INDEPENDENT, Bias, motion_m
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.examples import Examples

_WAYS_M = 2.0 ** np.arange(-1, 7)  # that are tried
_FEWEST = 20  # products of two steps, below which they tell nothing
_LARGEST = 2.0  # times the median error, as which a larger one counts


def measured_bias(examples: Examples, shape: str) -> Bias:
    """Return the bias whose correlations are most like those of steps of the same recording.

    A step is a pair of neighbouring scans, m its mean error in units of its shape. ``share
    exp(-d / way)``, d the way from one step to the other, is fitted to the products ``m_k . m_l``
    over the mean square of an error, in least squares.  Nothing is in common where the shape is
    none, as in the paper; too few steps give the default.
    """
    if shape == "none":
        return INDEPENDENT
    rows = np.flatnonzero(np.diff(examples.scans, axis=1)[:, 0] == 1)
    if not len(rows):
        return Bias()
    means, square = _errors([examples.xi[k] for k in rows], examples.shapes[shape][rows])
    way_m = np.array([motion_m(T) for T in examples.T_mean[rows]])
    products, apart_m = [np.zeros(0)], [np.zeros(0)]
    for some in _stretches(examples.groups[rows], examples.scans[rows, 0]):
        before_m = np.cumsum(way_m[some]) - way_m[some]
        first, second = np.triu_indices(len(some), 1)
        products.append(np.sum(means[some][first] * means[some][second], axis=1) / square)
        apart_m.append(before_m[second] - before_m[first])
    return _fitted(np.concatenate(products), np.concatenate(apart_m))


def _errors(xi: list[Array], shapes: Array) -> tuple[Array, float]:
    """Return the mean errors (n, 6) in units of the shapes, and the mean square of an error."""
    roots = np.linalg.cholesky(shapes)
    white = [np.linalg.solve(L, e.T).T for L, e in zip(roots, xi, strict=True)]
    squares = np.array([np.mean(np.sum(e**2, axis=1)) for e in white])
    shrink = np.minimum(1.0, _LARGEST * np.sqrt(np.median(squares) / squares))
    means = shrink[:, None] * np.array([e.mean(axis=0) for e in white])
    return means, float(np.mean(shrink**2 * squares))


def _stretches(groups: NDArray[np.str_], first: NDArray[np.int64]) -> Iterator[NDArray[np.intp]]:
    """Yield the rows of steps that follow each other without a gap, in one recording."""
    order = np.lexsort((first, groups))
    ends = (groups[order][1:] != groups[order][:-1]) | (np.diff(first[order]) != 1)
    yield from np.split(order, np.flatnonzero(ends) + 1)


def _fitted(products: Array, apart_m: Array) -> Bias:
    if len(products) < _FEWEST:
        return Bias()
    found = []
    for way_m in _WAYS_M:
        left = np.exp(-apart_m / way_m)
        share = float(np.clip(products @ left / (left @ left), 0.0, 1.0))
        found.append((float(np.sum((products - share * left) ** 2)), share, float(way_m)))
    _, share, way_m = min(found)
    return Bias(share, way_m)
