"""Recordings of a sensor that walks through a room, held in memory."""

import numpy as np

from cello3d_ros.geometry import se3
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.tracking.warmup import room


class InMemory(list):
    """Scans as a recording."""

    name = "in memory"


def walk_in_a_room(n_scans, period_s, odometry=lambda T, i: T, **of_room):
    """Return scans of a room; odometry: of the true pose and the number of the scan."""
    rng = np.random.default_rng(3)
    scans = InMemory()
    for i in range(n_scans):
        T = se3.exp(np.array([0.15, 0.05, 0.01, 0.01, -0.02, 0.06]) * i)
        scans.append(
            Scan(
                stamp_ns=10**18 + i * round(period_s * 1e9),
                points=se3.transform(se3.inverse(T), room(rng, **of_room)),
                T_world_sensor=T,
                T_odom_sensor=odometry(T, i),
            )
        )
    return scans
