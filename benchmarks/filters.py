"""How robot_localization and fuse use what the node publishes, small: for tests and benchmarks.

robot_localization (src/ekf.cpp, src/filter_base.cpp, src/ros_filter.cpp): 15 states x y z, roll
pitch yaw, their velocities in the body, accelerations of x y z; constant acceleration; each
measurement is taken at its stamp, to which the state is predicted in one step; the covariance
grows by ``dt Q``; variances of measurements are at least 1e-9.

fuse (fuse_models::Odometry3D, differential, use_twist_covariance): the pose between two messages
is a constraint between the robot's poses then, its covariance ``dt^2`` times that of the twist.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from cello3d_ros.geometry.gaussian import GaussianPose, symmetrized
from cello3d_ros.geometry.se3 import Array, adjoint, exp, inverse, log

_SMALLEST = 1e-9  # of robot_localization
TILT, VELOCITIES, RATES = slice(3, 5), slice(6, 12), slice(9, 12)  # of the states


def predicted(x: Array, dt: float) -> Array:
    """Return the states (..., 15) of robot_localization after dt."""
    shape = x.shape
    x = x.reshape(-1, 15)
    R = Rotation.from_euler("ZYX", x[:, [5, 4, 3]])
    roll, pitch = x[:, 3], x[:, 4]
    p, q, r = x[:, 9:12].T
    rates = [
        p + (q * np.sin(roll) + r * np.cos(roll)) * np.tan(pitch),
        q * np.cos(roll) - r * np.sin(roll),
        (q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch),
    ]
    out = x.copy()
    out[:, :3] += R.apply(x[:, 6:9] * dt + 0.5 * x[:, 12:] * dt**2)
    out[:, 3:6] += np.stack(rates, axis=1) * dt
    out[:, 6:9] += x[:, 12:] * dt
    return out.reshape(shape)


def jacobian(x: Array, dt: float, step: float = 1e-6) -> Array:
    """Return d predicted / d x of each run.  (n, 15, 15)."""
    moved = x[:, None, :] + step * np.eye(15)
    back = x[:, None, :] - step * np.eye(15)
    return np.swapaxes((predicted(moved, dt) - predicted(back, dt)) / (2 * step), 1, 2)


def grown(x: Array, P: Array, Q: Array, dt: float) -> tuple[Array, Array]:
    """Return states (n, 15) and covariances (n, 15, 15) after dt."""
    F = jacobian(x, dt)
    return predicted(x, dt), F @ P @ np.swapaxes(F, 1, 2) + dt * Q


def corrected(x: Array, P: Array, rows: slice, z: Array, C: Array) -> tuple[Array, Array]:
    """Return states and covariances after some of the states were measured.

    z: (..., m); C: (..., m, m).
    """
    m = np.shape(C)[-1]
    C = np.array(np.broadcast_to(C, (len(x), m, m)))
    k = np.arange(m)
    C[:, k, k] = np.maximum(C[:, k, k], _SMALLEST)
    K = P[:, :, rows] @ np.linalg.inv(P[:, rows, rows] + C)
    x = x + np.einsum("nij,nj->ni", K, z - x[:, rows])
    return x, symmetrized(P - K @ P[:, rows])


Measurement = tuple[slice, Array, Array]  # what of the state, its value (m,), covariance (m, m)


def localized(
    Q: Array, measured: Iterable[tuple[float, list[Measurement]]], x: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield the pose (6,) of robot_localization, x y z roll pitch yaw, and its covariance (6, 6).

    measured: times, in order, and what is measured then.  x: (15,), the state at time 0.
    """
    X, P, before = x[None], 1e-9 * np.eye(15)[None], 0.0
    for time_s, measurements in measured:
        X, P = grown(X, P, Q, time_s - before)
        before = time_s
        for rows, z, C in measurements:
            X, P = corrected(X, P, rows, z, C)
        yield X[0, :6], P[0, :6, :6]


def chained(
    steps: Iterable[GaussianPose],
    answers: Iterable[GaussianPose | None],
    starts: Collection[int] = (),
) -> Iterator[GaussianPose]:
    """Yield the pose of a robot after each step: an error-state filter by the rules of fuse.

    steps: of the odometry, with right covariances.  answers: the pose at the end of the step seen
    from where the robot was at the answer before, or at the start; None where there is none.
    starts: how many steps there were where a chain started anew without an answer: the next one is
    seen from there.  The state is the pose and, as a clone, that from which the next answer is
    seen; ``T_true = T exp(xi)``.
    """
    T = T_clone = np.eye(4)
    P = np.zeros((12, 12))
    for n, (step, answer) in enumerate(zip(steps, answers, strict=True), 1):
        T = T @ step.T
        F = np.eye(12)
        F[:6, :6] = adjoint(inverse(step.T))
        P = F @ P @ F.T
        P[:6, :6] += step.Y
        if answer is not None:
            between = inverse(T_clone) @ T
            H = np.hstack([np.eye(6), -adjoint(inverse(between))])
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + answer.Y)
            T = T @ exp((K @ log(inverse(between) @ answer.T))[:6])
            P = symmetrized(P - K @ H @ P)
        if answer is not None or n in starts:
            T_clone, P = T, np.tile(P[:6, :6], (2, 2))
        yield GaussianPose(T, P[:6, :6].copy())
