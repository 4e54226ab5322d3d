"""Poses over time, looked up between those that are known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array


class PoseTrack:
    """Stamped poses, looked up at any time between the first and the last."""

    def __init__(self, stamps_ns: ArrayLike, rows: ArrayLike) -> None:
        """Sort by stamp; of several poses with one stamp the last given counts.

        stamps_ns: (n,).  rows: (n, 7), position x y z and quaternion x y z w.
        Raises RecordingError for a pose that is not finite or has a quaternion of length 0.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64).reshape(-1)
        rows = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
        with np.errstate(invalid="ignore", over="ignore"):
            bad = ~np.isfinite(rows).all(axis=1) | (np.linalg.norm(rows[:, 3:], axis=1) < 1e-6)
        if bad.any():
            raise RecordingError(f"pose {int(np.argmax(bad))} is not finite or has no rotation")
        order = np.argsort(stamps, kind="stable")
        last = np.append(np.diff(stamps[order]) > 0, True)[: len(order)]
        keep = order[last]
        self.stamps_ns: NDArray[np.int64] = stamps[keep]
        self._rows: Array = rows[keep]

    @classmethod
    def of_poses(cls, stamps_ns: ArrayLike, T: ArrayLike) -> PoseTrack:
        """Return the track of poses (n, 4, 4)."""
        T = np.asarray(T, dtype=np.float64).reshape(-1, 4, 4)
        if len(T) == 0:
            return cls([], [])
        return cls(stamps_ns, np.concatenate([T[:, :3, 3], se3.quaternion(T)], axis=1))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[tuple[int, Array]]:
        for k, stamp_ns in enumerate(self.stamps_ns):
            yield int(stamp_ns), self._pose(k)

    def at(self, stamp_ns: int) -> Array | None:
        """Return the interpolated pose, or None outside the span of the track."""
        k = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if k == len(self) or (k == 0 and self.stamps_ns[0] != stamp_ns):
            return None
        if self.stamps_ns[k] == stamp_ns:
            return self._pose(k)
        before, after = int(self.stamps_ns[k - 1]), int(self.stamps_ns[k])
        share = (stamp_ns - before) / (after - before)
        return se3.interpolate(self._pose(k - 1), self._pose(k), share)

    def covers(self, first_ns: int, last_ns: int) -> bool:
        """Return whether all times from the first to the last lie in the span of the track."""
        return len(self) > 0 and bool(
            self.stamps_ns[0] <= first_ns and last_ns <= self.stamps_ns[-1]
        )

    def motion(self, stamp_ns: int, after_s: ArrayLike) -> Array:
        """Return ``T(stamp)^-1 T(stamp + after)`` (n, 4, 4), on the geodesics of SE(3).

        Between two poses of the track ``T(t) = T_0 exp(s log(T_0^-1 T_1))``.  after_s: (n,), all
        in the span of the track.
        """
        after = np.append(0.0, np.asarray(after_s, dtype=np.float64))
        at_s = 1e-9 * (self.stamps_ns - stamp_ns).astype(np.float64)
        if len(self) == 1:
            return np.tile(np.eye(4), (len(after) - 1, 1, 1))
        k = np.clip(np.searchsorted(at_s, after, side="right") - 1, 0, len(self) - 2)
        first, last = int(k.min()), int(k.max())
        knots = se3.pose(*np.split(self._rows[first : last + 2], [3], axis=1))
        steps = se3.log(se3.inverse(knots[:-1]) @ knots[1:])
        share = (after - at_s[k]) / (at_s[k + 1] - at_s[k])
        T = knots[k - first] @ se3.exp(share[:, None] * steps[k - first])
        return np.asarray(se3.inverse(T[0]) @ T[1:])

    def _pose(self, k: int) -> Array:
        return se3.pose(self._rows[k, :3], self._rows[k, 3:])
