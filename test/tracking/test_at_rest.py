"""A robot that stands still, or creeps, by real registrations of fresh scans."""

from collections.abc import Callable

import numpy as np
import pytest
from rings import scan, to_box

from cello3d_ros.config import NodeConfig
from cello3d_ros.covariance.model import Model, find_model, load_model
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import mahalanobis
from cello3d_ros.tracking.covariances import twist_covariance
from cello3d_ros.tracking.guess import Place
from cello3d_ros.tracking.tracker import Answer, Tracker
from cello3d_ros.tracking.warmup import room

DT_NS = 10**8


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(find_model("general"))


def of_rings(T: np.ndarray, seed: int) -> np.ndarray:
    """Return 16 rings in a hall, with 2 cm of noise."""
    return scan(to_box(12.0, 9.0, 2.5), T, 16, seed=seed)


def of_points(T: np.ndarray, seed: int) -> np.ndarray:
    """Return the same points of a room in every scan, with 2 cm of noise."""
    points = room(np.random.default_rng(5), 4000)
    noise = np.random.default_rng(seed).normal(scale=0.02, size=points.shape)
    return se3.transform(se3.inverse(T), points) + noise


def answers(
    model: Model,
    see: Callable[[np.ndarray, int], np.ndarray],
    v_m_s: float,
    n: int,
    seed: int,
    pairing: str = "keyframe",
) -> list[Answer]:
    """Track n scans along x by odometry that says that the robot stands still."""
    tracker = Tracker(model, model.pipeline, NodeConfig(pairing=pairing))
    found = []
    for i in range(n):
        T = se3.exp([1e-9 * DT_NS * v_m_s * i, 0, 0, 0, 0, 0])
        answer = tracker.step(i * DT_NS, see(T, 1000 * seed + i), Place(np.eye(4)))
        found += [] if answer is None else [answer]
    assert len(found) == n - 1
    return found


def mean_twist(found: list[Answer]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the twists and its covariance, as if their errors were independent."""
    twists = [se3.log(a.motion.T) / a.span_s for a in found]
    C = [twist_covariance(a.motion.Y, a.span_s, 1e-4, 1e-4, 900.0) for a in found]
    return np.mean(twists, axis=0), np.sum(C, axis=0) / len(C) ** 2


@pytest.mark.parametrize("pairing", ["keyframe", "consecutive"])
@pytest.mark.parametrize("see", [of_rings, of_points])
@pytest.mark.parametrize("seed", range(3))
def test_a_parked_robot_has_no_velocity_and_stays_within_its_covariance(
    model, see, seed, pairing
) -> None:
    found = answers(model, see, 0.0, 80, seed, pairing)
    mean, C = mean_twist(found)
    assert (np.abs(mean) < 2.5 * np.sqrt(np.diag(C))).all()
    assert np.abs(mean[:3]).max() < 2e-3  # m/s
    assert mahalanobis(se3.log(found[-1].pose.T), found[-1].pose.Y) ** 2 / 6 < 2.8  # of 99 %
    assert np.linalg.norm(found[-1].pose.T[:3, 3]) < 0.015
    assert {a.reference_ns for a in found} == {0}


@pytest.mark.parametrize("pairing", ["keyframe", "consecutive"])
@pytest.mark.parametrize("see", [of_rings, of_points])
def test_a_robot_that_creeps_at_1_cm_s_is_followed(model, see, pairing) -> None:
    found = answers(model, see, 0.01, 80, 7, pairing)
    assert abs(found[-1].pose.T[0, 3] - 0.079) < 0.015
    truth = se3.exp([0.079, 0, 0, 0, 0, 0])
    D = mahalanobis(se3.log(se3.inverse(truth) @ found[-1].pose.T), found[-1].pose.Y)
    assert D**2 / 6 < 2.8
    mean, C = mean_twist(found)
    error = mean - [0.01, 0, 0, 0, 0, 0]
    assert (np.abs(error) < 2.5 * np.sqrt(np.diag(C))).all()
    assert abs(error[0]) < 2e-3  # m/s


def test_a_robot_that_moves_has_the_scan_before_as_its_reference(model) -> None:
    found = answers(model, of_points, 2.0, 6, 0, "consecutive")
    assert [a.stamp_ns - a.reference_ns for a in found] == 5 * [DT_NS]
