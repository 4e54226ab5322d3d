"""Poses over time: remembered as they come, looked up between those that are known."""

from __future__ import annotations

import bisect
import itertools
import math
from array import array
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.se3 import Array

GAP_S = 2.0  # poses farther apart are not interpolated, if nothing else is said

_MIN_STEP_S = 0.01
_UNIT_TOLERANCE = 0.1  # quaternions farther from unit length are damaged, not merely rounded
_N_CELLS = 12  # numbers of a pose: the first three rows of its matrix


class PoseError(Cello3dError):
    """A pose cannot be used or had; the text says why."""


class PoseNotYetError(PoseError):
    """The stamp is later than the newest pose: waiting may help."""


class PoseMissingError(PoseError):
    """The stamp is before the oldest pose or in a gap: waiting does not help."""


def checked_pose(position: Any, rotation: Any) -> Array:
    """Return the (4, 4) pose of a position x y z and a quaternion x y z w.  Raises PoseError.

    Both have their numbers as attributes, as messages do.
    """
    p = np.array([position.x, position.y, position.z], dtype=np.float64)
    q = np.array([rotation.x, rotation.y, rotation.z, rotation.w], dtype=np.float64)
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise PoseError("the pose is not finite")
    norm = float(np.linalg.norm(q))
    if norm < 1e-6:
        raise PoseError("the quaternion is zero")
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise PoseError(f"the quaternion has length {norm:.3g}, not 1")
    return se3.pose(p, q / norm)


class PoseTrack:
    """Poses in order of time; a look-up interpolates (SLERP and a line) or says why not."""

    def __init__(
        self,
        gap_s: float = GAP_S,
        length_s: float = math.inf,
        max_poses: int = 100_000_000,
        what: str = "pose",
    ) -> None:
        """Do not interpolate between poses ``gap_s`` apart; remember the last ``length_s``.

        what: the name of the poses in sentences.
        """
        self.gap_s, self.what = gap_s, what
        self._length_s, self._max_poses = length_s, max_poses
        self._stamps, self._cells = array("q"), array("d")

    @classmethod
    def of_poses(cls, stamps_ns: ArrayLike, T: ArrayLike, gap_s: float = GAP_S) -> PoseTrack:
        """Return the track of poses (n, 4, 4), in any order; of one stamp the last given counts.

        Raises PoseError for a pose that is not finite.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64).reshape(-1)
        cells = np.asarray(T, dtype=np.float64).reshape(-1, 4, 4)[:, :3].reshape(-1, _N_CELLS)
        bad = ~np.isfinite(cells).all(axis=1)
        if bad.any():
            raise PoseError(f"pose {int(np.argmax(bad))} is not finite or has no rotation")
        order = np.argsort(stamps, kind="stable")
        keep = order[np.append(np.diff(stamps[order]) > 0, True)[: len(order)]]
        track = cls(gap_s)
        track._stamps.frombytes(stamps[keep].tobytes())
        track._cells.frombytes(cells[keep].tobytes())
        return track

    @classmethod
    def of_rows(cls, stamps_ns: ArrayLike, rows: ArrayLike, gap_s: float = GAP_S) -> PoseTrack:
        """Return the track of rows (n, 7): position x y z and quaternion x y z w, as of_poses."""
        rows = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
        norms = np.linalg.norm(rows[:, 3:], axis=1)
        with np.errstate(invalid="ignore"):
            bad = ~np.isfinite(rows).all(axis=1) | ~(norms > 1e-6)
        T = np.full((len(rows), 4, 4), np.nan)
        if len(rows) and not bad.all():
            T[~bad] = se3.pose(rows[~bad, :3], rows[~bad, 3:])
        return cls.of_poses(stamps_ns, T, gap_s)

    def __len__(self) -> int:
        return len(self._stamps)

    def __iter__(self) -> Iterator[tuple[int, Array]]:
        for k in range(len(self)):
            yield self._stamps[k], self._pose(k)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """All stamps, in order.  (n,)."""
        return np.array(self._stamps, dtype=np.int64)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose, or None."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget everything: time has jumped."""
        del self._stamps[:], self._cells[:]

    def add(self, stamp_ns: int, T: Array) -> None:
        """Remember a pose (4, 4); one of the same stamp is replaced.

        Raises PoseError, and nothing has changed, for a pose that is none or too old to keep.
        """
        if not se3.is_rigid(T):
            raise PoseError("the pose is not finite or not rigid")
        cells = array("d", np.asarray(T, dtype=np.float64)[:3].tobytes())
        k = bisect.bisect_left(self._stamps, stamp_ns)
        if k < len(self) and self._stamps[k] == stamp_ns:
            self._cells[_N_CELLS * k : _N_CELLS * (k + 1)] = cells
            return
        if self._stamps and stamp_ns < self._oldest_kept_ns(self._stamps[-1]):
            late_s = 1e-9 * (self._stamps[-1] - stamp_ns)
            raise PoseError(f"the stamp is {late_s:.3f} s older than the newest one")
        self._stamps.insert(k, stamp_ns)
        self._cells[_N_CELLS * k : _N_CELLS * k] = cells
        n_old = bisect.bisect_left(self._stamps, self._oldest_kept_ns(self._stamps[-1]))
        n_old = max(n_old, len(self) - self._max_poses)
        del self._stamps[:n_old], self._cells[: _N_CELLS * n_old]

    def at(self, stamp_ns: int) -> Array | None:
        """Return the (4, 4) pose at a stamp, or None."""
        try:
            return self.pose(stamp_ns)
        except PoseError:
            return None

    def near(self, stamp_ns: int, tolerance_ns: int = 1_000_000) -> Array | None:
        """Return ``at`` a stamp, or the first or last pose when just outside of the track."""
        if not self._stamps:
            return None
        first, last = self._stamps[0], self._stamps[-1]
        if first - tolerance_ns <= stamp_ns <= last + tolerance_ns:
            return self.at(min(max(stamp_ns, first), last))
        return None

    def pose(self, stamp_ns: int) -> Array:
        """Return the (4, 4) pose at a stamp.

        Raises PoseNotYetError when the stamp is later than the newest pose, and PoseMissingError
        when it is before the oldest or between poses too far apart.
        """
        self._check_not_later(stamp_ns)
        after = bisect.bisect_left(self._stamps, stamp_ns)
        if self._stamps[after] == stamp_ns:
            return self._pose(after)
        if after == 0:
            raise PoseMissingError(
                f"the oldest {self.what} is {1e-9 * (self._stamps[0] - stamp_ns):.3f} s newer"
            )
        before_ns, after_ns = self._stamps[after - 1], self._stamps[after]
        if (gap_s := 1e-9 * (after_ns - before_ns)) > self.gap_s:
            raise PoseMissingError(
                f"the {self.what} around it is {gap_s:.3f} s apart, more than {self.gap_s} s"
            )
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        return se3.interpolate(self._pose(after - 1), self._pose(after), share)

    def nearest(self, stamp_ns: int, tolerance_s: float) -> Array:
        """Return the (4, 4) pose of the nearest stamp, at most ``tolerance_s`` away.

        Nothing is interpolated: a registration has no pose between two clouds.  Raises
        PoseNotYetError when it may still come and PoseMissingError when it will not.
        """
        tolerance_ns = int(tolerance_s * 1e9)
        self._check_not_later(stamp_ns - tolerance_ns)
        after = bisect.bisect_left(self._stamps, stamp_ns)
        near = min(
            range(max(after - 1, 0), min(after + 1, len(self))),
            key=lambda i: abs(self._stamps[i] - stamp_ns),
        )
        apart_ns = abs(self._stamps[near] - stamp_ns)
        if apart_ns > tolerance_ns:
            raise PoseMissingError(
                f"the nearest {self.what} is {1e-9 * apart_ns:.3f} s away, "
                f"more than {tolerance_s:g} s"
            )
        return self._pose(near)

    def extrapolated(self, stamp_ns: int, limit_s: float) -> Array:
        """Return the (4, 4) pose at a stamp after the newest, at the twist of the last two poses.

        ``T_1 exp(s log(T_0^-1 T_1))``.  Raises PoseMissingError when there are no two poses close
        enough in time or the newest is ``limit_s`` older.
        """
        if len(self) < 2:
            raise PoseMissingError(f"no two messages of {self.what} to extrapolate from")
        before_ns, last_ns = self._stamps[-2:]
        ahead_s = 1e-9 * (stamp_ns - last_ns)
        if not 0.0 <= ahead_s <= limit_s or last_ns - before_ns > self.gap_s * 1e9:
            raise PoseMissingError(
                f"the newest {self.what} is {ahead_s:.3f} s older, too much to extrapolate"
            )
        T0, T1 = self._pose(len(self) - 2), self._pose(len(self) - 1)
        share = (stamp_ns - last_ns) / (last_ns - before_ns)
        return np.asarray(T1 @ se3.exp(share * se3.log(se3.inverse(T0) @ T1)))

    def speed_to(self, stamp_ns: int, T: Array) -> float:
        """Return the speed in m/s at which the newest pose would lead to another, or 0.

        Of poses less than 10 ms apart as if they were 10 ms apart: noise is no jump.
        """
        if not self._stamps or stamp_ns <= self._stamps[-1]:
            return 0.0
        way_m = float(np.linalg.norm(T[:3, 3] - self._pose(len(self) - 1)[:3, 3]))
        return way_m / max(1e-9 * (stamp_ns - self._stamps[-1]), _MIN_STEP_S)

    def covers(self, first_ns: int, last_ns: int) -> bool:
        """Return whether there is a pose at all times from the first to the last."""
        if not self._stamps or first_ns < self._stamps[0] or last_ns > self._stamps[-1]:
            return False
        first, last = self._around(first_ns, last_ns)
        stamps = self._stamps[first : last + 1]
        return all(b - a <= 1e9 * self.gap_s for a, b in itertools.pairwise(stamps))

    def covers_sweep(self, stamp_ns: int, first_s: float, last_s: float) -> bool:
        """Return whether there is a pose at a stamp and from ``first_s`` to ``last_s`` after."""
        return self.covers(*_ends_ns(stamp_ns, first_s, last_s))

    def motion(self, stamp_ns: int, first_s: float, last_s: float) -> Motion:
        """Return the motion seen from a stamp, from ``first_s`` to ``last_s`` after it.

        Between two poses of the track it is the geodesic ``T_0 exp(s log(T_0^-1 T_1))`` of SE(3).
        All of these times are covered by the track.
        """
        if len(self) == 1:
            return Motion.constant(np.zeros(6))
        first, last = self._around(*_ends_ns(stamp_ns, first_s, last_s))
        stamps = np.array(self._stamps[first : last + 1], dtype=np.int64)
        at_s = 1e-9 * (stamps - stamp_ns).astype(np.float64)
        T = np.stack([self._pose(i) for i in range(first, last + 1)])
        velocity = se3.log(se3.inverse(T[:-1]) @ T[1:]) / np.diff(at_s)[:, None]
        there = Motion(at_s[:-1], T[:-1], velocity)
        return there._replace(T=se3.inverse(there.at([0.0])) @ there.T)

    def is_constant(self, tolerance: float = 1e-6) -> bool:
        """Return whether all poses are alike to a tolerance, in metres and entries of R."""
        cells = np.array(self._cells).reshape(-1, _N_CELLS)
        return len(cells) > 0 and bool(np.ptp(cells, axis=0).max() <= tolerance)

    def _around(self, first_ns: int, last_ns: int) -> tuple[int, int]:
        """Return the numbers of two or more poses between which two times lie, if there are."""
        first = max(bisect.bisect_right(self._stamps, first_ns) - 1, 0)
        last = min(bisect.bisect_left(self._stamps, last_ns), len(self) - 1)
        last = min(max(last, first + 1), len(self) - 1)
        return min(first, max(last - 1, 0)), last

    def _pose(self, k: int) -> Array:
        T = np.eye(4)
        T[:3] = np.reshape(self._cells[_N_CELLS * k : _N_CELLS * (k + 1)], (3, 4))
        return T

    def _oldest_kept_ns(self, newest_ns: int) -> float:
        return newest_ns - 1e9 * self._length_s

    def _check_not_later(self, stamp_ns: int) -> None:
        if not self._stamps:
            raise PoseNotYetError(f"no {self.what} has been received")
        if stamp_ns > self._stamps[-1]:
            late_s = 1e-9 * (stamp_ns - self._stamps[-1])
            raise PoseNotYetError(f"the newest {self.what} is {late_s:.3f} s older")


def _ends_ns(stamp_ns: int, first_s: float, last_s: float) -> tuple[int, int]:
    """Return the first and the last time of a sweep and its stamp."""
    first, last = math.floor(min(first_s, 0.0) * 1e9), math.ceil(max(last_s, 0.0) * 1e9)
    return stamp_ns + first, stamp_ns + last
