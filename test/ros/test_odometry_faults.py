"""Odometry that jumps, stops and changes its frames: a warning, a new chain, right again."""

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.ros import messages

AWAY = se3.exp([10.0, 0.0, 0.0, 0.0, 0.0, 0.5])


def sent(robot, offset=None, frame_id="odom", child_frame_id="lidar", cloud_frame="lidar"):
    """Take a step and send its scan with odometry and frames that are not as before."""
    robot.step()
    T = robot.pose() if offset is None else offset @ robot.pose()
    message = messages.odometry_to(robot.stamp_ns, frame_id, child_frame_id, T)
    robot.player.odometry.publish(message)
    cloud = messages.cloud_to(robot.stamp_ns, cloud_frame, robot.points())
    return robot.send(cloud, odometry=False)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"offset": AWAY}, "the odometry jumped"),
        ({"frame_id": "map"}, "frame of the odometry changed from 'odom' to 'map'"),
        ({"child_frame_id": "imu"}, "child frame of the odometry changed from 'lidar' to 'imu'"),
        ({"cloud_frame": "other"}, "frame_id of the clouds changed from 'lidar' to 'other'"),
    ],
)
def test_the_chain_starts_again_where_frames_change_or_odometry_jumps(
    robot, node, change, sentence
) -> None:
    before = robot.walk()
    status = sent(robot, **change)
    assert status["last_event"] == "broken_chain"
    assert sentence in status["last_failure"]
    assert "the chain starts again here" in node.output()
    assert robot.stamp_ns not in robot.player.replay.relative
    status = sent(robot, **change)
    assert status["last_event"] == "answered"
    pose = robot.player.replay.poses[robot.stamp_ns]
    relative = robot.player.replay.relative[robot.stamp_ns]
    T_odom = change.get("offset", np.eye(4)) @ robot.pose()
    assert np.abs(se3.log(se3.inverse(T_odom) @ pose.T)).max() < 0.02
    np.testing.assert_allclose(np.trace(pose.C), np.trace(relative.C), rtol=1e-6)
    assert int(status["chain_restarts"]) == int(before["chain_restarts"]) + 1
    assert robot.walk()["last_event"] == "broken_chain"  # and back
    robot.assert_right_again()


def test_a_silence_of_5_s_is_not_bridged_but_survived(robot, node) -> None:
    before = robot.walk()
    for _ in range(3):
        robot.step(10**9)
        status = robot.send(robot.points(), odometry=False)
        assert status["last_event"] == "no_odometry"
    robot.step(2 * 10**9)
    assert robot.send(robot.points())["last_event"] == "answered"  # to the last one before
    status = robot.walk()
    assert status["last_event"] == "answered"
    assert status["chain_restarts"] == before["chain_restarts"]
    robot.assert_right_again()
