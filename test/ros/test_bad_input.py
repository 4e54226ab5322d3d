"""Bad clouds and bad odometry: a clear warning, no pose, and right again on the next good one."""

import re
import time

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.ros import messages

STEP_NS = 100_000_000


def assert_refused(robot, node, status, reason: str, sentence: str) -> None:
    """The cloud stamped now got no pose; diagnostics and the log say why; then all is well."""
    assert status["last_event"] == reason
    assert sentence in status["last_failure"]
    assert status["level"] != "0"
    assert robot.stamp_ns not in robot.player.replay.relative
    assert robot.stamp_ns not in robot.player.replay.poses
    assert without_numbers(sentence) in without_numbers(node.output())
    robot.assert_right_again()


def without_numbers(text: str) -> str:
    """Sentences that differ only in numbers are logged once a while."""
    return re.sub(r"[0-9.]+", "#", text)


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        (np.empty((0, 3)), "0 of 0 points are left"),
        (np.full((5000, 3), np.nan), "0 of 0 points are left"),
        (np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]), "3 of 3 points are left"),
        (np.full((5000, 3), 1e30), "0 of 5000 points are left"),
    ],
    ids=["empty", "all_nan", "three_points", "far_away"],
)
def test_cloud_with_too_few_points(robot, node, points, sentence) -> None:
    robot.step()
    assert_refused(robot, node, robot.send(points), "too_few_points", sentence)


def test_planar_cloud(robot, node) -> None:
    robot.step()
    plane = np.random.default_rng(0).uniform(-20, 20, (5000, 3)) * [1, 1, 0] - [0, 0, 1.5]
    status = robot.send(plane)
    assert status["last_event"] in ("registration", "no_overlap", "not_converged", "beyond_model")
    assert robot.stamp_ns not in robot.player.replay.relative
    assert without_numbers(status["last_failure"]) in without_numbers(node.output())
    robot.assert_right_again()


def test_a_million_points_are_answered(robot) -> None:
    robot.step()
    status = robot.send(robot.points(800_000), timeout_s=60.0)
    assert status["last_event"] == "answered"
    robot.assert_right_again()


def _short_data(message) -> None:
    message.data = message.data[:-7]


def _no_z(message) -> None:
    message.fields = message.fields[:2]


def _unknown_datatype(message) -> None:
    message.fields[1].datatype = 99


def _point_step_0(message) -> None:
    message.point_step = 0


def _absurd_point_step(message) -> None:
    message.point_step = 2**32 - 1


def _integers(message) -> None:
    message.fields[0].datatype = 5


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_short_data, "bytes but holds"),
        (_no_z, "no field 'z'"),
        (_unknown_datatype, "unknown datatype 99"),
        (_point_step_0, "beyond point_step 0"),
        (_absurd_point_step, ""),
        (_integers, "expected a float"),
    ],
)
def test_malformed_cloud(robot, node, damage, sentence) -> None:
    robot.step()
    message = messages.cloud_to(robot.stamp_ns, "lidar", robot.points())
    damage(message)
    assert_refused(robot, node, robot.send(message), "malformed", sentence)


def test_malformed_cloud_with_an_absurd_stamp_moves_no_clock(robot) -> None:
    robot.step()
    stamp_ns, robot.stamp_ns = robot.stamp_ns, 10**18 + 10**17
    message = messages.cloud_to(robot.stamp_ns, "lidar", robot.points())
    _short_data(message)
    status = robot.send(message, odometry=False)
    assert status["last_event"] == "malformed"
    robot.stamp_ns = stamp_ns
    robot.assert_right_again()


@pytest.mark.parametrize("step_back_ns", [0, 50_000_000], ids=["duplicate", "out_of_order"])
def test_cloud_that_is_not_later(robot, node, step_back_ns) -> None:
    here_ns = robot.stamp_ns
    before = dict(robot.player.replay.last_status)
    robot.stamp_ns -= step_back_ns
    robot.player.publish_cloud(robot.stamp_ns, robot.points())
    reason = "out_of_order" if step_back_ns else "duplicate_stamp"
    key = f"dropped.{reason}"
    status = _wait_for(robot, key, int(before.get(key, 0)) + 1)
    assert "not later than the cloud before" in status["last_failure"]
    robot.stamp_ns = here_ns
    robot.assert_right_again()


def test_cloud_from_the_future(robot, node) -> None:
    here_ns = robot.stamp_ns
    robot.stamp_ns = time.time_ns() + 3600 * 10**9
    status = robot.send(robot.points(), odometry=False)
    assert status["last_event"] == "future_stamp"
    assert "s in the future" in status["last_failure"]
    robot.stamp_ns = here_ns
    robot.assert_right_again()


def test_stamps_that_jump_back_start_anew(robot, node) -> None:
    before = robot.walk()
    robot.stamp_ns -= 100 * 10**9
    status = robot.walk()
    assert status["last_event"] == "reference"
    assert int(status["clock_jumps"]) == int(before["clock_jumps"]) + 1
    assert int(status["chain_restarts"]) == int(before["chain_restarts"]) + 1
    assert "time jumped back" in node.output()
    robot.assert_right_again()


def test_a_chain_restarts_after_three_failures_in_a_row(robot, node) -> None:
    before = robot.walk()
    for n_failures in (1, 2, 3):
        robot.step()
        status = robot.send(robot.points(size_m=40.0))
        assert status["last_event"] in ("no_overlap", "registration", "not_converged")
        assert status["level"] == ("2" if n_failures == 3 else "1")
    assert int(status["chain_restarts"]) == int(before["chain_restarts"]) + 1
    robot.step()
    status = robot.send(robot.points(size_m=40.0))  # against the third of them
    assert status["last_event"] == "answered"
    pose = robot.player.replay.poses[robot.stamp_ns]
    relative = robot.player.replay.relative[robot.stamp_ns]
    np.testing.assert_allclose(np.trace(pose.C), np.trace(relative.C), rtol=1e-6)
    for _ in range(3):  # and back home
        assert robot.walk()["last_event"] != "answered"
    robot.assert_right_again()


def test_one_or_two_failures_do_not_break_the_chain(robot) -> None:
    before = robot.walk()
    trace = np.trace(robot.player.replay.poses[robot.stamp_ns].C)
    robot.step()
    robot.send(np.empty((0, 3)))
    robot.step()
    robot.send(robot.points(size_m=40.0))
    robot.assert_right_again()
    status = robot.player.replay.status[robot.stamp_ns]
    assert status["chain_restarts"] == before["chain_restarts"]
    assert np.trace(robot.player.replay.poses[robot.stamp_ns].C) > trace


def test_scans_far_apart_in_time_are_not_paired(robot, node) -> None:
    robot.step(20 * 10**9)
    status = robot.send(robot.points())
    assert_refused(robot, node, status, "too_far_apart", "20.0 s after the one before it")


def _wait_for(robot, key: str, value: int) -> dict[str, str]:
    """Wait until diagnostics count up to ``value``."""
    replay = robot.player.replay
    assert robot.player.spin_until(lambda: int(replay.last_status.get(key, 0)) >= value, 5.0), (
        f"{key} is {replay.last_status.get(key)}, expected {value}"
    )
    return replay.last_status


def _nan_position(message) -> None:
    message.pose.pose.position.x = float("nan")


def _nan_rotation(message) -> None:
    message.pose.pose.orientation.y = float("nan")


def _zero_quaternion(message) -> None:
    message.pose.pose.orientation.z = message.pose.pose.orientation.w = 0.0


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_nan_position, "the pose is not finite"),
        (_nan_rotation, "the pose is not finite"),
        (_zero_quaternion, "the quaternion is zero"),
    ],
)
def test_damaged_odometry_is_as_good_as_none(robot, node, damage, sentence) -> None:
    n_rejected = int(robot.player.replay.last_status["odometry_rejected"])
    robot.step()
    message = messages.odometry_to(robot.stamp_ns, "odom", "lidar", np.eye(4))
    damage(message)
    robot.player.odometry.publish(message)
    status = robot.send(robot.points(), odometry=False)
    assert int(status["odometry_rejected"]) == n_rejected + 1
    assert f"odometry message rejected: {sentence}" in node.output()
    assert_refused(robot, node, status, "no_odometry", "the newest odometry is 0.100 s older")


def test_odometry_that_comes_after_the_cloud_is_waited_for(robot) -> None:
    robot.step()
    robot.player.publish_cloud(robot.stamp_ns, robot.points())
    robot.player.spin_for(0.1)
    robot.player.publish_odometry(robot.stamp_ns, robot.pose())
    assert robot.settled()["last_event"] == "answered"
    robot.assert_right_again()


def test_odometry_is_interpolated_at_the_stamp_of_the_cloud(robot) -> None:
    robot.step()
    early, late = robot.pose() @ se3.exp([0.1, 0, 0, 0, 0, 0.2]), robot.pose()
    late = late @ se3.exp([-0.1, 0, 0, 0, 0, -0.2])
    robot.player.publish_cloud(robot.stamp_ns, robot.points())
    robot.player.publish_odometry(robot.stamp_ns - 10_000_000, early)
    robot.player.publish_odometry(robot.stamp_ns + 10_000_000, late)
    assert robot.settled()["last_event"] == "answered"
    robot.assert_right_again()


def test_missing_odometry(robot, node) -> None:
    robot.step()
    status = robot.send(robot.points(), odometry=False)
    assert_refused(robot, node, status, "no_odometry", "no odometry at the stamp of the cloud")


def test_a_gap_in_the_odometry_is_not_bridged(robot, node) -> None:
    robot.step(2 * 10**9)
    robot.player.publish_odometry(robot.stamp_ns + 2 * 10**9, robot.pose())
    status = robot.send(robot.points(), odometry=False)
    assert status["last_event"] == "no_odometry"
    assert "4.000 s apart, more than 1.0 s" in status["last_failure"]
    robot.stamp_ns += 2 * 10**9
    robot.walk(2)
    robot.assert_right_again()


@pytest.mark.parametrize("back_ns", [0, 500_000_000])
def test_odometry_that_goes_back_a_little_is_rejected(robot, node, back_ns) -> None:
    n_rejected = int(robot.player.replay.last_status["odometry_rejected"])
    far = se3.exp([30.0, 0, 0, 0, 0, 0])
    robot.player.publish_odometry(robot.stamp_ns - back_ns, far)
    robot.assert_right_again()
    _wait_for(robot, "odometry_rejected", n_rejected + 1)
    assert "odometry message rejected: the stamp is" in node.output()


def test_odometry_from_the_future_is_rejected(robot) -> None:
    n_rejected = int(robot.player.replay.last_status["odometry_rejected"])
    robot.player.publish_odometry(time.time_ns() + 3600 * 10**9, np.eye(4))
    robot.assert_right_again()
    _wait_for(robot, "odometry_rejected", n_rejected + 1)
