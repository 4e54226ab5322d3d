"""Covariances within bounds, whatever comes in; rules of those who consume them."""

import numpy as np
import pytest
from consumer_rules import complaints, floored

from cello3d_ros.errors import CovarianceError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.tracking.covariances import ros_covariance, twist_covariance

R = se3.exp([0, 0, 0, 0.3, -0.5, 1.0])[:3, :3]
FLOORS = [(1e-4, 1e-5), (1e-9, 1e-9), (1e-2, 1e-9), (40.0, 1e-3)]


def adversarial() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    v = rng.normal(size=6)
    return {
        "zero": np.zeros((6, 6)),
        "tiny": A @ A.T * 1e-300,
        "denormal": np.full((6, 6), 5e-324),
        "huge": A @ A.T * 1e300,
        "largest": np.full((6, 6), 1.7e308),
        "rank_one": np.outer(v, v) * 1e-4,
        "rank_one_huge": np.outer(v, v) * 1e200,
        "extreme": np.diag([1e-30, 1.0, 1e9, 1e-30, 1.0, 1e9]),
        "indefinite": np.diag([-1.0, 1.0, 1.0, 1.0, 1.0, -1e-3]),
        "singular_large": np.full((6, 6), 1e3),
        "above_in_one_direction": 1e4 * np.outer(v, v) + A @ A.T * 1e-6,
        "asymmetric_by_rounding": A @ A.T * 1e-3 * (1 + 1e-13 * rng.normal(size=(6, 6))),
        "asymmetric": A * 1e-3,
        "plain": A @ A.T * 1e-4,
    }


@pytest.mark.parametrize("name", adversarial())
@pytest.mark.parametrize("floors", FLOORS)
@pytest.mark.parametrize("ceiling", [900.0, 1e3, 1e-2])
@pytest.mark.parametrize("dt_s", [None, 0.1, 1e-9, 3600.0])
def test_whatever_comes_in_what_goes_out_is_accepted_and_within_the_bounds(
    name: str, floors: tuple[float, float], ceiling: float, dt_s: float | None
) -> None:
    Y = adversarial()[name]
    floor = np.repeat(floors, 3)
    if dt_s is None:
        C = ros_covariance(Y, R, *floors, ceiling)
    else:
        C = twist_covariance(Y, dt_s, *floors, ceiling)
        floor = floor / dt_s
    assert not complaints(np.zeros(6), C)
    assert (C == C.T).all()
    values = np.linalg.eigvalsh(C)
    assert values[-1] <= ceiling
    floor2 = np.minimum(floor**2, 0.99 * ceiling)
    slack = 1e-12 * values[-1]
    assert np.linalg.eigvalsh(C - np.diag(floor2))[0] >= -slack


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_has_no_covariance(bad: float) -> None:
    Y = np.eye(6)
    Y[2, 3] = bad
    with pytest.raises(CovarianceError, match="not finite"):
        ros_covariance(Y, R, 1e-4, 1e-5, 900.0)
    with pytest.raises(CovarianceError, match="not finite"):
        twist_covariance(Y, 0.1, 1e-4, 1e-5, 900.0)


def test_the_default_floors_are_above_those_of_robot_localization_in_position() -> None:
    assert floored(ros_covariance(np.zeros((6, 6)), R, 1e-4, 1e-5, 900.0))  # 1e-10 rad^2
    assert not floored(ros_covariance(np.zeros((6, 6)), R, 1e-4, 1e-4, 900.0))


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 0.02])
def test_the_covariance_of_a_twist_is_that_of_the_step_over_the_time(angle: float) -> None:
    """Monte Carlo of ``log(T_mean exp(xi)) / dt`` about ``log(T_mean) / dt``."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6)) * np.repeat([4e-3, 1e-3], 3)[:, None]
    Y, dt_s = A @ A.T, 0.1
    step = np.array([0.4, 0.04, 0.0, 0.3, 0.0, 1.0]) * angle
    xi = rng.multivariate_normal(np.zeros(6), Y, 100_000)
    twists = se3.log(se3.exp(step) @ se3.exp(xi)) / dt_s
    sampled = sampled_covariance(twists, step / dt_s)
    C = twist_covariance(Y, dt_s, 1e-9, 1e-9, 1e3)
    sigma = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(
        C / np.outer(sigma, sigma), sampled / np.outer(sigma, sigma), atol=0.03 + angle
    )


def test_bounds_follow_the_directions_not_the_axes() -> None:
    """One direction above the ceiling is cut, what lies across it stays."""
    v = np.array([1.0, 2.0, -1.0, 0.0, 0.0, 0.0]) / np.sqrt(6.0)
    small = 1e-4 * np.eye(6)
    C = ros_covariance(small + 1e5 * np.outer(v, v), np.eye(3), 1e-4, 1e-5, 900.0)
    assert v @ C @ v == pytest.approx(900.0)
    across = np.array([2.0, -1.0, 0.0, 0.0, 0.0, 0.0]) / np.sqrt(5.0)
    assert across @ C @ across == pytest.approx(1e-4, rel=1e-3)
