"""Which sampled registrations converged: the cluster nearest to ground truth (Sec. IV-D)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FEWEST = 2  # a sample alone is no cluster
_CHI2 = 22.458  # quantile .999 of chi-square with 6 degrees of freedom
_MOST_STEPS = 100  # of a growing cluster; it takes about ten
_FAR = 3.0  # clustering scales from the truth beyond which a registration is in another minimum


def nearest_cluster(
    xi: Array, scale_m: float, scale_rad: float, min_share: float
) -> NDArray[np.bool_]:
    """Return which registrations belong to the cluster nearest to ground truth.

    xi: (n, 6) errors (u, omega) about ground truth.  Returns (n,), all False without a cluster.

    With errors measured in scales, ``x = (u / scale_m, omega / scale_rad)``, a cluster with mean m
    and covariance C holds the samples of the ellipsoid

        (x - m)^T (chi2 C + I)^-1 (x - m) <= 1,

    chi2 the quantile .999 with 6 degrees of freedom.  It is one scale wide where the samples are
    tight and follows them where an axis is free.  It grows from the samples within one scale of
    the one nearest to the truth until nothing changes.  One with less than ``min_share`` of all
    samples is passed over, and the next sample starts another.

    Nothing here depends on n: more samples give the same cluster, known better.  Nearness is that
    of a sample, not of the mean: the ring of upside-down registrations of the paper's cylinder
    surrounds ground truth, and so its mean lies there, while none of its members does.
    """
    x = xi / np.repeat([scale_m, scale_rad], 3)
    least = max(_FEWEST, min_share * len(x))
    tried = np.zeros(len(x), dtype=np.bool_)
    for start in np.argsort(np.einsum("ni,ni->n", x, x), kind="stable"):
        if tried[start]:
            continue
        kept = _grown(x, x[start])
        if kept.sum() >= least:
            return kept
        tried |= kept
        tried[start] = True
    return np.zeros(len(x), dtype=np.bool_)


def _grown(x: Array, start: Array) -> NDArray[np.bool_]:
    """Return the cluster (n,) of x (n, 6) that grows from around a sample."""
    d = x - start
    kept = np.asarray(np.einsum("ni,ni->n", d, d) <= 1.0)
    for _ in range(_MOST_STEPS):
        d = x - x[kept].mean(axis=0)
        C = np.einsum("ni,nj->ij", d[kept], d[kept]) / kept.sum()
        information = np.linalg.inv(_CHI2 * C + np.eye(6))
        inside = np.asarray(np.einsum("ni,ij,nj->n", d, information, d) <= 1.0)
        if np.array_equal(inside, kept):
            break
        kept = inside
    return kept


def offset(xi: Array) -> tuple[float, float]:
    """Return the norms of the mean translation (m) and the mean rotation (rad).

    xi: (n, 6), all registrations of a pair before clustering: pairs whose mean lies more than 1 m
    or 1 rad from ground truth fail consistently and do not enter a dataset (Sec. V-A).
    """
    mean = np.mean(xi, axis=0)
    return float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))


def far_from_truth(xi: Array, scale_m: float, scale_rad: float) -> NDArray[np.bool_]:
    """Return which registrations ended in another minimum: more than 3 scales from the truth.

    xi: (..., 6).  Returns (...).  Unlike ``nearest_cluster`` it needs no other registrations.
    """
    return np.asarray(
        (np.linalg.norm(xi[..., :3], axis=-1) > _FAR * scale_m)
        | (np.linalg.norm(xi[..., 3:], axis=-1) > _FAR * scale_rad)
    )
