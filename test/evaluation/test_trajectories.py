"""Odometry: chains of known covariances, and ICP between scans of a room."""

import dataclasses

import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, SamplingConfig
from cello3d_ros.covariance.lost import Lost
from cello3d_ros.covariance.model import constant_model
from cello3d_ros.errors import RegistrationError
from cello3d_ros.evaluation import trajectories as module
from cello3d_ros.evaluation.result import Consistency, Distances
from cello3d_ros.evaluation.trajectories import (
    Runs,
    compound_path,
    consistency,
    length_m,
    odometry_runs,
    runs_of_models,
)
from cello3d_ros.geometry.gaussian import INDEPENDENT, Bias, GaussianPose, is_positive_definite
from cello3d_ros.geometry.se3 import exp, inverse, log, transform


def test_a_chain_of_true_covariances_is_consistent():
    """Check 5 of the design: 2.350 in 6 dof and 1.596 in 3, over 35 steps."""
    rng = np.random.default_rng(1)
    motions = exp(rng.normal(scale=0.3, size=(35, 6)))
    roots = rng.normal(size=(35, 6, 6)) * 0.004
    Y = roots @ np.swapaxes(roots, 1, 2)
    n = 3000
    finals, truth = np.tile(np.eye(4), (n, 1, 1)), np.eye(4)
    for T, root in zip(motions, roots, strict=True):
        finals = finals @ T @ exp(rng.normal(size=(n, 6)) @ root.T)
        truth = truth @ T
    chain = compound_path([GaussianPose(*step) for step in zip(motions, Y, strict=True)])[-1]
    np.testing.assert_allclose(chain.T, truth, atol=1e-12)
    runs = Runs(
        log(inverse(truth) @ finals),
        np.tile(chain.Y, (n, 1, 1)),
        np.zeros(n, np.bool_),
        np.zeros(n, np.bool_),
        0,
    )
    report = consistency(runs)
    assert report.dm_6dof == pytest.approx(2.350, abs=0.05)
    assert report.dm_translation == pytest.approx(1.596, abs=0.05)
    assert report.dm_rotation == pytest.approx(1.596, abs=0.05)
    assert report.coverage_95 == pytest.approx(0.95, abs=0.015)
    assert report.nees_over_6 == pytest.approx(1.0, abs=0.03)
    assert report.verdict == "about right"


def test_distances_are_those_of_the_blocks():
    Y = np.tile(np.diag([4.0, 4, 4, 9, 9, 9]), (2, 1, 1))
    Y[:, 0, 3] = Y[:, 3, 0] = 3.0
    xi = np.array([[2.0, 0, 0, 3.0, 0, 0], [0, 40.0, 0, 0, 0, 0]])
    report = consistency(Runs(xi, Y, np.array([False, True]), np.array([True, True]), 3))
    assert (report.n_runs, report.n_failed, report.n_lost) == (2, 3, 1)
    assert (report.n_told, report.n_lost_told) == (2, 1)
    near = report.without_lost
    assert near.dm_translation == pytest.approx(1.0)
    assert near.dm_rotation == pytest.approx(1.0)
    assert near.dm_6dof == pytest.approx(np.sqrt(4.0 / 3.0))  # correlation 0.5
    assert near.coverage_95 == 1.0
    assert report.coverage_95 == 0.5
    assert report.dm_translation == pytest.approx(10.5)


def test_a_chain_too_wide_for_the_fourth_order_stays_positive_definite():
    wide = GaussianPose(exp([1.0, 0, 0, 0, 0, 0.5]), np.diag([1.0, 1, 1, 2, 2, 2]))
    chain = compound_path([wide] * 6)[-1]
    assert is_positive_definite(chain.Y)


def test_without_any_run_there_are_no_distances():
    none = np.zeros(0, np.bool_)
    report = consistency(Runs(np.zeros((0, 6)), np.zeros((0, 6, 6)), none, none, 4))
    counts = {"n_runs": 0, "n_failed": 4, "n_lost": 0, "n_told": 0, "n_lost_told": 0}
    assert report == Consistency(**counts, without_lost=Distances())


def test_length_is_that_of_the_path():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1, :3, 3], T[2, :3, 3] = [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]
    assert length_m(T) == pytest.approx(7.0)


@pytest.fixture
def walk(room):
    rng = np.random.default_rng(2)
    poses = np.array([exp([0.3 * k, 0.1 * k, 0, 0, 0, 0.1 * k]) for k in range(3)])
    scans = [room[0], room[1], room[0][::-1]]
    clouds = [
        prepare(transform(inverse(T), scan), CloudConfig(), rng)
        for T, scan in zip(poses, scans, strict=True)
    ]
    return clouds, np.array([exp([5.0, 0, 0, 0, 0, 1.0])]) @ poses


def a_model(sigma, **settings):
    return constant_model(sigma**2 * np.eye(6), 704, sampling=SamplingConfig(**settings))


def test_odometry_ends_near_the_truth_whatever_the_threads(walk):
    model = a_model(0.01, variance=1e-3)
    runs = odometry_runs(*walk, model, 4, seed=3)
    threaded = odometry_runs(*walk, model, 4, seed=3, n_threads=2)
    np.testing.assert_array_equal(runs.xi, threaded.xi)
    assert runs.n_failed == 0
    assert not runs.lost.any()
    assert 0.0 < np.abs(runs.xi).max() < 0.05
    assert len(np.unique(runs.xi[:, 0])) == 4  # each run draws its own
    assert (np.linalg.eigvalsh(runs.Y)[:, 0] > 1e-4).all()  # of two steps
    assert [len(path) for path in runs.paths] == [2, 2, 2, 2]
    T_true = inverse(walk[1][0]) @ walk[1][1]
    for path, xi, Y in zip(runs.paths, runs.xi, runs.Y, strict=True):
        assert np.abs(log(inverse(T_true) @ path[0].T)).max() < 0.05
        T_end = inverse(walk[1][0]) @ walk[1][2]
        np.testing.assert_allclose(path[-1].T @ exp(-xi), T_end, atol=1e-12)
        np.testing.assert_array_equal(path[-1].Y, Y)


def test_lost_and_failed_runs_are_counted(walk, monkeypatch):
    real, calls = module.Estimator.register, []

    def sometimes(*arguments):
        calls.append(None)
        answer = real(*arguments)
        if len(calls) == 1:
            raise RegistrationError("no answer")
        if len(calls) == 3:
            T = answer.registration.T_ref_read @ exp([0.0, 0, 0, 0, 0.2, 0])
            answer = answer._replace(registration=answer.registration._replace(T_ref_read=T))
        return answer

    monkeypatch.setattr(module.Estimator, "register", sometimes)
    runs = odometry_runs(*walk, a_model(0.01, variance=1e-3), 3)
    assert runs.n_failed == 1
    assert runs.lost.tolist() == [True, False]
    assert not runs.told.any()


def test_runs_are_told_lost_by_the_model_that_knows(walk):
    V = np.diag([0.8, 0.5, 0.3, 0.1, 0.1, 0.1])
    model = a_model(0.01, variance=1e-3)
    runs = odometry_runs(*walk, model, 2, seed=3)
    for limit_m, is_told in ((1e-9, True), (10.0, False)):
        knowing = dataclasses.replace(model, lost=Lost(limit_m, V))
        found = odometry_runs(*walk, knowing, 2, seed=3)
        np.testing.assert_array_equal(found.xi, runs.xi)
        assert found.told.tolist() == [is_told] * 2
        assert not found.lost.any()
        assert (np.linalg.eigvalsh(found.Y[0] - runs.Y[0])[-1] > 0.7) == is_told


def test_each_model_compounds_with_its_own_bias(walk):
    bias = Bias(0.6, 3.0)
    models = [
        dataclasses.replace(a_model(0.01, variance=1e-3), bias=b) for b in (INDEPENDENT, bias)
    ]
    alone = odometry_runs(*walk, models[1], 2, seed=3)
    found = runs_of_models(*walk, models, 2, seed=3)
    np.testing.assert_array_equal(found[1].Y, alone.Y)
    for runs, b in zip(found, (INDEPENDENT, bias), strict=True):
        steps = [path[0].T for path in runs.paths], [path[1].T for path in runs.paths]
        for first, last, Y in zip(*steps, runs.Y, strict=True):
            each = [
                GaussianPose(T, models[0].covariances[0]) for T in (first, inverse(first) @ last)
            ]
            np.testing.assert_allclose(Y, compound_path(each, b)[-1].Y, rtol=1e-9, atol=1e-15)
    assert np.trace(found[1].Y[0]) > 1.2 * np.trace(found[0].Y[0])
