"""What fuse and robot_localization demand of a message, as rules on its numbers.

fuse: a measurement is validated before it becomes a constraint; every number finite, the largest
difference of the covariance from its transpose below 1e-12 (Eigen's dummy precision of doubles)
and its smallest eigenvalue above 0 (locusrobotics/fuse: validateMeasurement in
fuse_models/include/fuse_models/common/sensor_proc.hpp, isSymmetric and isPositiveDefinite in
fuse_core/include/fuse_core/eigen.hpp).  Sub-measurements (chosen dimensions) must pass as well.

robot_localization: a covariance above 1e3, or a variance of zero or below, raises a warning
(cra-ros-pkg/robot_localization: RosFilter::copyCovariance in src/ros_filter.cpp); a variance below
1e-9 is replaced (Ekf::correct in src/ekf.cpp); a quaternion whose length is off by more than 0.01
or zero raises a warning (RosFilter::preparePose in src/ros_filter.cpp).
"""

import itertools

import numpy as np

_SYMMETRY = 1e-12  # fuse
_LARGE, _SMALL = 1e3, 1e-9  # robot_localization
_UNIT = 0.01


def complaints(mean, covariance, quaternion=None) -> list[str]:
    """Return what either consumer would say; nothing is what it should be.

    mean: numbers of the pose or twist; covariance: 36 numbers, row by row.
    """
    C = np.asarray(covariance, dtype=np.float64).reshape(6, 6)
    found = []
    if not (np.isfinite(mean).all() and np.isfinite(C).all()):
        return ["fuse: not finite"]
    if np.abs(C - C.T).max() >= _SYMMETRY:
        found.append(f"fuse: asymmetric by {np.abs(C - C.T).max()}")
    for size in (1, 2, 3, 6):
        for chosen in itertools.combinations(range(6), size):
            least = np.linalg.eigvalsh(C[np.ix_(chosen, chosen)])[0]
            if not least > 0.0:
                found.append(f"fuse: eigenvalue {least} of {chosen}")
    if C.max() > _LARGE:
        found.append(f"robot_localization: extremely large covariance {C.max()}")
    if not (np.diag(C) > 0.0).all():
        found.append("robot_localization: variance of zero or below")
    if quaternion is not None and abs(np.linalg.norm(quaternion) - 1.0) > _UNIT:
        found.append(f"robot_localization: quaternion {quaternion}")
    return found


def floored(covariance) -> bool:
    """Return whether robot_localization would replace a variance by its own smallest."""
    return bool((np.diag(np.reshape(covariance, (6, 6))) < _SMALL).any())


def of_pose(message) -> list[str]:
    """Return the complaints about a message with ``pose.pose`` and ``pose.covariance``."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    quaternion = [q.x, q.y, q.z, q.w]
    return complaints([p.x, p.y, p.z, *quaternion], message.pose.covariance, quaternion)


def of_twist(message) -> list[str]:
    """Return the complaints about a message with ``twist.twist`` and ``twist.covariance``."""
    u, w = message.twist.twist.linear, message.twist.twist.angular
    return complaints([u.x, u.y, u.z, w.x, w.y, w.z], message.twist.covariance)
