"""The compiled sums against the plain formula, and the prediction that rests on them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from cello3d_ros.covariance.model import Model, predict, project, weigh
from cello3d_ros.covariance.sums import TWICE, pack, squared_distances, unpack, weighted_sum
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.geometry.se3 import Array

R, D = 16, 40


@pytest.fixture(scope="module")
def model() -> Model:
    """20 011 examples, no multiple of a block, whose sizes span twelve orders of magnitude."""
    rng = np.random.default_rng(0)
    theta = rng.normal(size=(R, D)) * 0.3
    A = rng.normal(size=(20_011, 6, 9)) * 10.0 ** rng.uniform(-6, 6, size=(20_011, 1, 1))
    return Model(
        theta=theta,
        mean=np.zeros(D),
        scale=np.ones(D),
        projections=rng.normal(size=(20_011, D)) @ theta.T,
        covariances=A @ np.swapaxes(A, 1, 2),
    )


def plain(model: Model, d: Array) -> Array:
    """Return F by the printed formula in extended precision."""
    q = project(d, model.theta, model.mean, model.scale).astype(np.longdouble)
    rho = ((model.projections - q) ** 2).sum(axis=1)
    excess = rho - rho.min()
    w = np.exp(-excess)
    F = np.einsum("k,kij->ij", w / w.sum(), model.covariances.astype(np.longdouble))
    a = np.longdouble(model.mean_weight)
    return np.asarray((1 - a) * F + a * model.covariances.astype(np.longdouble).mean(axis=0))


def test_distances_are_those_of_the_formula() -> None:
    rng = np.random.default_rng(1)
    for r in (1, 3, 16, 17):
        points, query = rng.normal(size=(500, r)), rng.normal(size=r)
        expected = ((points - query) ** 2).sum(axis=1)
        np.testing.assert_allclose(squared_distances(points, query), expected, rtol=1e-14)
        assert squared_distances(points, points[7])[7] == 0.0


def test_the_weighted_sum_is_exact_to_rounding_and_skips_what_weighs_nothing() -> None:
    rng = np.random.default_rng(2)
    w, rows = rng.uniform(size=5000), rng.normal(size=(5000, 21))
    expected = [math.fsum(w * column) for column in rows.T]
    np.testing.assert_allclose(weighted_sum(w, rows), expected, rtol=1e-12, atol=1e-12)
    w[::3], rows[::3] = 0.0, np.inf
    assert np.isfinite(weighted_sum(w, rows)).all()


@pytest.mark.parametrize("factor", [0.0, 0.1, 1.0, 30.0])
@pytest.mark.parametrize("mean_weight", [0.0, 0.15])
def test_a_prediction_is_the_plain_formula_to_1e_12(
    model: Model, factor: float, mean_weight: float
) -> None:
    scaled = dataclasses.replace(
        model,
        theta=factor * model.theta,
        projections=factor * model.projections,
        mean_weight=mean_weight,
    )
    for d in np.random.default_rng(3).normal(size=(4, D)):
        F, expected = predict(scaled, d).covariance, plain(scaled, d)
        assert np.abs(F - expected).max() <= 1e-12 * np.abs(expected).max()
        assert is_positive_definite(F)
        np.testing.assert_array_equal(F, F.T)


def test_weights_leave_their_argument_alone() -> None:
    rho = np.array([3.0, 1.0, 900.0])
    before = rho.copy()
    w = weigh(rho)
    np.testing.assert_array_equal(rho, before)
    np.testing.assert_allclose(w, [np.exp(-2.0), 1.0, 0.0] / (1.0 + np.exp(-2.0)), rtol=1e-15)


def test_packing_loses_nothing_and_counts_each_number_as_often_as_it_stands() -> None:
    A, B = np.random.default_rng(4).normal(size=(2, 5, 6, 6))
    A, B = A + np.swapaxes(A, 1, 2), B + np.swapaxes(B, 1, 2)
    np.testing.assert_array_equal(unpack(pack(A)), A)
    traces = np.trace(A @ B, axis1=1, axis2=2)
    np.testing.assert_allclose((pack(A) * TWICE * pack(B)).sum(axis=1), traces, rtol=1e-12)
