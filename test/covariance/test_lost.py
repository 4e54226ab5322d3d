"""Registrations in other minima: told by the sandwich, covered by the scatter of their kind."""

import numpy as np
import pytest

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.lost import Lost, covering, is_lost, spread_m
from cello3d_ros.covariance.model import Model, constant_model
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, transform

PIPELINE = Pipeline()
T_TRUE = exp([0.6, -0.4, 0.1, 0.02, -0.03, 0.4])
T_WRONG = T_TRUE @ exp([0, 0, 0, 0, 0, np.pi])  # ICP stays there, turned round
V = np.diag([0.8, 0.5, 0.3, 0.09, 0.03, 0.12])


@pytest.fixture
def pair(room: tuple[Array, Array]) -> tuple[Cloud, Cloud]:
    rng = np.random.default_rng(0)
    reading = transform(inverse(T_TRUE), room[0])
    return prepare(reading, PIPELINE.cloud, rng), prepare(room[1], PIPELINE.cloud, rng)


def sandwich(pair: tuple[Cloud, Cloud], T: Array) -> Array:
    return describe(*pair, T, PIPELINE).shapes["sandwich"]


def a_model(limit_m: float) -> Model:
    return constant_model(1.5 * np.eye(6), 704, shape="sandwich", lost=Lost(limit_m, V))


def test_the_spread_is_that_of_all_directions_of_translation() -> None:
    S = np.diag([4e-6, 4e-6, 1e-6, 9.0, 9.0, 9.0])
    assert spread_m(S) == pytest.approx(3e-3)
    np.testing.assert_allclose(spread_m(np.array([S, 4 * S])), [3e-3, 6e-3])


def test_a_wider_sandwich_than_the_limit_is_lost_and_without_a_limit_none_is() -> None:
    S = np.diag([4e-6, 4e-6, 1e-6, 9.0, 9.0, 9.0])
    assert is_lost(S, Lost(2.99e-3, V))
    assert not is_lost(S, Lost(3.01e-3, V))
    assert not is_lost(S, None)


def test_what_covers_is_nowhere_narrower_than_either() -> None:
    long = np.diag([1e-4, 1e-4, 9.0, 1e-4, 1e-4, 1e-4])  # a direction that geometry leaves free
    both = covering(long, Lost(1.0, V))
    for one in (long, V):
        assert np.linalg.eigvalsh(both - one)[0] > -1e-12
    np.testing.assert_allclose(covering(1e-6 * np.eye(6), Lost(1.0, V)), V, atol=1e-12)


def test_a_wrong_minimum_has_a_much_wider_sandwich(pair: tuple[Cloud, Cloud]) -> None:
    rng = np.random.default_rng(1)
    wrong = Estimator(a_model(1e3)).register(*pair, T_WRONG, rng).registration.T_ref_read
    assert np.linalg.norm(log(inverse(T_TRUE) @ wrong)[3:]) > 1.0
    right = Estimator(a_model(1e3)).register(*pair, T_TRUE, rng).registration.T_ref_read
    assert spread_m(sandwich(pair, wrong)) > 3.0 * spread_m(sandwich(pair, right))


@pytest.mark.parametrize("method", ["cello3d", "fused", "hessian"])
def test_an_estimate_in_a_wrong_minimum_says_so_and_is_wide(
    pair: tuple[Cloud, Cloud], method: str
) -> None:
    model = a_model(2.0 * float(spread_m(sandwich(pair, T_TRUE))))
    rng = np.random.default_rng(1)
    right = Estimator(model, method).register(*pair, T_TRUE, rng)
    wrong = Estimator(model, method).register(*pair, T_WRONG, rng)
    assert (right.is_lost, wrong.is_lost) == (False, True)
    assert np.linalg.eigvalsh(right.covariance)[-1] < 1e-2
    if method == "hessian":  # does not come from the model: told of and no more
        assert np.linalg.eigvalsh(wrong.covariance)[-1] < 1e-2
    else:
        assert np.linalg.eigvalsh(wrong.covariance - V)[0] > -1e-12


def test_a_model_that_knows_nothing_of_it_tells_of_nothing(pair: tuple[Cloud, Cloud]) -> None:
    model = constant_model(1.5 * np.eye(6), 704, shape="sandwich")
    found = Estimator(model).register(*pair, T_WRONG, np.random.default_rng(1))
    assert not found.is_lost
