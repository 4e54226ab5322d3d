"""Scans of a room taken while turning and driving on: each point from where the sensor was."""

import numpy as np

from cello3d_ros.geometry import se3
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.tracking.warmup import room

T0 = 10**18
PERIOD_NS = 100_000_000
TWIST = np.array([4.0, 0.5, 0.0, 0.0, 0.05, 1.0])  # m/s and rad/s


def pose_at(time_s, swing: float = 0.0) -> np.ndarray:
    """Where the sensor is at some seconds after T0.

    swing: its speed varies between 1 - swing and 1 + swing times TWIST, once in 0.6 s.
    """
    t = np.asarray(time_s)
    way = t + swing / 10.0 * np.sin(10.0 * t)
    return se3.exp(way[..., None] * TWIST)


def swept(k: int, stamped: float = 1.0, swing: float = 0.0) -> Scan:
    """Scan k, with times and its pose; stamped: at which share of its sweep, 1.0 is the end."""
    rng = np.random.default_rng([7, k])
    points = room(rng, 6000, 12.0)
    time_s = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5 - stamped) * 0.1
    T = se3.inverse(pose_at(0.1 * k + time_s, swing))
    seen = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    here = pose_at(0.1 * k, swing)
    return Scan(
        stamp_ns=T0 + k * PERIOD_NS,
        points=seen,
        time_s=time_s,
        T_world_sensor=here,
        T_odom_sensor=here,
    )


def error_m(T_ref_read: np.ndarray, k: int = 1, swing: float = 0.0) -> float:
    """How far the step to scan k from the one before is from the truth."""
    truth = se3.inverse(pose_at(0.1 * (k - 1), swing)) @ pose_at(0.1 * k, swing)
    return float(np.linalg.norm(se3.log(se3.inverse(truth) @ T_ref_read)[:3]))
