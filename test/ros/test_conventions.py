"""The numbers of docs/covariance_conventions.md, and that they mean what the page says."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import compound_right, to_fixed_axes
from cello3d_ros.tracking.covariances import ros_covariance, twist_covariance

PAGE = Path(__file__).parents[2] / "docs" / "covariance_conventions.md"
BOUNDS = (1e-6, 1e-6, 900.0)


@pytest.fixture(scope="module")
def page() -> dict[str, np.ndarray]:
    """Names and numbers of all YAML blocks of the page."""
    numbers: dict[str, np.ndarray] = {}
    for block in re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL):
        numbers |= {name: np.array(value) for name, value in yaml.safe_load(block).items()}
    assert len(numbers) == 8
    return numbers


def test_the_covariance_of_the_page_is_the_one_that_is_published(page) -> None:
    T = se3.pose(page["pose"][:3], page["pose"][3:])
    Y = np.diag(page["Y_diagonal"])
    C = ros_covariance(Y, T[:3, :3], *BOUNDS)
    np.testing.assert_allclose(C, np.diag(page["C_diagonal"]), atol=1e-12)
    dt_s = float(page["dt_s"])
    np.testing.assert_allclose(se3.log(T) / dt_s, page["twist"], atol=1e-8)
    twist = twist_covariance(Y, dt_s, *BOUNDS)
    np.testing.assert_allclose(twist, np.diag(page["twist_diagonal"]), atol=1e-12)


def test_the_chain_of_the_page_is_the_one_that_is_published(page) -> None:
    T, Y = se3.pose(page["pose"][:3], page["pose"][3:]), np.diag(page["Y_diagonal"])
    chain = compound_right(T, Y, T, Y, order=4)
    expected = se3.pose(page["chain_pose"][:3], page["chain_pose"][3:])
    np.testing.assert_allclose(chain.T, expected, atol=1e-12)
    C = ros_covariance(chain.Y, chain.T[:3, :3], *BOUNDS)
    np.testing.assert_allclose(np.diag(C), page["chain_C_diagonal"], rtol=2e-4)


def errors(T_mean: np.ndarray, noisy: np.ndarray) -> np.ndarray:
    """Position minus its mean; rotation vector about fixed axes."""
    turn = Rotation.from_matrix(noisy[:, :3, :3] @ T_mean[:3, :3].T).as_rotvec()
    return np.hstack([noisy[:, :3, 3] - T_mean[:3, 3], turn])


def test_what_the_page_says_is_what_samples_do(page) -> None:
    """Steps drawn in the reading's axes scatter as the published covariances say."""
    rng = np.random.default_rng(0)
    T, Y = se3.pose(page["pose"][:3], page["pose"][3:]), np.diag(page["Y_diagonal"])
    first, second = (T @ se3.exp(rng.multivariate_normal(np.zeros(6), Y, 200_000)) for _ in "12")
    for T_mean, noisy, name in (
        (T, first, "C_diagonal"),
        (T @ T, first @ second, "chain_C_diagonal"),
    ):
        sampled = np.cov(errors(T_mean, noisy).T)
        np.testing.assert_allclose(np.diag(sampled), page[name], rtol=0.02)


def test_turning_back_gives_the_covariance_of_the_reading(page) -> None:
    T = se3.pose(page["pose"][:3], page["pose"][3:])
    Y = to_fixed_axes(T[:3, :3].T, np.diag(page["C_diagonal"]))
    np.testing.assert_allclose(Y, np.diag(page["Y_diagonal"]), atol=1e-15)
