"""On a meadow with few trees or none there is no false certainty, however few the beams."""

from dataclasses import replace

import numpy as np
import pytest
from rings import scan, to_meadow

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig
from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.model import find_model, load_model
from cello3d_ros.errors import FreeDirectionError, NotConvergedError
from cello3d_ros.geometry.se3 import exp, inverse, log

BEAMS = {16: (-15.0, 15.0), 32: (-25.0, 15.0), 64: (-25.0, 2.0)}
GROUNDS = {"flat": (0.0, 0.0), "uneven": (0.05, 0.0), "grass": (0.05, 0.05), "rough": (0.15, 0.05)}
N_TREES = (0, 3, 8)


@pytest.fixture(scope="module")
def estimator():
    model = load_model(find_model("general"))
    return Estimator(model, pipeline=replace(model.pipeline, cloud=CloudConfig()))


def answer(estimator, n_beams, ground, n_trees, seed):
    """Return D^2/6 of a step of half a metre, None if it has no answer."""
    trees = np.random.default_rng(1000 + seed).uniform(-25.0, 25.0, (n_trees, 2))
    hit, height = to_meadow(*GROUNDS[ground], trees[np.hypot(*trees.T) > 3.0], seed)
    poses = [exp([x, 0.2 * x, height(np.array([x, 0.2 * x])), 0, 0, 0.1 * x]) for x in (0.0, 0.5)]
    rng = np.random.default_rng(seed)
    reference, reading = (
        prepare(scan(hit, T, n_beams, BEAMS[n_beams], 2 * seed + i), estimator.pipeline.cloud, rng)
        for i, T in enumerate(poses)
    )
    step = inverse(poses[0]) @ poses[1]
    try:
        found = estimator.register(reading, reference, step, rng)
    except (FreeDirectionError, NotConvergedError):
        return None
    xi = log(inverse(step) @ found.T_ref_read)
    return xi @ np.linalg.solve(found.covariance, xi) / 6


@pytest.mark.parametrize("n_beams", BEAMS)
def test_an_answer_on_open_ground_is_not_too_certain(estimator, n_beams):
    found = [
        answer(estimator, n_beams, ground, n_trees, 10 * n_trees + i)
        for i, ground in enumerate(GROUNDS)
        for n_trees in N_TREES
    ]
    answers = np.array([d for d in found if d is not None])
    assert len(answers) >= 6  # it is not honest by silence
    assert np.max(answers) < 10.0
    assert np.mean(answers) < 2.0


@pytest.mark.parametrize("n_beams", BEAMS)
def test_flat_ground_without_trees_has_no_answer(estimator, n_beams):
    assert answer(estimator, n_beams, "flat", 0, 0) is None
