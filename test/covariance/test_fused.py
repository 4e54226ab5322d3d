"""Online registrations, alone and with the model; and the interface that all methods share."""

import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import COVARIANCE_MODES, CloudConfig, Pipeline, SamplingConfig
from cello3d_ros.covariance.case import Case, MethodSettings
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.estimator import registered_elsewhere
from cello3d_ros.covariance.fused import connected, fused, monte_carlo, registrations
from cello3d_ros.covariance.methods import METHODS, extra_runs, mean_example
from cello3d_ros.covariance.model import Model, constant_model
from cello3d_ros.errors import ModelError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite, kl
from cello3d_ros.geometry.se3 import exp, inverse, transform

T_HAT = exp([0.4, -0.3, 0.05, 0.02, 0.05, 0.6])


@pytest.fixture
def pair(room):
    rng = np.random.default_rng(33)
    reading = prepare(transform(inverse(T_HAT), room[0]), CloudConfig(), rng)
    return reading, prepare(room[1], CloudConfig(), rng)


def case(pair, model, seed=0, **settings):
    """The pair as registered at T_HAT by someone else."""
    return Case(
        *(*pair, registered_elsewhere(T_HAT), describe(*pair, T_HAT, Pipeline()), Pipeline()),
        *(model, np.random.default_rng(seed), MethodSettings(**settings)),
    )


def test_fusion_is_the_weighted_mean_of_prior_and_scatter():
    rng = np.random.default_rng(1)
    half = rng.normal(size=(5, 6))
    xi = 3.0 + np.concatenate([half, -half])  # median and mean are 3
    F = np.diag([1.0, 2, 3, 4, 5, 6])
    expected = (7.0 * F + 2.0 * half.T @ half) / 17.0
    np.testing.assert_allclose(fused(F, xi, 7.0), expected, rtol=1e-12)
    np.testing.assert_array_equal(fused(F, xi[:0]), F)


def test_one_straggler_does_not_move_the_centre():
    xi = np.zeros((9, 6))
    xi[0] = 5.0
    F = fused(np.eye(6), xi, 1.0)
    np.testing.assert_allclose(F, (np.eye(6) + 25.0 * np.ones((6, 6))) / 10.0)


def test_fusion_improves_a_wrong_prior():
    rng = np.random.default_rng(2)
    Y = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    F = 25.0 * Y
    xi = rng.multivariate_normal(np.full(6, 0.01), Y, size=80)
    assert kl(Y, fused(F, xi)) < 0.6 * kl(Y, F)


def test_what_is_linked_to_the_reported_registration_is_kept():
    xi = np.zeros((5, 6))
    xi[:, 0] = [0.08, 0.16, 0.24, 0.4, 0.0]
    xi[4, 5] = 0.06
    np.testing.assert_array_equal(connected(xi, 0.1, 0.05), [True, True, True, False, False])
    assert connected(xi[:0], 0.1, 0.05).shape == (0,)


def test_monte_carlo_is_the_sample_covariance():
    xi = np.random.default_rng(3).normal(size=(12, 6)) + 5.0
    np.testing.assert_allclose(monte_carlo(xi), np.cov(xi.T), rtol=1e-12)
    with pytest.raises(RegistrationError, match="7 registrations agree"):
        monte_carlo(xi[:7])


def test_registrations_scatter_about_the_reported_one(pair):
    model = constant_model(np.eye(6), 704, sampling=SamplingConfig(variance=1e-3))
    xi = registrations(case(pair, model, 4, n_registrations=10))
    assert 8 <= len(xi) <= 10
    assert 0.0 < np.abs(xi).max() < 0.1
    assert len(np.unique(xi[:, 0])) == len(xi)
    again = registrations(case(pair, model, 4, n_registrations=10, n_threads=3))
    np.testing.assert_array_equal(again, xi)


def test_every_method_gives_a_covariance_and_repeats_itself(pair):
    model = constant_model(
        np.diag([3.0, 1, 2, 1, 1, 1]),
        704,
        shape="sandwich",
        sampling=SamplingConfig(variance=1e-3),
    )
    assert set(COVARIANCE_MODES) <= set(METHODS)
    for name, method in METHODS.items():
        found = [method(case(pair, model, 6, n_registrations=10)) for _ in range(2)]
        assert found[0].shape == (6, 6)
        assert is_positive_definite(found[0]), name
        np.testing.assert_array_equal(found[0], found[1])
        assert 1e-4 < np.sqrt(np.trace(found[0])) < 0.3, name


def test_constant_and_model_agree_when_there_is_one_example(pair):
    for shape in ("none", "hessian", "sandwich"):
        model = constant_model(np.diag([3.0, 1, 2, 1, 1, 4]), 704, shape=shape)
        a, b = (METHODS[name](case(pair, model)) for name in ("cello3d", "constant"))
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_costs_are_those_of_the_methods():
    settings = MethodSettings(n_registrations=5)
    runs = {name: extra_runs(name, settings) for name in METHODS}
    assert {name: n for name, n in runs.items() if n} == {
        "sigma_points": 12,
        "monte_carlo": 5,
        "fused": 5,
    }


def test_the_mean_example_is_without_turned_copies():
    covariances = np.array([k * np.eye(6) for k in (1.0, 10.0, 3.0, 30.0)])
    zeros = np.zeros((1, 2))

    def model(rotations):
        return Model(
            theta=zeros,
            mean=np.zeros(2),
            scale=np.ones(2),
            projections=np.zeros((4, 1)),
            covariances=covariances,
            rotations_rad=rotations,
        )

    np.testing.assert_array_equal(mean_example(model([0.0, 1.0])), 2.0 * np.eye(6))
    np.testing.assert_array_equal(mean_example(model([1.0, 0.0])), 20.0 * np.eye(6))
    for rotations in ([1.0, 2.0], [0.0, 1.0, 2.0]):
        with pytest.raises(ModelError, match="4 examples are not turns"):
            model(rotations)
