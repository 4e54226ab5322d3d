"""Odometry: made from ground truth by adding drift, or looked up between recorded poses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array


def drift_odometry(
    T_world_sensor: ArrayLike,
    rng: np.random.Generator,
    *,
    translation_share: float = 0.02,
    rotation_rad_per_m: float = np.radians(0.5),
    rotation_share: float = 0.05,
) -> Array:
    """Return the odometry (n, 4, 4) that a drifting robot would report; it starts at identity.

    Each relative motion is multiplied by ``exp(xi)`` with independent Gaussian xi: over a motion
    of length d and angle a, each axis has the deviation ``translation_share * d`` and
    ``hypot(rotation_rad_per_m * d, rotation_share * a)``.

    T_world_sensor: (n, 4, 4) ground truth.
    """
    T = np.asarray(T_world_sensor, dtype=np.float64)
    motion = se3.inverse(T[:-1]) @ T[1:]
    distance = np.linalg.norm(motion[:, :3, 3], axis=1)
    angle = np.linalg.norm(se3.log(motion)[:, 3:], axis=1)
    std = np.empty((len(motion), 6))
    std[:, :3] = (translation_share * distance)[:, None]
    std[:, 3:] = np.hypot(rotation_rad_per_m * distance, rotation_share * angle)[:, None]
    noisy = motion @ se3.exp(rng.normal(size=std.shape) * std)
    out = [np.eye(4)]
    for step in noisy:
        out.append(out[-1] @ step)
    return np.stack(out)


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

    def _pose(self, k: int) -> Array:
        return se3.pose(self._rows[k, :3], self._rows[k, 3:])
