"""What the errors of registrations that follow each other have in common, found in examples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.geometry.gaussian import Bias, motion_m
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.examples import Examples

_WAYS_M = 2.0 ** np.arange(-1, 7)  # that are tried
_FEWEST = 20  # products of two steps, below which they tell nothing
_LARGEST = 2.0  # times the median error, as which a larger one counts


def measured_bias(examples: Examples, predicted: Array) -> Bias:
    """Return the bias whose correlations are most like those of steps of the same recording.

    predicted: (N, 6, 6), what the model says of each pair, seen from other recordings.  A step is
    a pair of neighbouring scans, m its mean error in units of the prediction.  ``6 share exp(-d /
    way)``, d the way from one step to the other, is fitted to the products ``m_k . m_l`` in least
    squares, as ``extended`` takes them; too few steps give the default.  Pairs that are seen from
    several views have another scanner in each, so that what one scanner does to all its steps is
    not in it.
    """
    rows = np.flatnonzero(np.diff(examples.scans, axis=1)[:, 0] == 1)
    if not len(rows) or not examples.xi:
        return Bias()
    means = _mean_errors([examples.xi[k] for k in rows], predicted[rows])
    way_m = np.array([motion_m(T) for T in examples.T_mean[rows]])
    products, apart_m = [np.zeros(0)], [np.zeros(0)]
    for some in _stretches(examples.groups[rows], examples.scans[rows, 0]):
        at_m = np.cumsum(way_m[some])  # a bias fades over the motion of the later step
        first, second = np.triu_indices(len(some), 1)
        products.append(np.sum(means[some][first] * means[some][second], axis=1) / 6.0)
        apart_m.append(at_m[second] - at_m[first])
    return _fitted(np.concatenate(products), np.concatenate(apart_m))


def _mean_errors(xi: list[Array], predicted: Array) -> Array:
    """Return the mean errors (n, 6) in units of what is predicted, none much above the median."""
    roots = np.linalg.cholesky(predicted)
    white = [np.linalg.solve(L, e.T).T for L, e in zip(roots, xi, strict=True)]
    sizes = np.sqrt([np.mean(np.sum(e**2, axis=1)) for e in white])
    most = _LARGEST * np.median(sizes)
    means = np.array([e.mean(axis=0) for e in white])
    return np.asarray(means * (most / np.maximum(sizes, most))[:, None])


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
