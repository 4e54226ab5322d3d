"""Undoes the motion within a scan: each point to where the sensor would have seen it at the stamp.

The law is ``p' = T(stamp)^-1 T(stamp + t) p`` for a point p seen at the time t after the stamp.
It holds whatever the stamp is, the start or the end of the scan.
"""

from __future__ import annotations

import math

import numpy as np

from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.se3 import Array

_SMALL_RAD = 1e-2  # below this angle the coefficients come from their series


def undistorted(points: Array, time_s: Array, motion: Motion) -> Array:
    """Return the points as the sensor would have seen them at the stamp.

    points: (N, 3), sensor frame, each seen from where the sensor was at its own time.  time_s:
    (N,), finite, after the stamp.  motion: of the sensor, seen from the stamp.
    """
    at_s, T, velocity = (np.ascontiguousarray(rows) for rows in motion)
    return _moved(np.ascontiguousarray(points), np.ascontiguousarray(time_s), at_s, T, velocity)


def sweep_of(time_s: Array) -> tuple[float, float]:
    """Return the first and the last of the times (N,) of a scan, and of 0, its stamp."""
    return float(time_s.min(initial=0.0)), float(time_s.max(initial=0.0))


@kernel()
def _moved(points: Array, time_s: Array, at_s: Array, T: Array, velocity: Array) -> Array:
    """Return ``T_k exp((t - t_k) v_k) p`` of each point (N, 3) and its time.

    Points come in order of time or nearly so: the interval is looked for from the last one.  With
    the twist s v = (u, w) of angle a, the point ``exp(s v) p`` is
    ``p + sin(a)/a c + (1 - cos(a))/a^2 w x c + (u + (1 - cos(a))/a^2 w x u
    + (a - sin(a))/a^3 w x (w x u))`` where ``c = w x p``.
    """
    moved = np.empty_like(points)
    k = 0
    for i in range(len(points)):
        t = time_s[i]
        while k + 1 < len(at_s) and at_s[k + 1] <= t:
            k += 1
        while k > 0 and at_s[k] > t:
            k -= 1
        s = t - at_s[k]
        ux, uy, uz = s * velocity[k, 0], s * velocity[k, 1], s * velocity[k, 2]
        wx, wy, wz = s * velocity[k, 3], s * velocity[k, 4], s * velocity[k, 5]
        a2 = wx * wx + wy * wy + wz * wz
        if a2 < _SMALL_RAD * _SMALL_RAD:
            a = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0)
            b = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0)
            c = 1.0 / 6.0 - a2 / 120.0 * (1.0 - a2 / 42.0)
        else:
            angle = math.sqrt(a2)
            a = math.sin(angle) / angle
            b = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
            c = (1.0 - a) / a2
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        # w x (a p + b w x p + b u + c w x u): the two rotations share their products
        fx, fy, fz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        gx, gy, gz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
        hx, hy, hz = b * fx + c * gx, b * fy + c * gy, b * fz + c * gz
        x += a * fx + b * gx + wy * hz - wz * hy + ux
        y += a * fy + b * gy + wz * hx - wx * hz + uy
        z += a * fz + b * gz + wx * hy - wy * hx + uz
        for row in range(3):
            moved[i, row] = T[k, row, 0] * x + T[k, row, 1] * y + T[k, row, 2] * z + T[k, row, 3]
    return moved
