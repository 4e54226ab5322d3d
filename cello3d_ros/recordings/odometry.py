"""Odometry made from ground truth by adding drift."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.recording import DerivedRecording, Recording, Scan


class Drift(NamedTuple):
    """How odometry drifts: errors of its steps are independent Gaussian twists on the right."""

    translation_share: float = 0.02
    rotation_rad_per_m: float = float(np.radians(0.5))
    rotation_share: float = 0.05

    def sigma(self, motion: ArrayLike) -> Array:
        """Return the deviations (..., 6), ordered (u, omega), of steps (..., 4, 4).

        Over a length d and an angle a, each axis has the deviation ``translation_share * d`` and
        ``hypot(rotation_rad_per_m * d, rotation_share * a)``.
        """
        xi = se3.log(motion)
        d = np.linalg.norm(np.asarray(motion, np.float64)[..., :3, 3], axis=-1)
        a = np.linalg.norm(xi[..., 3:], axis=-1)
        rotation = np.hypot(self.rotation_rad_per_m * d, self.rotation_share * a)
        both = np.stack([self.translation_share * d, rotation], axis=-1)
        return np.repeat(both, 3, axis=-1)


def drift_odometry(
    T_world_sensor: ArrayLike, rng: np.random.Generator, drift: Drift | None = None
) -> Array:
    """Return the odometry (n, 4, 4) that a drifting robot would report; it starts at identity.

    T_world_sensor: (n, 4, 4) ground truth.
    """
    T = np.asarray(T_world_sensor, dtype=np.float64)
    motion = se3.inverse(T[:-1]) @ T[1:]
    std = (drift or Drift()).sigma(motion)
    noisy = motion @ se3.exp(rng.normal(size=std.shape) * std)
    out = [np.eye(4)]
    for step in noisy:
        out.append(out[-1] @ step)
    return np.stack(out)


class SimulatedOdometry(DerivedRecording):
    """A recording whose odometry is its ground truth made to drift; its own is not looked at.

    A scan without ground truth has no odometry.
    """

    def __init__(self, recording: Recording, seed: int = 0) -> None:
        """seed: of the drift.  Nothing is read yet."""
        super().__init__(recording)
        self._seed = seed

    @property
    def has_odometry(self) -> bool:
        """True: it is simulated."""
        return True

    def __iter__(self) -> Iterator[Scan]:
        drifted = iter(self._drifted()[1])
        for scan in self.recording:
            is_known = scan.T_world_sensor is not None
            yield replace(scan, T_odom_sensor=next(drifted) if is_known else None)

    def track(self) -> PoseTrack:
        """Return the odometry at the stamps."""
        return PoseTrack.of_poses(*self._drifted())

    def _drifted(self) -> tuple[list[int], Array]:
        stamps, truth = [], []
        for scan in self.recording:
            if scan.T_world_sensor is not None:
                stamps.append(scan.stamp_ns)
                truth.append(scan.T_world_sensor)
        if not truth:
            raise RecordingError(f"{self.name} has no ground truth to simulate odometry from")
        return stamps, drift_odometry(np.stack(truth), np.random.default_rng(self._seed))
