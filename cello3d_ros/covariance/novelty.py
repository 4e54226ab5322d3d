"""How far from every training example a pair may be before the model knows little of it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from cello3d_ros.covariance.model import Model
from cello3d_ros.geometry.se3 import Array

_MAX_QUERIES = 2000  # examples asked for their nearest, evenly spread over the training set


def rho_limit(model: Model, quantile: float) -> float:
    """Return the quantile of the training examples' squared distances to their nearest.

    A pair with a larger ``nearest_rho`` is farther from every example than that share of the
    examples is from all other recordings.  inf where nothing can be said: a model of one
    recording or of one example.
    """
    nearest = nearest_rhos(model)
    return float(np.quantile(nearest, quantile)) if len(nearest) else math.inf


def nearest_rhos(model: Model) -> Array:
    """Return rho from examples as recorded (not turned) to the nearest of another recording.

    (at most 2000,), or empty when there is one recording only.
    """
    group = _recordings(model)
    if (group == group[0]).all():
        return np.empty(0)
    n_turns = len(model.provenance.get("rotations_rad", [0.0]))
    queries = np.arange(0, model.n_examples, n_turns)
    queries = queries[:: -(-len(queries) // _MAX_QUERIES)]
    rho = cdist(model.projections[queries], model.projections, "sqeuclidean")
    rho[group[queries][:, None] == group] = np.inf
    return np.asarray(rho.min(axis=1))


def _recordings(model: Model) -> NDArray[np.int64]:
    """Return the number of each example's recording (N,); each its own where that is unknown.

    Examples stand recording by recording, pair by pair, turn by turn.
    """
    n_pairs = model.provenance.get("recordings", {})
    n_turns = len(model.provenance.get("rotations_rad", [0.0]))
    counts = list(n_pairs.values()) if isinstance(n_pairs, dict) else []
    if sum(counts) * n_turns != model.n_examples:
        return np.arange(model.n_examples) // n_turns
    return np.repeat(np.arange(len(counts)), np.array(counts, dtype=np.int64) * n_turns)
