"""The motion within a scan is undone: law, kernel against numpy, edges."""

import numpy as np
import pytest

from cello3d_ros.clouds.motion import sweep_of, undistorted
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.pose_track import PoseTrack

STAMP = 1_700_000_000 * 10**9


def by_numpy(points: np.ndarray, time_s: np.ndarray, motion: Motion) -> np.ndarray:
    """Move each point by its own pose: the plain version of the kernel."""
    T = motion.at(time_s)
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def wild_motion(rate: float) -> Motion:
    """Return the motion of a track of noisy poses, at a rate of turning in rad/s."""
    rng = np.random.default_rng(5)
    at_s = np.linspace(-0.15, 0.15, 13)
    twists = at_s[:, None] * np.array([9.0, 2.0, -1.0, 0.1, 0.2, rate])
    T = se3.exp(twists) @ se3.exp(0.01 * min(rate, 1.0) * rng.normal(size=(13, 6)))
    stamps = STAMP + np.round(1e9 * at_s).astype(np.int64)
    return PoseTrack.of_poses(stamps, T).motion(STAMP, -0.14, 0.14)


@pytest.mark.parametrize("rate", [0.0, 1e-9, 1e-4, 1.0, 30.0])
@pytest.mark.parametrize("order", ["in time", "by ring", "at random"])
def test_the_kernel_is_the_numpy_formula(rate: float, order: str) -> None:
    rng = np.random.default_rng(1)
    points, motion = rng.normal(scale=20.0, size=(2000, 3)), wild_motion(rate)
    time_s = np.linspace(-0.14, 0.14, 2000)
    if order == "by ring":
        time_s = np.tile(time_s[::10], 10)
    elif order == "at random":
        time_s = rng.permutation(time_s)
    before = points.copy(), time_s.copy()
    moved = undistorted(points, time_s, motion)
    np.testing.assert_allclose(moved, by_numpy(points, time_s, motion), rtol=0, atol=1e-11)
    assert np.array_equal(points, before[0])
    assert np.array_equal(time_s, before[1])


@pytest.mark.parametrize("first_s", [-0.1, -0.05, 0.0])
def test_undoing_the_true_motion_gives_the_points_seen_at_the_stamp(first_s: float) -> None:
    """Whatever drivers stamp: the end of the sweep, its middle or its start."""
    motion = wild_motion(1.0)
    straight = np.random.default_rng(2).normal(scale=20.0, size=(500, 3))
    time_s = np.linspace(first_s, first_s + 0.1, 500)
    T = se3.inverse(motion.at(time_s))
    seen = np.einsum("nij,nj->ni", T[:, :3, :3], straight) + T[:, :3, 3]
    assert np.abs(seen - straight).max() > 0.3
    np.testing.assert_allclose(undistorted(seen, time_s, motion), straight, atol=1e-11)


def test_one_twist_holds_for_ever_and_points_at_the_stamp_stay() -> None:
    xi = np.array([1.0, -2.0, 0.5, 0.3, -0.2, 2.0])
    time_s = np.array([-5.0, -1e-12, 0.0, 1e-12, 5.0])
    motion = Motion.constant(xi)
    np.testing.assert_allclose(motion.at(time_s), se3.exp(time_s[:, None] * xi), atol=1e-12)
    points = np.random.default_rng(0).normal(size=(5, 3))
    moved = undistorted(points, time_s, motion)
    assert np.array_equal(moved[2], points[2])
    np.testing.assert_allclose(moved, by_numpy(points, time_s, motion), atol=1e-12)
    assert undistorted(points[:0], time_s[:0], motion).shape == (0, 3)


def test_the_motion_of_a_sensor_is_that_of_its_base_through_the_mount() -> None:
    motion = wild_motion(1.0)
    X = se3.exp([0.3, -0.1, 1.5, 0.2, 0.1, 2.5])
    time_s = np.linspace(-0.14, 0.14, 50)
    expected = se3.inverse(X) @ motion.at(time_s) @ X
    np.testing.assert_allclose(motion.of_sensor(X).at(time_s), expected, atol=1e-12)


def test_a_sweep_reaches_from_the_first_to_the_last_time_and_the_stamp() -> None:
    assert sweep_of(np.array([-0.1, -0.02])) == (-0.1, 0.0)
    assert sweep_of(np.array([0.02, 0.1])) == (0.0, 0.1)
    assert sweep_of(np.empty(0)) == (0.0, 0.0)
