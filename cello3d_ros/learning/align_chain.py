"""The first poses of a recording: each scan registered to one before it, and where that fails.

A registration holds when enough of the reading lies on the surfaces of the reference.  Scans that
hold to one another make a part; a recording of two places makes two parts, between which no pose
is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.neighbors import nearest
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, transform
from cello3d_ros.registration.icp import register

MIN_SHARE = 0.45  # of the reading on the reference's surfaces, below which a pose is no answer
_SURE_SHARE = 0.6  # below it other starts are tried
_SURFACE_M, _NEAR_M = 0.1, 1.0  # on a surface: from the plane of the nearest point, from itself
_MAX_SKIPPED = 4  # scans between a scan and the one that it is registered to
_N_POINTS = 3000  # of the reading in a registration
_N_SEARCH = 300  # of the reading in each registration of a search
_YAWS_DEG = range(0, 360, 45)
_STEPS_M = (0.0, 4.0, 9.0)
_CONTRADICTS_M, _CONTRADICTS_RAD = 0.5, 0.2
_EVERY = 0  # reference points: all


class Link(NamedTuple):
    """A registration of scan k to the reference scan: pose (4, 4), and how well it holds."""

    reference: int
    T_ref_read: Array
    share: float


@dataclass
class Chain:
    """First poses of n scans.

    poses: (n, 4, 4), T_part_sensor.  part: (n,) number of the part, -1 where a scan holds to none.
    n_contradicted: start poses that the
    clouds contradict; n_searched: scans that needed a search.
    """

    poses: Array
    part: NDArray[np.int64]
    n_contradicted: int = 0
    n_searched: int = 0


class Placed(NamedTuple):
    """A scan of the chain: number, stamp, cloud, and where somebody says that it is, or None."""

    k: int
    stamp_ns: int
    cloud: Cloud
    T_start: Array | None


def build_chain(scans: Iterator[Placed], n_scans: int, icp: IcpConfig, seed: int) -> Chain:
    """Register each scan to the last of a part, at most 4 scans back; else it begins a part.

    Parts are tried from the longest to the shortest.  Parts of fewer than 3 scans are dropped.
    """
    chain = Chain(np.tile(np.eye(4), (n_scans, 1, 1)), np.full(n_scans, -1))
    parts: list[list[Placed]] = []  # the last two scans of each
    sizes: list[int] = []
    for scan in scans:
        open_parts = [p for p, last in enumerate(parts) if scan.k - last[-1].k <= _MAX_SKIPPED + 1]
        for p in sorted(open_parts, key=lambda p: -sizes[p]):
            link = _attach(scan, parts[p], chain, icp, seed)
            if link.share >= MIN_SHARE:
                chain.poses[scan.k] = chain.poses[link.reference] @ link.T_ref_read
                chain.part[scan.k] = p
                parts[p] = [parts[p][-1], scan]
                sizes[p] += 1
                break
        else:
            chain.part[scan.k] = len(parts)
            chain.poses[scan.k] = np.eye(4) if scan.T_start is None else scan.T_start
            parts.append([scan])
            sizes.append(1)
        for last in parts:  # clouds of closed parts are not needed any more
            if scan.k - last[-1].k > _MAX_SKIPPED + 1:
                last[:] = [last[-1]._replace(cloud=scan.cloud)]
    return _without_short_parts(chain, sizes)


def _without_short_parts(chain: Chain, sizes: Sequence[int]) -> Chain:
    """Number the parts of at least 3 scans from the longest, 0, to the shortest."""
    long = sorted((p for p, size in enumerate(sizes) if size >= 3), key=lambda p: -sizes[p])
    number = {p: k for k, p in enumerate(long)}
    chain.part = np.array([number.get(int(p), -1) for p in chain.part])
    return chain


def _attach(scan: Placed, last: Sequence[Placed], chain: Chain, icp: IcpConfig, seed: int) -> Link:
    """Return the best registration of a scan to the last of a part."""
    reference = last[-1]
    rng = np.random.default_rng([seed, scan.k, reference.k])
    told = _told(scan, reference)
    guesses = [_carried_on(scan, last, chain), np.eye(4)] if told is None else [told]
    best = _best(scan.cloud, reference.cloud, guesses, icp, rng)
    if best[1] < _SURE_SHARE:
        chain.n_searched += 1
        more = [_carried_on(scan, last, chain), np.eye(4), *_search(scan, reference, icp, rng)]
        better = _best(scan.cloud, reference.cloud, more, icp, rng)
        best = better if better[1] > best[1] else best
    if told is not None and best[1] >= MIN_SHARE:
        off = log(inverse(told) @ best[0])
        far = (
            np.linalg.norm(off[:3]) > _CONTRADICTS_M or np.linalg.norm(off[3:]) > _CONTRADICTS_RAD
        )
        chain.n_contradicted += int(far)
    return Link(reference.k, *best)


def _told(scan: Placed, reference: Placed) -> Array | None:
    if scan.T_start is None or reference.T_start is None:
        return None
    return inverse(reference.T_start) @ scan.T_start


def _carried_on(scan: Placed, last: Sequence[Placed], chain: Chain) -> Array:
    """Return the motion since the last scan of a part at the velocity between its last two."""
    if len(last) < 2:
        return np.eye(4)
    before, reference = last
    step = inverse(chain.poses[before.k]) @ chain.poses[reference.k]
    ratio = (scan.stamp_ns - reference.stamp_ns) / max(reference.stamp_ns - before.stamp_ns, 1)
    return np.asarray(exp(min(ratio, _MAX_SKIPPED + 1.0) * log(step)))


def _best(
    reading: Cloud,
    reference: Cloud,
    guesses: Sequence[Array],
    icp: IcpConfig,
    rng: np.random.Generator,
) -> tuple[Array, float]:
    """Register from each guess; return the pose that holds best.  Of equals the first wins."""
    settings = replace(icp, n_reading_points=_N_POINTS, n_reference_points=_EVERY)
    best, best_share = guesses[0], -1.0
    for guess in guesses:
        found = register(reading, reference, guess, settings, rng)
        share = share_on_surfaces(reading, reference, found.T_ref_read, rng)
        if share > best_share + 0.02:
            best, best_share = found.T_ref_read, share
    return best, best_share


def _search(
    scan: Placed, reference: Placed, icp: IcpConfig, rng: np.random.Generator
) -> list[Array]:
    """Return the best of a coarse search over yaw and horizontal steps."""
    settings = replace(icp, n_reading_points=_N_SEARCH, n_reference_points=5000, max_iterations=20)
    found: list[tuple[float, Array]] = []
    for yaw, length in product(np.radians(_YAWS_DEG), _STEPS_M):
        for heading in np.radians(range(0, 360, 45)) if length else (0.0,):
            T = exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, yaw]))
            T[:2, 3] = length * math.cos(heading), length * math.sin(heading)
            T = register(scan.cloud, reference.cloud, T, settings, rng).T_ref_read
            found.append((share_on_surfaces(scan.cloud, reference.cloud, T, rng, _N_SEARCH), T))
    return [T for _, T in sorted(found, key=lambda pair: -pair[0])[:3]]


def share_on_surfaces(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    rng: np.random.Generator,
    n_points: int = _N_POINTS,
) -> float:
    """Return the share of the reading within 0.1 m of the plane of a point at most 1 m away.

    Points whose nearest has no plane count neither way.
    """
    rows = subsample(len(reading.points), n_points, rng)
    moved = transform(T_ref_read, reading.points[rows])
    if not np.isfinite(moved).all():
        return 0.0
    _, indices = nearest(reference.tree, moved, 1, max_distance2=_NEAR_M**2)
    near = np.flatnonzero(indices[:, 0] >= 0)
    rows = indices[near, 0]
    is_plane = reference.normals[rows].any(axis=1)
    off = np.einsum("ij,ij->i", moved[near] - reference.points[rows], reference.normals[rows])
    n_on = (is_plane & (np.abs(off) < _SURFACE_M)).sum()
    return float(n_on / max(len(moved) - (~is_plane).sum(), 1))
