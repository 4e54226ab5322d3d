"""The node as its own process over DDS: right answers."""

import itertools

import numpy as np
import pytest
from room_walks import InMemory, walk_in_a_room

from cello3d_ros.geometry import se3
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.ros import messages, replay


@pytest.fixture(scope="module")
def recording() -> InMemory:
    """Ten scans of a room, with odometry that is a little wrong."""
    start = se3.exp([5.0, 1.0, 0.0, 0.0, 0.0, 2.0])

    def odometry(T, i):
        return start @ T @ se3.exp(np.array([0.004, -0.003, 0, 0, 0, 0.002]) * i)

    return walk_in_a_room(10, 0.2, odometry)


@pytest.fixture(scope="module")
def played(player, recording):
    """The recording, played once."""
    return replay.play(player, recording)


def test_every_pair_is_answered_once_and_at_its_stamp(played, recording) -> None:
    stamps = [scan.stamp_ns for scan in recording]
    assert list(played.relative) == stamps[1:]
    assert list(played.poses) == stamps[1:]
    assert played.status[stamps[0]]["last_event"] == "reference"
    assert played.last_status["dropped"] == "0"
    assert played.last_status["level"] == "0"
    assert all(latency > 0 for latency in played.latencies_ms())


def test_relative_poses_are_those_of_the_readings_in_their_references(played, recording) -> None:
    for before, scan in itertools.pairwise(recording):
        T_true = se3.inverse(before.T_world_sensor) @ scan.T_world_sensor
        T_hat = played.relative[scan.stamp_ns].T
        assert np.abs(se3.log(se3.inverse(T_true) @ T_hat)).max() < 0.01
        assert played.status[scan.stamp_ns]["reference_stamp_ns"] == str(before.stamp_ns)


def test_poses_chain_the_relative_poses_from_the_first_odometry(played, recording) -> None:
    T = recording[0].T_odom_sensor
    for scan in recording[1:]:
        T = T @ played.relative[scan.stamp_ns].T
        np.testing.assert_allclose(played.poses[scan.stamp_ns].T, T, atol=1e-9)


def test_relative_covariance_is_the_models_turned_into_the_reference(
    played, recording, constant_Y
) -> None:
    for pose in played.relative.values():
        Y = messages.reading_covariance(pose.C, pose.T[:3, :3])
        np.testing.assert_allclose(Y, constant_Y, atol=1e-12)


def test_first_pose_has_the_covariance_of_one_registration_and_it_grows(
    played, recording, constant_Y
) -> None:
    poses = list(played.poses.values())
    Y = messages.reading_covariance(poses[0].C, poses[0].T[:3, :3])
    np.testing.assert_allclose(Y, constant_Y, atol=1e-9)
    traces = [np.trace(pose.C) for pose in poses]
    assert (np.diff(traces) > 0).all()


def test_headers_name_the_frames(played) -> None:
    from rclpy.serialization import deserialize_message

    frames = {}
    for topic, _, _, raw in played.raw:
        if topic.endswith("pose"):
            message = deserialize_message(raw, messages.PoseWithCovarianceStamped)
            frames[topic] = message.header.frame_id
    assert frames == {"/covariance_node/relative_pose": "lidar", "/covariance_node/pose": "odom"}


def test_diagnostics_hold_the_evidence(played) -> None:
    status = played.last_status
    for key in (
        *("overlap_ratio", "residual_rms_m", "iterations", "nearest_rho", "effective_neighbors"),
        *("weakest_eigenvalue", "weakest_direction", "chain_restarts", "model"),
        *("latency_ms.p50", "latency_ms.p95", "age_ms.p50", "age_ms.p95", "received", "answered"),
    ):
        assert key in status
    assert 0.5 < float(status["overlap_ratio"]) <= 1.0
    assert status["model"] == "constant.npz"


def test_clouds_played_at_a_rate_are_answered_too(player, recording) -> None:
    later = InMemory(
        Scan(
            stamp_ns=scan.stamp_ns + 10**10,
            points=scan.points,
            T_world_sensor=scan.T_world_sensor,
            T_odom_sensor=scan.T_odom_sensor,
        )
        for scan in recording[:4]
    )
    played = replay.play(player, later, rate_hz=2.0)
    assert played.is_settled(later[-1].stamp_ns)
    assert played.status[later[-1].stamp_ns]["last_event"] == "answered"
