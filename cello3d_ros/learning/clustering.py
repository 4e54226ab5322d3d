"""Which sampled registrations converged: the cluster nearest to ground truth (Sec. IV-D).

Source: DBSCAN as in Schubert et al. 2017, of which only one cluster is grown, so that memory
stays linear in the samples however tight they are.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FEWEST_IN_CORE = 2  # a sample alone is no cluster
_FAR = 3.0  # clustering scales from the truth beyond which a registration is in another minimum


def nearest_cluster(
    xi: Array, scale_m: float, scale_rad: float, min_share: float
) -> NDArray[np.bool_]:
    """Return which registrations belong to the cluster nearest to ground truth.

    xi: (n, 6) errors (u, omega) about ground truth.  Returns (n,), all False without a cluster.

    The distance is that of ``(u / scale_m, omega / scale_rad)``, the radius of DBSCAN is 1, and a
    core sample has at least ``max(2, ceil(min_share n))`` samples within it, itself included.
    The cluster nearest to ground truth is the one with the core sample nearest to zero.  Its mean
    would mislead: the ring of upside-down registrations of the paper's cylinder surrounds ground
    truth, so that its mean lies there too, while none of its members does.  A border sample that
    two clusters share is counted in.
    """
    if len(xi) == 0:
        return np.zeros(0, dtype=np.bool_)
    scaled = np.ascontiguousarray(xi / np.repeat([scale_m, scale_rad], 3))
    least = max(_FEWEST_IN_CORE, math.ceil(min_share * len(xi)))
    core = _core(scaled, least)
    if not core.any():
        return np.zeros(len(xi), dtype=np.bool_)
    norms2 = np.where(core, np.einsum("ni,ni->n", scaled, scaled), np.inf)
    return np.asarray(_grown(scaled, core, int(np.argmin(norms2))))


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


@njit(cache=True, nogil=True)
def _core(x: Array, least: int) -> NDArray[np.bool_]:
    """Return which of x (n, d) have ``least`` of x within distance 1, themselves included."""
    n = len(x)
    core = np.zeros(n, np.bool_)
    for i in range(n):
        n_near = 0
        for j in range(n):
            if _near(x, i, j):
                n_near += 1
                if n_near == least:
                    core[i] = True
                    break
    return core


@njit(cache=True, nogil=True)
def _grown(x: Array, core: NDArray[np.bool_], start: int) -> NDArray[np.bool_]:
    """Return what is reached from a core sample by steps of at most 1 from core samples.

    What is not yet reached stands in a list that only shrinks: a tight cluster is done after one
    pass, and the worst case is n passes over n samples.
    """
    n = len(x)
    reached = np.zeros(n, np.bool_)
    reached[start] = True
    rest = np.arange(n)
    rest[start] = n - 1
    n_rest = n - 1
    todo = np.empty(n, np.int64)
    todo[0] = start
    n_todo = 1
    while n_todo > 0:
        n_todo -= 1
        i = todo[n_todo]
        k = 0
        while k < n_rest:
            j = rest[k]
            if _near(x, i, j):
                reached[j] = True
                if core[j]:
                    todo[n_todo] = j
                    n_todo += 1
                n_rest -= 1
                rest[k] = rest[n_rest]
            else:
                k += 1
    return reached


@njit(cache=True, nogil=True, inline="always")
def _near(x: Array, i: int, j: int) -> bool:
    distance2 = 0.0
    for u in range(x.shape[1]):
        d = x[i, u] - x[j, u]
        distance2 += d * d
    return distance2 <= 1.0
