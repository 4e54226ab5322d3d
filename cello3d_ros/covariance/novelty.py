"""How far from every training example a pair may be before the model knows little of it."""

from __future__ import annotations

import math

import numpy as np

from cello3d_ros.covariance.model import Model


def rho_limit(model: Model, quantile: float) -> float:
    """Return the quantile of the training pairs' squared distances to their nearest example.

    A pair with a larger ``nearest_rho`` is farther from every example than that share of the
    training pairs is from all other recordings.  inf where the model does not know.
    """
    quantiles = model.rho_quantiles
    if len(quantiles) == 0:
        return math.inf
    return float(np.interp(quantile, np.linspace(0.0, 1.0, len(quantiles)), quantiles))
