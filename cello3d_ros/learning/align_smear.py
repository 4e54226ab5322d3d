"""Whether motion smears the scans of a recording whose points carry no times.

A lidar that turns once from one stamp to the next sees a point at a time t that grows with its
azimuth.  Undoing a share s of its motion moves points by ``s t v`` at velocity v.  Least squares
over a few scans in a row finds s together with their poses: 0 where scans are compensated or the
sensor stood still for each of them, 1 where a turn takes all the time between stamps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.neighbors import build_tree, nearest
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, transform
from cello3d_ros.learning.align_scans import RawScan, ShapedScan, without_motion

_N_WINDOWS = 3  # about the scans that move most
_N_BESIDE = 3  # scans on either side in a window
_N_ROUNDS = 5  # of nearest points and least squares
_N_POINTS = 3000  # of each scan
_NEAR_M = 0.3  # of its nearest in the other scans
_USUAL = 3.0  # times the usual residual, beyond which a point is not used
_LEAST_M = 0.01  # motion of the surroundings within a scan, below which nothing is asked
_SMEARED = 0.2  # share above which motion smears: docs/align.md
_STARTS = np.arange(0.0, 1.0, 0.125)  # where a turn may begin, in turns


class Smear(NamedTuple):
    """What of the sensor's motion is in the clouds.

    moved_m: how far surroundings move from stamp to stamp; share: of this motion that is within a
    scan; as_is_m, undone_m: distances of points from the planes of other scans (rms), before and
    after it is undone.
    """

    moved_m: float
    share: float
    as_is_m: float
    undone_m: float

    @property
    def is_smeared(self) -> bool:
        """Whether scans fit together better with their motion undone."""
        return self.share > _SMEARED and self.undone_m < self.as_is_m


class _Window(NamedTuple):
    """Scans in a row, their motions (m, 6) from stamp to stamp, and numbers."""

    scans: list[ShapedScan]
    motions: Array
    numbers: list[int]


class _Equations(NamedTuple):
    """Residuals (N,), m; how poses (N, 6 m) and a share of the motion (N, starts) change them."""

    residuals: Array
    by_poses: Array
    by_share: Array


def smear_of(
    poses: Array,
    members: NDArray[np.int64],
    shaped: Callable[[int], ShapedScan],
    seed: int,
) -> Smear | None:
    """Ask the scans that move most what of their motion is within them; None where none moves.

    poses: (n, 4, 4), of the members at least.  shaped: gives a scan with its normals.
    """
    reach_m = float(np.median(np.linalg.norm(shaped(int(members[0])).points, axis=1)))
    motions, moved = _slower_motions(poses[members], reach_m)
    middles: list[int] = []
    for at in np.argsort(-moved, kind="stable").tolist():
        if all(abs(at - other) > 2 * _N_BESIDE for other in middles[:_N_WINDOWS]):
            middles.append(at)
    middles = middles[:_N_WINDOWS]
    if moved[middles[0]] < _LEAST_M:
        return None
    windows, placed = [], []
    for at in middles:
        rows = slice(max(0, at - _N_BESIDE), at + _N_BESIDE + 1)
        numbers = members[rows].tolist()
        windows.append(_Window([shaped(k) for k in numbers], motions[rows], numbers))
        placed.append(inverse(poses[members[at]]) @ poses[numbers])
    return Smear(float(moved[middles].mean()), *_fitted(windows, placed, seed))


def _slower_motions(poses: Array, reach_m: float) -> tuple[Array, Array]:
    """Return of each scan the step to it or from it, (m, 6) and in m, that moves less.

    The other may be a gap.
    """
    steps = log(inverse(poses[:-1]) @ poses[1:])
    steps = np.concatenate([steps[:1], steps, steps[-1:]])
    moved = np.linalg.norm(steps * np.repeat([1.0, reach_m], 3), axis=1)
    less = np.arange(len(poses)) + (moved[1:] < moved[:-1])
    return steps[less], moved[less]


def _fitted(windows: list[_Window], poses: list[Array], seed: int) -> tuple[float, float, float]:
    """Return the share of the motion, and residuals (rms) without and with it undone."""
    share, start, rms = 0.0, 0, []
    for _ in range(_N_ROUNDS + 1):
        found = [
            _equations(window, T, share, start, seed)
            for window, T in zip(windows, poses, strict=True)
        ]
        rms.append(float(np.sqrt(np.mean(np.concatenate([e.residuals for e in found]) ** 2))))
        if len(rms) > _N_ROUNDS:
            break
        bases = [np.linalg.qr(e.by_poses)[0] for e in found]
        D = np.concatenate([e.by_share - Q @ (Q.T @ e.by_share) for e, Q in zip(found, bases)])
        r = np.concatenate([e.residuals for e in found])
        if len(rms) == 1:
            start = int(np.argmax((r @ D) ** 2 / (D**2).sum(axis=0)))
        change = -float(r @ D[:, start] / (D[:, start] ** 2).sum())
        share += change
        for e, T in zip(found, poses, strict=True):
            left = e.residuals + change * e.by_share[:, start]
            x = np.linalg.lstsq(e.by_poses, -left, rcond=None)[0]
            T[:] = exp(x.reshape(-1, 6)) @ T
    return abs(share), rms[0], rms[-1]


def _equations(window: _Window, poses: Array, share: float, start: int, seed: int) -> _Equations:
    """Return the equations of points and the planes of their nearest in the other scans."""
    points, normals, motions = zip(
        *(
            _placed(scan, v, T, share, start)
            for scan, v, T in zip(window.scans, window.motions, poses, strict=True)
        )
    )
    found = []
    for a, k in enumerate(window.numbers):
        others = [b for b in range(len(points)) if b != a]
        tree = build_tree(np.concatenate([points[b] for b in others]))
        rows = subsample(len(points[a]), _N_POINTS, np.random.default_rng([seed, k]))
        near = nearest(tree, points[a][rows], 1, max_distance2=_NEAR_M**2)[1][:, 0]
        rows, near = rows[near >= 0], tree.order[near[near >= 0]]
        N = np.concatenate([normals[b] for b in others])[near]
        rows, near, N = (x[N.any(axis=1)] for x in (rows, near, N))
        p, q = points[a][rows], np.concatenate([points[b] for b in others])[near]
        whose = np.concatenate([np.full(len(points[b]), b) for b in others])[near]
        by_poses = np.zeros((len(rows), len(points), 6))
        by_poses[:, a] = np.column_stack([N, np.cross(p, N)])
        by_poses[np.arange(len(rows)), whose] = -np.column_stack([N, np.cross(q, N)])
        moves = motions[a][rows] - np.concatenate([motions[b] for b in others])[near]
        found.append(
            _Equations(
                np.einsum("ni,ni->n", N, p - q),
                by_poses.reshape(len(rows), -1),
                np.einsum("ni,nsi->ns", N, moves),
            )
        )
    all_of = _Equations(*(np.concatenate(columns) for columns in zip(*found)))
    off = np.abs(all_of.residuals - np.median(all_of.residuals))
    usual = off < _USUAL * 1.4826 * np.median(off)
    return _Equations(*(column[usual] for column in all_of))


def _placed(
    scan: ShapedScan, motion: Array, T: Array, share: float, start: int
) -> tuple[Array, Array, Array]:
    """Return points and normals (N, 3) in the frame of the window, and motions (N, starts, 3).

    motion: (6,), in one turn; the share of it that is known is undone.
    """
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2.0 * np.pi)
    turns = np.mod(azimuth[:, None] - _STARTS, 1.0) - 0.5
    own = without_motion(RawScan(scan.points, share * turns[:, start]), motion)
    whole = (motion[:3] + np.cross(motion[3:], own)) @ T[:3, :3].T
    points, normals = transform(T, own), scan.normals @ T[:3, :3].T
    return points, normals, turns[:, :, None] * whole[:, None, :]
