"""Poses remembered for a while and looked up at the stamps of clouds.  Imports no ROS."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

import numpy as np

from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array

_MIN_STEP_S = 0.01
_UNIT_TOLERANCE = 0.1  # quaternions farther from unit length are damaged, not merely rounded


class OdometryError(Cello3dError):
    """A pose cannot be used or had; the text says why."""


class OdometryNotYetError(OdometryError):
    """The stamp is later than the newest odometry: waiting may help."""


class OdometryMissingError(OdometryError):
    """The stamp is before the oldest odometry or in a gap: waiting does not help."""


def checked_pose(translation: Sequence[float], quaternion: Sequence[float]) -> Array:
    """Return the (4, 4) pose of x y z and qx qy qz qw.  Raises OdometryError."""
    numbers = np.array([*translation, *quaternion], dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise OdometryError("the pose is not finite")
    norm = float(np.linalg.norm(numbers[3:]))
    if norm < 1e-6:
        raise OdometryError("the quaternion is zero")
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise OdometryError(f"the quaternion has length {norm:.3g}, not 1")
    return se3.pose(numbers[:3], numbers[3:] / norm)


class OdometryBuffer:
    """Poses in order of time, bounded in time; a look-up interpolates (SLERP) or says why not."""

    def __init__(
        self,
        length_s: float,
        gap_s: float,
        max_entries: int = 100_000,
        what: str = "odometry",
    ) -> None:
        """Remember ``length_s`` seconds; do not interpolate between poses ``gap_s`` apart.

        what: the name of the poses in sentences.
        """
        self.what = what
        self._length_ns = int(length_s * 1e9)
        self.gap_s = gap_s
        self._max_entries = max_entries
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose, or None."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget everything: time has jumped."""
        self._stamps.clear()
        self._poses.clear()

    def add(self, stamp_ns: int, T: Array) -> None:
        """Remember a pose later than all before.  Raises OdometryError and remembers nothing."""
        if not se3.is_rigid(T):
            raise OdometryError("the pose is not finite or not rigid")
        if self._stamps and stamp_ns <= self._stamps[-1]:
            late_s = 1e-9 * (self._stamps[-1] - stamp_ns)
            what = f"{late_s:.3f} s older than" if late_s else "the same as that of"
            raise OdometryError(f"the stamp is {what} the message before")
        self._stamps.append(stamp_ns)
        self._poses.append(np.array(T, dtype=np.float64))
        n_old = bisect.bisect_left(self._stamps, stamp_ns - self._length_ns)
        n_old = max(n_old, len(self._stamps) - self._max_entries)
        del self._stamps[:n_old], self._poses[:n_old]

    def at(self, stamp_ns: int) -> Array:
        """Return the (4, 4) pose at a stamp.

        Raises OdometryNotYetError when the stamp is later than the newest pose, and
        OdometryMissingError when it is before the oldest or between poses too far apart.
        """
        self._check_not_later(stamp_ns)
        after = bisect.bisect_left(self._stamps, stamp_ns)
        if self._stamps[after] == stamp_ns:
            return self._poses[after].copy()
        if after == 0:
            raise OdometryMissingError(
                f"the oldest {self.what} is {1e-9 * (self._stamps[0] - stamp_ns):.3f} s newer"
            )
        gap_ns = self._stamps[after] - self._stamps[after - 1]
        if gap_ns > self.gap_s * 1e9:
            raise OdometryMissingError(
                f"the {self.what} around it is {1e-9 * gap_ns:.3f} s apart, "
                f"more than {self.gap_s} s"
            )
        share = (stamp_ns - self._stamps[after - 1]) / gap_ns
        return se3.interpolate(self._poses[after - 1], self._poses[after], share)

    def nearest(self, stamp_ns: int, tolerance_s: float) -> Array:
        """Return the (4, 4) pose of the nearest stamp, at most ``tolerance_s`` away.

        Nothing is interpolated: a registration has no pose between two clouds.  Raises
        OdometryNotYetError when it may still come and OdometryMissingError when it will not.
        """
        tolerance_ns = int(tolerance_s * 1e9)
        self._check_not_later(stamp_ns - tolerance_ns)
        after = bisect.bisect_left(self._stamps, stamp_ns)
        near = min(
            range(max(after - 1, 0), min(after + 1, len(self._stamps))),
            key=lambda i: abs(self._stamps[i] - stamp_ns),
        )
        apart_ns = abs(self._stamps[near] - stamp_ns)
        if apart_ns > tolerance_ns:
            raise OdometryMissingError(
                f"the nearest {self.what} is {1e-9 * apart_ns:.3f} s away, "
                f"more than {tolerance_s:g} s"
            )
        return self._poses[near].copy()

    def extrapolated(self, stamp_ns: int, limit_s: float) -> Array:
        """Return the (4, 4) pose at a stamp after the newest, at the twist of the last two poses.

        ``T_1 exp(s log(T_0^-1 T_1))``.  Raises OdometryMissingError when there are no two poses
        close enough in time or the newest is ``limit_s`` older.
        """
        if len(self._stamps) < 2:
            raise OdometryMissingError(f"no two messages of {self.what} to extrapolate from")
        (before_ns, last_ns), (T0, T1) = self._stamps[-2:], self._poses[-2:]
        ahead_s = 1e-9 * (stamp_ns - last_ns)
        if not 0.0 <= ahead_s <= limit_s or last_ns - before_ns > self.gap_s * 1e9:
            raise OdometryMissingError(
                f"the newest {self.what} is {ahead_s:.3f} s older, too much to extrapolate"
            )
        share = (stamp_ns - last_ns) / (last_ns - before_ns)
        return np.asarray(T1 @ se3.exp(share * se3.log(se3.inverse(T0) @ T1)))

    def speed_to(self, stamp_ns: int, T: Array) -> float:
        """Return the speed in m/s at which the newest pose would lead to another, or 0.

        Of poses less than 10 ms apart as if they were 10 ms apart: noise is no jump.
        """
        if not self._stamps or stamp_ns <= self._stamps[-1]:
            return 0.0
        way_m = float(np.linalg.norm(T[:3, 3] - self._poses[-1][:3, 3]))
        return way_m / max(1e-9 * (stamp_ns - self._stamps[-1]), _MIN_STEP_S)

    def _check_not_later(self, stamp_ns: int) -> None:
        if not self._stamps:
            raise OdometryNotYetError(f"no {self.what} has been received")
        if stamp_ns > self._stamps[-1]:
            late_s = 1e-9 * (stamp_ns - self._stamps[-1])
            raise OdometryNotYetError(f"the newest {self.what} is {late_s:.3f} s older")


class PoseSource:
    """One stream of poses and the frames it speaks of.

    epoch: how often the stream has begun anew: at its first pose, after a jump and after a change
    of frames.  Poses of two epochs have nothing to do with each other.
    """

    def __init__(self, poses: OdometryBuffer) -> None:
        self.poses = poses
        self.frame_id = self.child_frame_id = ""
        self.epoch = 0

    def hear(
        self, stamp_ns: int, T: Array, frame_id: str, child_frame_id: str, max_speed_m_s: float
    ) -> str:
        """Remember a pose; return why a new epoch begins with it, or "".

        Raises OdometryError, and nothing has changed, when the pose is none or not later.
        """
        break_ = self._break(stamp_ns, T, frame_id, child_frame_id, max_speed_m_s)
        newest_ns = self.poses.newest_ns
        if break_ and se3.is_rigid(T) and (newest_ns is None or newest_ns < stamp_ns):
            self.poses.clear()
        self.poses.add(stamp_ns, T)
        self.epoch += bool(break_) or self.epoch == 0
        self.frame_id, self.child_frame_id = frame_id, child_frame_id
        return break_

    def _break(
        self, stamp_ns: int, T: Array, frame_id: str, child_frame_id: str, max_speed_m_s: float
    ) -> str:
        what = self.poses.what
        if self.epoch == 0:
            return ""
        for name, old, new in (
            ("frame_id", self.frame_id, frame_id),
            ("child_frame_id", self.child_frame_id, child_frame_id),
        ):
            if old != new:
                return f"the {name} of the {what} changed from {old!r} to {new!r}"
        speed = self.poses.speed_to(stamp_ns, T)
        if speed > max_speed_m_s:
            return f"the {what} jumped: {speed:.1f} m/s, more than {max_speed_m_s:g} m/s"
        return ""
