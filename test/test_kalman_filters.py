"""The filters of benchmarks/filters.py: laws, oracles and consistency."""

import numpy as np
import pytest
from filters import VELOCITIES, chained, corrected, grown, jacobian, localized, predicted

from cello3d_ros.geometry.gaussian import GaussianPose, compound_right
from cello3d_ros.geometry.se3 import adjoint, exp, inverse, log

Q_STEP = np.diag(np.repeat([0.02, 0.004], 3) ** 2)
Y_ANSWER = np.diag([0.003, 0.02, 0.006, 0.001, 0.002, 0.004]) ** 2
STEP = exp(np.array([0.3, 0.02, 0.0, 0.01, -0.02, 0.1]))


def test_a_state_moves_straight_by_its_velocity_and_turns_by_its_rate() -> None:
    x = np.zeros((1, 15))
    x[0, 5], x[0, 6], x[0, 11], x[0, 12] = np.pi / 2, 2.0, 0.5, 1.0
    moved = predicted(x, 0.1)[0]
    np.testing.assert_allclose(moved[:3], [0.0, 0.205, 0.0], atol=1e-12)
    assert moved[5] == pytest.approx(np.pi / 2 + 0.05)
    assert moved[6] == pytest.approx(2.1)


def test_the_covariance_grows_by_dt_q_where_nothing_moves() -> None:
    Q, P = np.diag(np.arange(1.0, 16.0)), np.zeros((1, 15, 15))
    _, found = grown(np.zeros((1, 15)), P, Q, 0.25)
    np.testing.assert_allclose(found[0], 0.25 * Q, atol=1e-9)
    F = jacobian(np.zeros((1, 15)), 0.25)[0]
    np.testing.assert_allclose(F[0, [6, 12]], [0.25, 0.5 * 0.25**2], atol=1e-8)


def test_variances_of_a_measurement_are_at_least_1e_9() -> None:
    x, P = np.zeros((1, 15)), np.eye(15)[None] * 1e-9
    moved, _ = corrected(x, P, VELOCITIES, np.full(6, 1e-3), np.zeros((6, 6)))
    np.testing.assert_allclose(moved[0, 6:12], 0.5e-3, rtol=1e-9)


def test_without_answers_the_pose_is_the_odometry_compounded() -> None:
    steps = [GaussianPose(STEP, Q_STEP)] * 5
    *_, found = chained(steps, [None] * 5)
    pose = GaussianPose(np.eye(4), np.zeros((6, 6)))
    for step in steps:
        pose = compound_right(*pose, *step, order=2)
    np.testing.assert_allclose(found.T, pose.T, atol=1e-12)
    np.testing.assert_allclose(found.Y, pose.Y, atol=1e-15)


def test_one_step_with_an_answer_is_the_product_of_both_gaussians() -> None:
    xi = np.array([0.004, -0.01, 0.003, 0.0005, 0.001, -0.002])
    answer = GaussianPose(STEP @ exp(xi), Y_ANSWER)
    (found,) = chained([GaussianPose(STEP, Q_STEP)], [answer])
    Y = np.linalg.inv(np.linalg.inv(Q_STEP) + np.linalg.inv(Y_ANSWER))
    np.testing.assert_allclose(found.Y, Y, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(log(inverse(STEP) @ found.T), Y @ np.linalg.solve(Y_ANSWER, xi))


def test_an_answer_over_two_steps_is_about_where_the_robot_was_at_the_one_before() -> None:
    both = STEP @ STEP
    steps = [GaussianPose(STEP, Q_STEP)] * 2
    *_, found = chained(steps, [None, GaussianPose(both, 1e-12 * np.eye(6))])
    np.testing.assert_allclose(found.T, both, atol=1e-9)
    assert np.trace(found.Y) < 1e-10


def test_an_answer_after_a_restart_is_about_where_the_chain_starts_anew() -> None:
    steps = [GaussianPose(STEP, Q_STEP)] * 3
    last = GaussianPose(STEP @ exp(np.full(6, 1e-3)), 1e-12 * np.eye(6))
    *_, before, found = chained(steps, [None, None, last], starts={2})
    np.testing.assert_allclose(found.T, before.T @ last.T, atol=1e-7)
    moved = adjoint(inverse(last.T))
    np.testing.assert_allclose(found.Y, moved @ before.Y @ moved.T, atol=1e-7)


def test_errors_of_the_error_state_filter_are_as_it_says() -> None:
    """Mean squared distance over 6 in 300 runs of 15 steps: 1 within 3 standard errors."""
    rng, d2 = np.random.default_rng(0), []
    for _ in range(300):
        truth, steps, answers = np.eye(4), [], []
        since = np.eye(4)
        for k in range(15):
            truth, since = truth @ STEP, since @ STEP
            steps.append(GaussianPose(STEP @ exp(_drawn(rng, Q_STEP)), Q_STEP))
            answered = k % 3 != 1
            answer = GaussianPose(since @ exp(_drawn(rng, Y_ANSWER)), Y_ANSWER)
            answers.append(answer if answered else None)
            since = np.eye(4) if answered else since
        *_, found = chained(steps, answers)
        xi = log(inverse(found.T) @ truth)
        d2.append(xi @ np.linalg.solve(found.Y, xi) / 6.0)
    assert np.mean(d2) == pytest.approx(1.0, abs=3 * np.sqrt(2 / 6 / 300))


def _drawn(rng: np.random.Generator, Y: np.ndarray) -> np.ndarray:
    return rng.normal(size=6) * np.sqrt(np.diag(Y))


def test_robot_localization_follows_steady_twists_exactly() -> None:
    twist = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    x = np.zeros(15)
    x[6:12] = twist
    measured = [(0.1 * k, [(VELOCITIES, twist, 1e-6 * np.eye(6))]) for k in range(1, 21)]
    *_, (pose, _) = localized(1e-6 * np.eye(15), measured, x)
    np.testing.assert_allclose(pose, [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)
