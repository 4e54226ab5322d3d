"""Registrations that probably ended in a wrong minimum, found by their sandwich.

In a wrong minimum surfaces do not lie on each other: what residuals are left pull in all
directions, and ``H^-1 (sum g g^T) H^-1`` is several times as large as in the right one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.gaussian import larger
from cello3d_ros.geometry.se3 import Array


class Lost(NamedTuple):
    """What a model knows of registrations in other minima than that of the truth.

    limit_m: a sandwich that is wider in translation is taken for that of such a registration.
    covariance: (6, 6), ``sampled_covariance`` of those met in sampling, reading side: about the
    truth, not about their mean.
    """

    limit_m: float
    covariance: Array


def spread_m(sandwich: ArrayLike) -> Array:
    """Return the standard deviation in translation, all directions together.  (..., 6, 6)."""
    S = np.asarray(sandwich, dtype=np.float64)
    return np.asarray(np.sqrt(np.trace(S[..., :3, :3], axis1=-2, axis2=-1)))


def is_lost(sandwich: Array, known: Lost | None) -> bool:
    """Return whether a registration with this sandwich is probably in another minimum."""
    return known is not None and bool(spread_m(sandwich) > known.limit_m)


def covering(Y: Array, known: Lost) -> Array:
    """Return the larger of a covariance (6, 6) of one minimum and the scatter over the others."""
    return larger(known.covariance, Y)
