"""How a sensor moves around one instant: poses at some times and constant twists between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array


class Motion(NamedTuple):
    """The pose ``T_k exp((t - t_k) v_k)`` of a sensor at time t, seen from where it is at time 0.

    at_s: (K,), increasing, K >= 1.  T: (K, 4, 4).  velocity: (K, 6), in m/s and rad/s along the
    sensor's axes.  The first twist holds before the first time as well, the last one after it.
    """

    at_s: Array
    T: Array
    velocity: Array

    @classmethod
    def constant(cls, velocity: ArrayLike) -> Motion:
        """Return the motion ``exp(t v)`` of one twist a second, (6,)."""
        v = np.asarray(velocity, dtype=np.float64)
        return cls(np.zeros(1), np.eye(4)[None], v.reshape(1, 6))

    def at(self, time_s: ArrayLike) -> Array:
        """Return the poses (n, 4, 4) at times (n,)."""
        t = np.asarray(time_s, dtype=np.float64)
        k = np.maximum(np.searchsorted(self.at_s, t, side="right") - 1, 0)
        after = (t - self.at_s[k])[:, None]
        return np.asarray(self.T[k] @ se3.exp(after * self.velocity[k]))

    def of_sensor(self, T_base_sensor: Array) -> Motion:
        """Return the motion of a sensor from that of the base on which it is mounted."""
        X, X_inv = T_base_sensor, se3.inverse(T_base_sensor)
        return Motion(self.at_s, X_inv @ self.T @ X, self.velocity @ se3.adjoint(X_inv).T)
