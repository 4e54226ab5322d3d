"""The motion frame: answers turn with the sensor, however it is mounted and moves."""

import numpy as np
import pytest

from cello3d_ros.covariance.heading import (
    blended,
    into_motion,
    mean_of_turns,
    motion_of,
    out_of_motion,
)
from cello3d_ros.covariance.model import Model, predict
from cello3d_ros.geometry.gaussian import matrix_inverse_sqrt
from cello3d_ros.geometry.se3 import adjoint, exp, inverse

RNG = np.random.default_rng(0)
MOTIONS = {
    "forwards": [0.8, 0.0],
    "backwards": [-0.5, 0.02],
    "sideways": [0.01, 1.5],
    "a little": [0.02, -0.03],
    "hardly": [1e-4, 2e-4],
    "not": [0.0, 0.0],
}


def matrices(n, seed=0):
    A = np.random.default_rng(seed).normal(size=(n, 6, 9))
    return A @ np.swapaxes(A, 1, 2)


def a_model():
    rng = np.random.default_rng(1)
    return Model(
        theta=np.eye(3),
        mean=np.zeros(3),
        scale=np.ones(3),
        projections=rng.normal(size=(20, 3)),
        covariances=matrices(20, 2),
        shape="sandwich",
        frame="motion",
        mean_weight=0.1,
        margin=1.2,
    )


def turn_about_z(angle):
    return exp([0.0, 0.0, 0.0, 0.0, 0.0, angle])


@pytest.mark.parametrize("angle", [1e-9, 0.3, np.pi / 2, 2.5, np.pi - 1e-6, -1.2])
@pytest.mark.parametrize("how", MOTIONS)
def test_turning_the_sensor_about_z_turns_the_answer_alike(how, angle):
    x, y = MOTIONS[how]
    T = exp([x, y, 0.1, 0.02, -0.01, 0.05])
    T[:2, 3] = (T[:3, :3] @ [x, y, 0.0])[:2]
    R = turn_about_z(angle)
    Ad = adjoint(R)
    S, d = matrices(1, 7)[0], np.array([0.1, -0.4, 0.3])
    here = predict(a_model(), d, S, motion_of(T)).covariance
    turned = predict(a_model(), d, Ad @ S @ Ad.T, motion_of(R @ T @ inverse(R))).covariance
    np.testing.assert_allclose(turned, Ad @ here @ Ad.T, rtol=1e-9, atol=1e-9)


def test_the_motion_is_that_of_the_sensor_along_its_own_axes():
    T_world_ref = exp([3.0, -2.0, 1.0, 0.1, -0.2, 2.0])
    T_world_read = T_world_ref @ exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.4])
    T_world_read[:3, 3] += T_world_read[:3, :3] @ [0.7, -0.2, 0.1]
    np.testing.assert_allclose(motion_of(inverse(T_world_ref) @ T_world_read), [0.7, -0.2])


def test_the_axis_along_the_motion_becomes_x_and_comes_back():
    motion = np.array([[0.0, 2.0], [-1.0, 0.0], [0.3, 0.3]])
    along = motion / np.linalg.norm(motion, axis=1, keepdims=True)
    Y = np.zeros((3, 6, 6))
    Y[:, :2, :2] = along[:, :, None] * along[:, None]
    x = into_motion(Y, motion)
    np.testing.assert_allclose(x[:, 0, 0], 1.0)
    np.testing.assert_allclose(np.trace(x, axis1=1, axis2=2), 1.0)
    np.testing.assert_allclose(out_of_motion(x, motion), Y, atol=1e-15)


def test_the_symmetric_root_of_a_shape_turns_with_it():
    S, Y, motion = matrices(5, 3), matrices(5, 4), RNG.normal(size=(5, 2))
    root, turned = matrix_inverse_sqrt(S), matrix_inverse_sqrt(into_motion(S, motion))
    np.testing.assert_allclose(
        into_motion(root @ Y @ root, motion),
        turned @ into_motion(Y, motion) @ turned,
        rtol=1e-9,
        atol=1e-9,
    )


def test_the_answer_is_continuous_where_the_sensor_hardly_moves():
    S, d, model = matrices(1, 7)[0], np.zeros(3), a_model()
    at_rest = predict(model, d, S, [0.0, 0.0]).covariance
    for angle in np.linspace(-np.pi, np.pi, 9):
        motion = 1e-5 * np.array([np.cos(angle), np.sin(angle)])
        np.testing.assert_allclose(predict(model, d, S, motion).covariance, at_rest, rtol=1e-4)


def test_the_mean_of_turns_is_that_of_many_turns():
    Y = matrices(1, 5)[0]
    turns = [adjoint(turn_about_z(angle)) for angle in np.arange(8) * np.pi / 4]
    mean = np.mean([Ad @ Y @ Ad.T for Ad in turns], axis=0)
    np.testing.assert_allclose(mean_of_turns(Y), mean, atol=1e-12)


def test_blending_is_its_own_adjoint():
    A, B = matrices(2, 6)
    motion = np.array([0.02, 0.01])
    left = np.trace(A @ blended(B, motion))
    assert left == pytest.approx(np.trace(blended(A, motion) @ B), rel=1e-12)
    assert left != pytest.approx(np.trace(A @ B), rel=1e-2)
