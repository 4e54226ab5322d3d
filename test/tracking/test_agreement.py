"""Registrations against the odometry that started them."""

import numpy as np
import pytest

from cello3d_ros.config import NodeConfig
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import compound_right, to_left
from cello3d_ros.tracking.agreement import Alternation, contradiction, step_covariance

CONFIG, NONE = NodeConfig(), np.zeros((6, 6))
STEP = se3.exp([0.5, 0.1, 0.0, 0.0, 0.02, 0.3])


def along(axis: int, size: float) -> np.ndarray:
    return size * np.eye(6)[axis]


@pytest.mark.parametrize(
    ("axis", "size", "contradicts"),
    [(0, 0.99, False), (1, -1.01, True), (2, 3.0, True), (5, 0.49, False), (3, -0.51, True)],
)
def test_without_a_covariance_the_limits_count(axis, size, contradicts) -> None:
    found = contradiction(along(axis, size), NONE, CONFIG)
    assert bool(found) == contradicts
    assert not found or "more than 1 m or 0.5 rad" in found


@pytest.mark.parametrize(
    ("sigma_m", "size", "contradicts"),
    [
        (0.05, 0.29, False),  # six standard deviations are 0.3 m
        (0.05, 0.35, True),  # although the limit for odometry without a covariance is 1 m
        (2.0, 5.0, False),  # although that limit is 1 m
        (1e-9, 0.09, False),  # nobody has measured such a covariance
        (1e-9, 0.11, True),
    ],
)
def test_its_own_covariance_says_what_odometry_makes_impossible(
    sigma_m, size, contradicts
) -> None:
    Y = np.diag(np.repeat([sigma_m**2, 1.0], 3))
    found = contradiction(along(0, size), Y, CONFIG)
    assert bool(found) == contradicts
    assert not found or "6 standard deviations" in found


def test_what_odometry_does_not_measure_it_does_not_contradict() -> None:
    """Wheels know nothing of z, and say so by a large variance."""
    Y = np.diag([1e-4, 1e-4, 1e6, 1e6, 1e6, 1e-4])
    assert contradiction(along(2, 5.0), Y, CONFIG) == ""
    assert contradiction(along(0, 0.5), Y, CONFIG) != ""


def test_a_limit_of_zero_does_not_look() -> None:
    off = NodeConfig(max_odometry_deviation_m=0.0, max_odometry_deviation_rad=0.0)
    assert contradiction(np.full(6, 100.0), NONE, off) == ""
    assert contradiction(np.full(6, 100.0), 1e-6 * np.eye(6), off) == ""


def test_of_odometry_that_accumulates_the_step_has_what_was_added() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * 0.02
    Y_ref, Q = A @ A.T, np.diag([4e-4, 1e-4, 1e-4, 1e-6, 1e-6, 4e-6])
    Y_read = compound_right(np.eye(4), Y_ref, STEP, Q, order=2).Y
    np.testing.assert_allclose(step_covariance(Y_ref, Y_read, STEP), Q, atol=1e-12)


def test_of_odometry_with_one_covariance_for_all_the_step_has_both() -> None:
    Y = 1e-4 * np.eye(6)
    expected = Y + to_left(se3.inverse(STEP), Y)
    np.testing.assert_allclose(step_covariance(Y, Y, STEP), expected, atol=1e-15)
    assert step_covariance(None, Y, STEP) is None


def walked(n: int, offset: np.ndarray, noise: float, turns: bool = True) -> str:
    rng = np.random.default_rng(0)
    alternation = Alternation()
    for k in range(n):
        sign = (-1) ** k if turns else 1
        alternation.add(sign * offset + noise * rng.normal(size=6))
    return alternation.sentence


def test_two_lidars_in_turn_are_told_by_registrations_that_go_to_and_fro() -> None:
    sentence = walked(8, along(0, 0.8), 0.02)
    assert "to and fro by 0." in sentence
    assert "start a node for each" in sentence
    assert walked(7, along(0, 0.8), 0.02) == ""  # too early to say
    assert walked(8, along(5, 0.3), 0.01) != ""


def test_one_lidar_is_not_taken_for_two() -> None:
    assert walked(8, along(0, 0.8), 0.02, turns=False) == ""  # odometry of a wrong scale
    assert walked(8, along(0, 0.03), 0.001) == ""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        alternation = Alternation()
        for _ in range(8):
            alternation.add(0.1 * rng.normal(size=6))
        assert alternation.sentence == ""


def test_clouds_of_which_every_other_does_not_fit_are_told() -> None:
    alternation = Alternation()
    for k in range(8):
        alternation.add(np.zeros(6) if k % 2 else None)
    assert "every other cloud" in alternation.sentence
    alternation.add(None)
    alternation.add(None)
    assert alternation.sentence == ""
