"""A pose that another program has found, taken as a registration.  Imports no ROS."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.covariance.estimator import registered_elsewhere
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.se3 import Array, inverse, log
from cello3d_ros.registration.backends import register
from cello3d_ros.registration.icp import Registration


class DisagreementError(RegistrationError):
    """Another program's pose is not where ICP would leave it."""

    reason = "external_disagrees"


class External(NamedTuple):
    """A pose as a registration.  offset: (6,), the twist by which ICP would move it."""

    registration: Registration
    offset: Array


def checked(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    config: IcpConfig,
    limit: float,
    rng: np.random.Generator,
) -> External:
    """Return another program's pose as a registration, with what ICP thinks of it.

    ICP is started at the pose: ``T_icp = T_ref_read exp(offset)``.  The pose stays the result;
    residual and associations are those of ICP.  A model predicts Y of ICP's own errors e, so the
    error of the pose, e - offset, has the second moment ``Y + offset offset^T``.  Raises
    DisagreementError when ICP moves the pose by more than ``limit`` (m or rad); limit 0: nothing
    is checked, the offset is 0 and no more is known of the registration.
    """
    registration = registered_elsewhere(T_ref_read)
    if limit <= 0.0:
        return External(registration, np.zeros(6))
    found = register(reading, reference, T_ref_read, config, rng)
    if not found.has_answer:
        raise RegistrationError(f"ICP has no answer: {found.reason.replace('_', ' ')}")
    offset = log(inverse(T_ref_read) @ found.T_ref_read)
    way_m, angle_rad = np.linalg.norm(offset[:3]), np.linalg.norm(offset[3:])
    if max(way_m, angle_rad) > limit:
        raise DisagreementError(
            f"ICP would move the external pose by {way_m:.3f} m and {angle_rad:.3f} rad, "
            f"more than {limit:g}"
        )
    seen = registration._replace(
        residual_rms_m=found.residual_rms_m, n_associations=found.n_associations
    )
    return External(seen, offset)
