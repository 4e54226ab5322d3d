"""Drift has the stated statistics; odometry is simulated only where that is asked for."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import Scan, open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.odometry import Drift, SimulatedOdometry, drift_odometry


def walk(n: int, step: float, turn: float):
    """Return n poses, each ``step`` metres ahead of and ``turn`` rad left of the one before."""
    one = se3.exp([step, 0, 0, 0, 0, turn])
    poses = [se3.exp([3.0, -2.0, 1.0, 0.1, 0.2, 0.3])]
    for _ in range(n - 1):
        poses.append(poses[-1] @ one)
    return np.stack(poses)


def errors(truth, odometry):
    """Return the twists (n - 1, 6) by which the relative motions differ."""
    true, seen = (se3.inverse(T[:-1]) @ T[1:] for T in (truth, odometry))
    return se3.log(se3.inverse(true) @ seen)


def test_odometry_starts_at_identity_whatever_the_first_pose() -> None:
    odometry = drift_odometry(walk(5, 0.5, 0.1), np.random.default_rng(0))
    assert np.array_equal(odometry[0], np.eye(4))
    assert all(se3.is_rigid(T, 1e-9) for T in odometry)


def test_without_noise_odometry_is_ground_truth_seen_from_the_start() -> None:
    truth = walk(20, 0.5, 0.1)
    odometry = drift_odometry(truth, np.random.default_rng(0), Drift(0.0, 0.0, 0.0))
    assert np.allclose(odometry, se3.inverse(truth[0]) @ truth, atol=1e-12)


def test_drift_straight_ahead_is_two_percent_and_half_a_degree_a_metre() -> None:
    truth = walk(4000, 0.5, 0.0)
    xi = errors(truth, drift_odometry(truth, np.random.default_rng(1)))
    assert np.allclose(xi[:, :3].std(axis=0), 0.02 * 0.5, rtol=0.06)
    assert np.allclose(xi[:, 3:].std(axis=0), np.radians(0.5) * 0.5, rtol=0.06)
    assert np.abs(xi.mean(axis=0) / xi.std(axis=0)).max() < 4 / np.sqrt(len(xi))


def test_drift_of_a_turn_in_place_is_a_share_of_the_turn() -> None:
    truth = walk(4000, 0.0, 0.2)
    xi = errors(truth, drift_odometry(truth, np.random.default_rng(2)))
    assert np.allclose(xi[:, 3:].std(axis=0), 0.05 * 0.2, rtol=0.06)
    assert np.abs(xi[:, :3]).max() < 1e-9


def test_a_robot_that_stands_still_does_not_drift() -> None:
    odometry = drift_odometry(walk(10, 0.0, 0.0), np.random.default_rng(3))
    assert np.allclose(odometry, np.eye(4), atol=1e-12)


def test_one_pose_is_enough() -> None:
    assert drift_odometry(np.eye(4)[None], np.random.default_rng(0)).shape == (1, 4, 4)


def test_ground_truth_is_not_changed_in_place() -> None:
    truth = walk(5, 0.5, 0.1)
    before = truth.copy()
    drift_odometry(truth, np.random.default_rng(0))
    assert np.array_equal(truth, before)


def bag(path: Path, truth: list, odometry: list) -> Path:
    """Write a bag of scans with a pose of each kind or None."""
    pairs = enumerate(zip(truth, odometry, strict=True))
    write_bag(
        path,
        [
            Scan(
                stamp_ns=10**18 + k * 10**8,
                points=np.ones((4, 3)),
                T_world_sensor=T,
                T_odom_sensor=T_odom,
            )
            for k, (T, T_odom) in pairs
        ],
    )
    return path


def test_simulated_odometry_replaces_what_is_recorded_and_needs_ground_truth(tmp_path) -> None:
    truth = [None, *walk(4, 0.5, 0.1)]
    recorded = [se3.exp([9.0, 0, 0, 0, 0, 0])] * 5
    recording = SimulatedOdometry(open_recording(bag(tmp_path / "a", truth, recorded)))
    scans = list(recording)
    assert [s.T_odom_sensor is None for s in scans] == [True, False, False, False, False]
    expected = drift_odometry(np.stack(truth[1:]), np.random.default_rng(0))
    assert np.abs(np.stack([s.T_odom_sensor for s in scans[1:]]) - expected).max() < 1e-12
    assert recording.track().stamps_ns.tolist() == [s.stamp_ns for s in scans[1:]]
    bare = bag(tmp_path / "b", [None] * 5, recorded)
    with pytest.raises(RecordingError, match="b has no ground truth to simulate odometry from"):
        list(SimulatedOdometry(open_recording(bare)))


def test_a_cloud_before_the_first_odometry_leaves_the_recorded_odometry(tmp_path: Path) -> None:
    recorded = [None, *walk(4, 0.5, 0.1)]
    recording = open_recording(bag(tmp_path / "a", list(walk(5, 1.0, 0.0)), recorded))
    assert recording.has_odometry
    found = [scan.T_odom_sensor for scan in recording]
    assert found[0] is None
    for T, expected in zip(found[1:], recorded[1:], strict=True):
        assert np.allclose(T, expected, atol=1e-12)


def test_a_dropout_of_ground_truth_yields_no_label(tmp_path: Path) -> None:
    """Clouds at 10 Hz, ground truth at 10 Hz but for a minute."""
    truth = walk(700, 0.1, 0.05)
    known = [T if k < 20 or k >= 620 else None for k, T in enumerate(truth)]
    found = list(open_recording(bag(tmp_path / "a", known, [None] * 700)))
    for scan, T in zip(found, known, strict=True):
        assert (scan.T_world_sensor is None) == (T is None)
