"""How far a pair may be from every example."""

import math

import numpy as np
import pytest

from cello3d_ros.covariance.model import constant_model, predict
from cello3d_ros.covariance.novelty import rho_limit


@pytest.mark.parametrize(("quantile", "limit"), [(0.0, 1.0), (0.25, 3.0), (0.4, 3.6), (1.0, 20.0)])
def test_the_limit_is_the_quantile_that_the_model_keeps(quantile: float, limit: float) -> None:
    model = constant_model(np.eye(6), 3, rho_quantiles=np.array([1.0, 3.0, 4.0, 16.0, 20.0]))
    assert rho_limit(model, quantile) == pytest.approx(limit)
    assert predict(model, np.zeros(3)).novelty == 0.0


def test_a_model_that_keeps_none_knows_no_limit() -> None:
    assert rho_limit(constant_model(np.eye(6), 704), 0.99) == math.inf
