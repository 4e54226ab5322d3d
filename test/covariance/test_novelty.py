"""How far a pair may be from every example before it is unknown."""

import numpy as np
import pytest

from cello3d_ros.covariance.model import constant_model, find_model, load_model, predict


@pytest.mark.parametrize("quantile", [0.0, 0.25, 0.5, 0.9, 0.985, 0.99, 0.999])
def test_novelty_is_beyond_a_quantile_where_the_distance_is_beyond_that_of_the_model(
    quantile: float,
) -> None:
    """Unknown by the rank of the distance is unknown by the distance itself; the shipped model."""
    model = load_model(find_model("general"))
    quantiles = model.rho_quantiles
    limit = np.interp(quantile, np.linspace(0.0, 1.0, len(quantiles)), quantiles)
    rng, verdicts = np.random.default_rng(8), []
    example = np.linalg.lstsq(model.theta, model.projections[0])[0]
    for size in np.geomspace(1e-4, 30.0, 120):
        away = example + size * rng.normal(size=model.n_features)
        inputs = model.mean + model.scale * away
        found = predict(model, inputs, np.eye(6), [1.0, 0.0])
        assert (found.novelty > quantile) == (found.nearest_rho > limit)
        verdicts.append(found.novelty > quantile)
    assert any(verdicts)
    assert not all(verdicts)


def test_nothing_is_beyond_the_quantile_1() -> None:
    model = load_model(find_model("general"))
    far = model.mean + 1e4 * model.scale
    assert predict(model, far, np.eye(6), [1.0, 0.0]).novelty == 1.0


def test_a_model_that_keeps_no_quantiles_calls_nothing_novel() -> None:
    assert predict(constant_model(np.eye(6), 704), np.full(704, 1e3)).novelty == 0.0
