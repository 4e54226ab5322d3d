"""Odometry remembered for a while and interpolated at the stamps of clouds.  Imports no ROS."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

import numpy as np

from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array

_UNIT_TOLERANCE = 0.1  # quaternions farther from unit length are damaged, not merely rounded


class OdometryError(Cello3dError):
    """An odometry message cannot be used; the text says why."""


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

    def __init__(self, length_s: float, gap_s: float, max_entries: int = 100_000) -> None:
        """Remember ``length_s`` seconds; do not interpolate between poses ``gap_s`` apart."""
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
        if not self._stamps:
            raise OdometryNotYetError("no odometry has been received")
        if stamp_ns > self._stamps[-1]:
            late_s = 1e-9 * (stamp_ns - self._stamps[-1])
            raise OdometryNotYetError(f"the newest odometry is {late_s:.3f} s older")
        after = bisect.bisect_left(self._stamps, stamp_ns)
        if self._stamps[after] == stamp_ns:
            return self._poses[after].copy()
        if after == 0:
            raise OdometryMissingError(
                f"the oldest odometry is {1e-9 * (self._stamps[0] - stamp_ns):.3f} s newer"
            )
        gap_ns = self._stamps[after] - self._stamps[after - 1]
        if gap_ns > self.gap_s * 1e9:
            raise OdometryMissingError(
                f"the odometry around it is {1e-9 * gap_ns:.3f} s apart, more than {self.gap_s} s"
            )
        share = (stamp_ns - self._stamps[after - 1]) / gap_ns
        return se3.interpolate(self._poses[after - 1], self._poses[after], share)
