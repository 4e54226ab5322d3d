"""config/examples/robot_localization.yaml in a small copy of the filter that reads it."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from filters import VELOCITIES, corrected, grown, predicted
from scipy.special import chdtri

FILE = Path(__file__).parents[1] / "config" / "examples" / "robot_localization.yaml"
N_RUNS, SECONDS, LIDAR_HZ = 60, 20, 10
OLD = [0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015]


def filtered(Q: np.ndarray, hz: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Final pose errors (n, 6) of a filter of twists, and their covariances (n, 6, 6).

    Robots of up to 1.5 m/s speed up and turn at random; their twists are the steps of 0.1 s that
    registrations measure, with 5 mm and 1 mrad of error.
    """
    rng = np.random.default_rng(seed)
    n, dt = N_RUNS, 1.0 / (LIDAR_HZ * round(hz / LIDAR_HZ))
    sigma = np.repeat([0.005, 0.001], 3) * LIDAR_HZ
    true, x = np.zeros((n, 15)), np.zeros((n, 15))
    true[:, 6] = x[:, 6] = 1.0
    P = np.tile(1e-9 * np.eye(15), (n, 1, 1))
    for _ in range(SECONDS * LIDAR_HZ):
        turn = np.zeros((n, 3))
        turn[:, 2] = rng.normal(scale=0.5, size=n)
        true[:, 12] = np.clip(rng.normal(size=n) + 1.0 - true[:, 6], -1.0, 1.0)
        twist = np.zeros((n, 6))
        for _ in range(round(1.0 / (dt * LIDAR_HZ))):
            true[:, 9:12] += (turn - true[:, 9:12]) * dt
            twist += np.hstack([true[:, 6:9] + 0.5 * dt * true[:, 12:], true[:, 9:12]])
            true = predicted(true, dt)
            x, P = grown(x, P, Q, dt)
        z = twist * dt * LIDAR_HZ + sigma * rng.normal(size=(n, 6))
        x, P = corrected(x, P, VELOCITIES, z, np.diag(sigma**2))
    return (x - true)[:, :6], P[:, :6, :6]


def process_noise() -> tuple[np.ndarray, float]:
    """The example's matrix and frequency."""
    tree = yaml.safe_load(FILE.read_text())["ekf_filter_node"]["ros__parameters"]
    Q = np.array(tree["process_noise_covariance"]).reshape(15, 15)
    return Q, tree["frequency"]


def share_of_sigma(errors: np.ndarray, P: np.ndarray) -> float:
    """Mean squared distance of the position, over its degrees of freedom."""
    d2 = np.einsum("ni,nij,nj->n", errors[:, :3], np.linalg.inv(P[:, :3, :3]), errors[:, :3])
    return float(d2.mean() / 3)


def test_the_filter_of_the_example_is_honest_about_where_it_is() -> None:
    Q, hz = process_noise()
    errors, P = filtered(Q, hz)
    assert 0.5 < share_of_sigma(errors, P) < 1.5
    d2 = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(P), errors)
    assert np.mean(d2 < chdtri(6, 0.05)) > 0.85
    sigma_m = np.sqrt(np.trace(P[:, :3, :3], axis1=1, axis2=2))
    assert sigma_m.mean() < 0.5  # after 20 m


def test_the_default_process_noise_is_not() -> None:
    """What a user gets who leaves it out: metres where the error is centimetres."""
    _, hz = process_noise()
    errors, P = filtered(np.diag(OLD), hz)
    assert share_of_sigma(errors, P) < 0.05


@pytest.mark.parametrize("index", range(15))
def test_process_noise_is_diagonal_and_positive(index: int) -> None:
    Q, _ = process_noise()
    assert Q[index, index] > 0.0
    assert np.count_nonzero(Q[index]) == 1
