"""How far a pair may be from every example, by leaving out recordings."""

import math

import numpy as np
import pytest

from cello3d_ros.covariance.model import Model, constant_model
from cello3d_ros.covariance.novelty import nearest_rhos, rho_limit


def model_of(projections: np.ndarray, n_pairs: dict[str, int], n_turns: int = 1) -> Model:
    n = len(projections)
    return Model(
        theta=np.ones((projections.shape[1], 3)),
        mean=np.zeros(3),
        scale=np.ones(3),
        projections=projections,
        covariances=np.tile(np.eye(6), (n, 1, 1)),
        provenance={"recordings": n_pairs, "rotations_rad": list(range(n_turns))},
    )


def test_the_nearest_example_is_sought_in_other_recordings() -> None:
    """On a line at 0, 1 | 5, 6: distances to the other recording are 5, 4, 4, 5."""
    model = model_of(np.array([[0.0], [1.0], [5.0], [6.0]]), {"a": 2, "b": 2})
    np.testing.assert_allclose(nearest_rhos(model), [25.0, 16.0, 16.0, 25.0])
    assert rho_limit(model, 1.0) == 25.0
    assert rho_limit(model, 0.0) == 16.0


def test_turned_copies_are_found_but_not_asked() -> None:
    model = model_of(np.array([[0.0], [2.0], [5.0], [3.0]]), {"a": 1, "b": 1}, n_turns=2)
    np.testing.assert_allclose(nearest_rhos(model), [9.0, 9.0])


def test_against_a_plain_search() -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(60, 4))
    sizes = {"a": 10, "b": 30, "c": 20}
    group = np.repeat([0, 1, 2], [10, 30, 20])
    expected = [
        min(((X[i] - X[j]) ** 2).sum() for j in range(60) if group[j] != group[i])
        for i in range(60)
    ]
    np.testing.assert_allclose(nearest_rhos(model_of(X, sizes)), expected)


def test_without_recordings_every_example_is_its_own() -> None:
    model = model_of(np.array([[0.0], [1.0], [5.0]]), {"unlike": 7})
    np.testing.assert_allclose(nearest_rhos(model), [1.0, 1.0, 16.0])


@pytest.mark.parametrize("n", [1, 3])
def test_one_recording_says_nothing(n: int) -> None:
    model = model_of(np.arange(float(n))[:, None], {"a": n})
    assert rho_limit(model, 0.99) == math.inf
    assert rho_limit(constant_model(np.eye(6), 704), 0.99) == math.inf


def test_many_examples_are_asked_evenly() -> None:
    X = np.arange(5001.0)[:, None]
    found = nearest_rhos(model_of(X, {"": 0}))
    assert 1500 < len(found) <= 2000
    assert (found == 1.0).all()
