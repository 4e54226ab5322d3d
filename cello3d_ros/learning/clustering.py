"""Which sampled registrations converged: the cluster nearest to ground truth (Sec. IV-D).

Source: DBSCAN as in Schubert et al. 2017, by scikit-learn.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FEWEST_IN_CORE = 2  # a sample alone is no cluster


def nearest_cluster(
    xi: Array, scale_m: float, scale_rad: float, min_share: float
) -> NDArray[np.bool_]:
    """Return which registrations belong to the cluster nearest to ground truth.

    xi: (n, 6) errors (u, omega) about ground truth.  Returns (n,), all False without a cluster.

    The distance is that of ``(u / scale_m, omega / scale_rad)``, the radius of DBSCAN is 1, and a
    core sample has at least ``max(2, ceil(min_share n))`` samples within it, itself included.
    The cluster nearest to ground truth is the one with the core sample nearest to zero.  Its mean
    would mislead: the ring of upside-down registrations of the paper's cylinder surrounds ground
    truth, so that its mean lies there too, while none of its members does.
    """
    from sklearn.cluster import DBSCAN  # slow to import, needed for sampling only

    n_samples = len(xi)
    kept = np.zeros(n_samples, dtype=np.bool_)
    if n_samples == 0:
        return kept
    scaled = xi / np.repeat([scale_m, scale_rad], 3)
    least = max(_FEWEST_IN_CORE, math.ceil(min_share * n_samples))
    found = DBSCAN(eps=1.0, min_samples=least).fit(scaled)
    core = found.core_sample_indices_
    if len(core) == 0:
        return kept
    nearest = core[np.argmin(np.einsum("ni,ni->n", scaled[core], scaled[core]))]
    return np.asarray(found.labels_ == found.labels_[nearest])


def offset(xi: Array) -> tuple[float, float]:
    """Return the norms of the mean translation (m) and the mean rotation (rad).

    xi: (n, 6), all registrations of a pair before clustering: pairs whose mean lies more than 1 m
    or 1 rad from ground truth fail consistently and do not enter a dataset (Sec. V-A).
    """
    mean = np.mean(xi, axis=0)
    return float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))
