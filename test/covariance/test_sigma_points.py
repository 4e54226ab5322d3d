"""Sigma points: with an ICP whose answer is known, and on a room."""

import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, Pipeline, SamplingConfig
from cello3d_ros.covariance import sigma_points as module
from cello3d_ros.covariance.case import Case, MethodSettings
from cello3d_ros.covariance.closed_form import closed_form, common_bias
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.estimator import registered_elsewhere
from cello3d_ros.covariance.model import constant_model
from cello3d_ros.covariance.sigma_points import offsets, sensor_term, sigma_points
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.registration.icp import Registration

T_HAT = exp([0.4, -0.3, 0.05, 0.02, 0.05, 0.6])


def some_prior():
    A = np.random.default_rng(1).normal(size=(6, 6)) * 0.05
    return A @ A.T


@pytest.fixture
def pair(room):
    rng = np.random.default_rng(33)
    reading = prepare(transform(inverse(T_HAT), room[0]), CloudConfig(), rng)
    return reading, prepare(room[1], CloudConfig(), rng)


def seen(pair, variance=2e-3, sigma_m=0.01, seed=0):
    """The pair as registered at T_HAT, for starts of this variance."""
    model = constant_model(np.eye(6), 704, sampling=SamplingConfig(variance=variance))
    return Case(
        *(*pair, registered_elsewhere(T_HAT), describe(*pair, T_HAT, Pipeline(), 0), Pipeline()),
        *(model, np.random.default_rng(seed), MethodSettings(sigma_m=sigma_m)),
    )


def pretend(monkeypatch, answer):
    """Put ``answer(T_init) -> (T, reason)`` in place of ICP."""

    def many(reading, reference, T_inits, seeds, config, n_threads=1):
        assert len(T_inits) == len({tuple(seed) for seed in seeds})
        results = (answer(T) for T in T_inits)
        return [Registration(T, 1, not reason, reason, 0.0, 1) for T, reason in results]

    monkeypatch.setattr(module, "register_many", many)


def test_the_points_have_the_mean_and_covariance_of_the_prior():
    prior = some_prior()
    xi = offsets(prior)
    assert xi.shape == (12, 6)
    np.testing.assert_allclose(xi.mean(axis=0), 0.0, atol=1e-15)
    np.testing.assert_allclose(xi.T @ xi / 12, prior, atol=1e-15)


def test_the_sensor_term_is_that_of_two_clouds_and_a_common_bias(pair):
    case = seen(pair, sigma_m=0.03)
    b = common_bias(pair[1], T_HAT, case.description.overlap, Pipeline().icp)
    H_inverse = closed_form(*pair, T_HAT, case.description.overlap, Pipeline().icp).inverse_H
    expected = 0.03**2 * (2 * H_inverse + 2 * np.outer(b, b))
    np.testing.assert_allclose(sensor_term(case), expected, rtol=1e-9)
    assert np.abs(np.outer(b, b)).max() > H_inverse.max()


def test_an_icp_that_stays_put_gives_the_prior_and_the_sensor_term(pair, monkeypatch):
    pretend(monkeypatch, lambda T: (T, ""))
    case = seen(pair)
    expected = 2e-3 * np.eye(6) + sensor_term(case)
    np.testing.assert_allclose(sigma_points(case), expected, atol=1e-12)


def test_an_icp_that_always_comes_back_leaves_the_sensor_term(pair, monkeypatch):
    pretend(monkeypatch, lambda T: (T_HAT, "max_iterations"))
    Y = sigma_points(seen(pair, sigma_m=0.03))
    np.testing.assert_allclose(Y, 9.0 * sensor_term(seen(pair)), rtol=1e-6)
    assert is_positive_definite(Y)


def test_starts_without_an_answer_do_not_count(pair, monkeypatch):
    away = T_HAT @ exp([0.1, 0, 0, 0, 0, 0])
    answers = iter([(away, ""), *[(np.full((4, 4), 7.0), "singular")] * 11])
    pretend(monkeypatch, lambda T: next(answers))
    case = seen(pair)
    expected = sensor_term(case)
    expected[0, 0] += 0.01
    np.testing.assert_allclose(sigma_points(case), expected, atol=1e-9)
    pretend(monkeypatch, lambda T: (T, "singular"))
    with pytest.raises(RegistrationError, match="no answer"):
        sigma_points(case)


def test_in_a_room_most_starts_come_back(pair):
    Y = sigma_points(seen(pair, variance=1e-3, seed=5))
    assert is_positive_definite(Y)
    assert np.trace(Y) < 0.1 * 6e-3
