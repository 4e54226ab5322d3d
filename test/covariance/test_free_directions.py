"""Directions that no plane holds have no answer, however few or many the beams."""

import numpy as np
import pytest
from rings import scan, to_box, to_plane, to_tunnel

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.model import find_model, load_model
from cello3d_ros.errors import FreeDirectionError
from cello3d_ros.geometry.se3 import exp, inverse, log

BEAMS = {16: (-15.0, 15.0), 32: (-25.0, 15.0), 64: (-25.0, 2.0)}
STEP = exp([0.5, 0.1, 0.0, 0.0, 0.0, 0.05])


@pytest.fixture(scope="module")
def estimator():
    return Estimator(load_model(find_model("general")))


def step(estimator, hit, n_beams, seed, T_init=STEP):
    """Register two scans, the second from where STEP leads."""
    rng, cloud = np.random.default_rng(seed), estimator.pipeline.cloud
    reading, reference = (
        prepare(scan(hit, T, n_beams, BEAMS[n_beams], 2 * seed + i), cloud, rng)
        for i, T in enumerate((STEP, np.eye(4)))
    )
    return estimator.register(reading, reference, T_init, rng)


@pytest.mark.parametrize("n_beams", BEAMS)
@pytest.mark.parametrize(
    ("hit", "free"),
    [
        (to_plane(2, -1.5), "x, y, yaw"),
        (to_plane(1, 4.0), "x, z, pitch"),
        (to_tunnel(3.0), "x(, roll)?"),
    ],
    ids=["flat ground or water", "a single wall", "a plain tunnel"],
)
def test_what_no_plane_holds_is_named_and_has_no_answer(estimator, hit, free, n_beams):
    for seed in range(3):
        with pytest.raises(FreeDirectionError, match=f"holds {free} of the sensor"):
            step(estimator, hit, n_beams, seed)


START = STEP @ exp([0.1, -0.1, 0.02, 0.0, 0.01, 0.03])


@pytest.mark.parametrize("n_beams", BEAMS)
def test_walls_on_all_sides_have_an_answer(estimator, n_beams):
    for seed in range(3):
        found = step(estimator, to_box(12.0, 9.0, 1.2), n_beams, seed, START)
        assert np.linalg.norm(log(inverse(STEP) @ found.registration.T_ref_read)) < 0.05


@pytest.mark.parametrize("n_beams", BEAMS)
def test_a_corridor_of_60_m_is_answered_within_its_covariance_or_its_length_is_free(
    estimator, n_beams
):
    """Few beams meet the walls at its ends: ICP then errs by decimetres along it."""
    for seed in range(3):
        try:
            found = step(estimator, to_box(30.0, 2.0, 1.2), n_beams, seed, START)
        except FreeDirectionError as error:
            if "holds x of the sensor" in str(error):
                continue
            raise
        xi = log(inverse(STEP) @ found.registration.T_ref_read)
        assert xi @ np.linalg.solve(found.covariance, xi) < 22.46  # .999 of 6 degrees of freedom
