"""Whether registrations and the odometry that started them can both be right.  Imports no ROS."""

from __future__ import annotations

from collections import deque

import numpy as np

from cello3d_ros.config import PairingConfig
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.gaussian import symmetrized, to_left
from cello3d_ros.geometry.se3 import Array, inverse

_SIGMAS = 6.0  # beyond so many standard deviations two poses contradict each other
_LEAST = 0.1  # share of the limits below which no odometry is taken at its word
_N = 8  # registrations over which alternation is looked for
_SPREAD = 0.3  # largest scatter of deviations that alternate, relative to their size
_STEP_M, _STEP_RAD = 0.05, 0.02  # smaller deviations than these say nothing


class OdometryDisagreesError(RegistrationError):
    """A registration is not where its odometry can have led."""

    reason = "disagrees_with_odometry"


def contradiction(xi: Array, Y: Array, config: PairingConfig) -> str:
    """Return in a sentence that a registration and its odometry cannot both be right, or "".

    xi: (6,), ``log(T_odometry^-1 T_registration)``; Y: (6, 6), the covariance of xi where
    odometry tells its own, zeros where it does not.  Then the limits of ``config`` count, else six
    standard deviations, but at least a tenth of those limits, because drivers publish covariances
    that nobody has measured.
    """
    limits = config.max_odometry_deviation_m, config.max_odometry_deviation_rad
    is_known = bool(Y.any())
    for block, limit in zip((slice(0, 3), slice(3, 6)), limits, strict=True):
        least = (_LEAST if is_known else 1.0) * limit / _SIGMAS
        C = Y[block, block] + least**2 * np.eye(3)
        if limit > 0.0 and xi[block] @ np.linalg.solve(C, xi[block]) > _SIGMAS**2:
            way_m, angle_rad = np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])
            than = (
                f"{_SIGMAS:g} standard deviations of its covariance"
                if is_known
                else f"{limits[0]:g} m or {limits[1]:g} rad"
            )
            return (
                f"the registration is {way_m:.3f} m and {angle_rad:.3f} rad from where odometry "
                f"has led, more than {than}"
            )
    return ""


def step_covariance(Y_ref: Array | None, Y_read: Array | None, T_ref_read: Array) -> Array | None:
    """Return the covariance of the pose between two poses of odometry, right side, or None.

    Where the later one is that of the earlier one and more, it is what has been added, else the
    sum of both: odometry does not say how its errors are correlated.  (6, 6).
    """
    if Y_ref is None or Y_read is None:
        return None
    carried = to_left(inverse(T_ref_read), Y_ref)
    added = symmetrized(Y_read - carried)
    values = np.linalg.eigvalsh(added)
    return added if values[0] > 1e-9 * values[-1] else symmetrized(Y_read + carried)


class Alternation:
    """Looks for registrations that go to and fro while odometry does not: two lidars in turn."""

    def __init__(self) -> None:
        self._deviations: deque[Array | None] = deque(maxlen=_N)

    def add(self, xi: Array | None) -> None:
        """Note by how much the next scan deviates from odometry (6,), None if it does not fit."""
        self._deviations.append(xi)

    @property
    def sentence(self) -> str:
        """What is wrong, or ""."""
        if len(self._deviations) < _N:
            return ""
        fits = [xi is not None for xi in self._deviations]
        if all(fits[i] != fits[i + 1] for i in range(_N - 1)):
            return (
                "every other cloud does not fit the one before it: if two lidars publish on one "
                "topic, merge their clouds or start a node for each"
            )
        if not all(fits):
            return ""
        turned = np.array(self._deviations) * (-1.0) ** np.arange(_N)[:, None]
        mean, scatter = turned.mean(axis=0), turned.std(axis=0)
        for block, least in ((slice(0, 3), _STEP_M), (slice(3, 6), _STEP_RAD)):
            size = np.linalg.norm(mean[block])
            if size > least and np.linalg.norm(scatter[block]) < _SPREAD * size:
                way_m, angle_rad = np.linalg.norm(mean[:3]), np.linalg.norm(mean[3:])
                return (
                    f"registrations go to and fro by {way_m:.2f} m and {angle_rad:.2f} rad while "
                    "odometry does not: if two lidars publish on one topic, merge their clouds or "
                    "start a node for each"
                )
        return ""
