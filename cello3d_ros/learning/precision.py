"""How well a number of samples determines a covariance."""

from __future__ import annotations

import numpy as np

from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import Array


def eigenvalue_errors(xi: Array) -> Array:
    """Return the relative standard errors (6,) of the eigenvalues of Y, in increasing order.

    xi: (n, 6) errors about ground truth, whose covariance about zero is Y.  Along an eigenvector
    v of Y, the eigenvalue is the mean of ``(v^T xi)^2``, so to first order its standard error is
    that of a mean: ``std((v^T xi)^2) / sqrt(n)``.  For Gaussian errors the ratio to the
    eigenvalue is ``sqrt(2 / n)``; heavy tails need more samples, an offset from the truth that
    outweighs the scatter needs fewer.
    Source: Anderson, Asymptotic Theory for Principal Component Analysis, 1963, with the fourth
    moments taken from the samples.
    """
    values, vectors = np.linalg.eigh(sampled_covariance(xi))
    squares = (xi @ vectors) ** 2
    return np.asarray(squares.std(axis=0, ddof=1) / np.sqrt(len(xi)) / values)
