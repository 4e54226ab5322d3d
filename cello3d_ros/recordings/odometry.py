"""Odometry made from ground truth by adding drift."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.recording import Recording, Scan


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


def with_odometry(recording: Recording, seed: int = 0) -> Iterator[Scan]:
    """Yield the scans; where a recording has no odometry, its ground truth made to drift.

    Raises RecordingError where there is neither.
    """
    first = next(iter(recording), None)
    if first is None:
        raise RecordingError(f"{recording.name} holds no scan")
    if first.T_odom_sensor is not None:
        for scan in recording:
            if scan.T_odom_sensor is not None:
                yield scan
        return
    truth = [scan.T_world_sensor for scan in recording]
    known = [T for T in truth if T is not None]
    if len(known) < len(truth):
        raise RecordingError(f"{recording.name} has neither odometry nor ground truth throughout")
    drifted = drift_odometry(np.stack(known), np.random.default_rng(seed))
    for scan, T in zip(recording, drifted, strict=True):
        yield replace(scan, T_odom_sensor=T)
