"""Odometry buffer: interpolation, order, gaps."""

import math
import re

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.tracking.odometry import (
    OdometryBuffer,
    OdometryError,
    OdometryMissingError,
    OdometryNotYetError,
    PoseSource,
    checked_pose,
)

S = 1_000_000_000


def buffer_of(*entries: tuple[int, np.ndarray], length_s: float = 10.0) -> OdometryBuffer:
    buffer = OdometryBuffer(length_s, gap_s=1.0)
    for stamp_ns, T in entries:
        buffer.add(stamp_ns, T)
    return buffer


def test_interpolation_is_slerp_in_rotation_and_a_line_in_translation() -> None:
    quarter = se3.pose([2.0, 0.0, 0.0], [0, 0, math.sin(math.pi / 4), math.cos(math.pi / 4)])
    T = buffer_of((S, np.eye(4)), (2 * S, quarter)).at(S + S // 4)
    np.testing.assert_allclose(T[:3, 3], [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(se3.log(T)[3:], [0.0, 0.0, math.pi / 8], atol=1e-12)


def test_a_pose_at_a_remembered_stamp_is_that_pose() -> None:
    T = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    buffer = buffer_of((S, np.eye(4)), (2 * S, T))
    np.testing.assert_array_equal(buffer.at(2 * S), T)
    np.testing.assert_array_equal(buffer.at(S), np.eye(4))


def test_changing_what_came_out_does_not_change_the_memory() -> None:
    buffer = buffer_of((S, np.eye(4)))
    buffer.at(S)[0, 3] = 7.0
    np.testing.assert_array_equal(buffer.at(S), np.eye(4))


def test_later_than_the_newest_is_not_yet_and_earlier_than_the_oldest_is_missing() -> None:
    buffer = buffer_of((2 * S, np.eye(4)), (3 * S, np.eye(4)))
    with pytest.raises(OdometryNotYetError, match=r"newest odometry is 0\.500 s older"):
        buffer.at(3 * S + S // 2)
    with pytest.raises(OdometryMissingError, match=r"oldest odometry is 1\.000 s newer"):
        buffer.at(S)
    with pytest.raises(OdometryNotYetError, match="no odometry has been received"):
        OdometryBuffer(10.0, 1.0).at(S)


def test_a_gap_is_not_bridged() -> None:
    buffer = buffer_of((S, np.eye(4)), (4 * S, np.eye(4)))
    with pytest.raises(OdometryMissingError, match=r"3\.000 s apart, more than 1\.0 s"):
        buffer.at(2 * S)


@pytest.mark.parametrize("late_ns", [0, 1, S // 2, 5 * S])
def test_a_stamp_that_is_not_later_is_rejected_and_changes_nothing(late_ns: int) -> None:
    buffer = buffer_of((9 * S, np.eye(4)))
    with pytest.raises(OdometryError, match="the stamp is"):
        buffer.add(9 * S - late_ns, se3.exp([1.0, 0, 0, 0, 0, 0]))
    assert len(buffer) == 1
    assert buffer.newest_ns == 9 * S


def test_clear_lets_time_start_again() -> None:
    buffer = buffer_of((9 * S, np.eye(4)))
    buffer.clear()
    assert buffer.newest_ns is None
    buffer.add(S, np.eye(4))
    assert buffer.newest_ns == S


def test_memory_is_bounded_in_seconds_and_in_number() -> None:
    many = [(i * S // 10, np.eye(4)) for i in range(1000)]
    assert len(buffer_of(*many, length_s=2.0)) == 21
    small = OdometryBuffer(1e6, 1.0, max_entries=7)
    for stamp_ns, T in many:
        small.add(stamp_ns, T)
    assert len(small) == 7
    assert small.newest_ns == many[-1][0]


@pytest.mark.parametrize(
    ("translation", "quaternion", "reason"),
    [
        ((0, 0, 0), (0, 0, 0, 0), "quaternion is zero"),
        ((0, 0, 0), (0, 0, 0, 2), "length 2"),
        ((math.nan, 0, 0), (0, 0, 0, 1), "not finite"),
        ((0, math.inf, 0), (0, 0, 0, 1), "not finite"),
        ((0, 0, 0), (0, math.nan, 0, 1), "not finite"),
    ],
)
def test_a_damaged_pose_is_rejected_by_name(translation, quaternion, reason) -> None:
    with pytest.raises(OdometryError, match=reason):
        checked_pose(translation, quaternion)


def test_a_rounded_quaternion_is_accepted_as_a_rotation() -> None:
    T = checked_pose((1, 2, 3), (0, 0, 0.7071, 0.7071))
    assert se3.is_rigid(T, 1e-12)
    np.testing.assert_allclose(T[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_pose_that_is_not_rigid_is_rejected() -> None:
    with pytest.raises(OdometryError, match="not rigid"):
        buffer_of((S, np.diag([2.0, 2.0, 2.0, 1.0])))


def source() -> PoseSource:
    """A source that has heard two poses a tenth of a second apart."""
    poses = PoseSource(OdometryBuffer(10.0, 1.0))
    assert poses.epoch == 0
    for k in range(2):
        sentence = poses.hear(S + k * S // 10, shifted(0.1 * k), "odom", "base_link", 20.0)
        assert sentence == ""
    assert poses.epoch == 1
    return poses


def shifted(x: float) -> np.ndarray:
    return se3.exp([x, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("x", "frame_id", "child_frame_id", "sentence"),
    [
        (10.1, "odom", "base_link", r"jumped: 100\.0 m/s, more than 20 m/s"),
        (0.2, "map", "base_link", "frame_id of the odometry changed from 'odom' to 'map'"),
        (0.2, "odom", "lidar", "child_frame_id of the odometry changed from 'base_link' to"),
    ],
)
def test_a_jump_or_a_change_of_frames_begins_an_epoch(x, frame_id, child_frame_id, sentence):
    poses = source()
    assert re.search(sentence, poses.hear(S + S // 5, shifted(x), frame_id, child_frame_id, 20.0))
    assert (poses.epoch, poses.frame_id, poses.child_frame_id) == (2, frame_id, child_frame_id)
    with pytest.raises(OdometryMissingError):  # nothing is interpolated across it
        poses.poses.at(S + 3 * S // 20)
    assert poses.hear(S + 3 * S // 10, shifted(x + 1.0), frame_id, child_frame_id, 20.0) == ""
    assert poses.epoch == 2


def test_fast_but_steady_odometry_has_not_jumped() -> None:
    poses = source()
    assert poses.hear(S + S // 5, shifted(2.0), "odom", "base_link", 20.0) == ""
    assert poses.hear(S + S // 5 + 1000, shifted(2.1), "odom", "base_link", 20.0) == ""
    assert poses.epoch == 1


def test_a_late_pose_of_another_frame_changes_nothing() -> None:
    poses = source()
    with pytest.raises(OdometryError):
        poses.hear(S, shifted(90.0), "map", "other", 20.0)
    assert (poses.epoch, poses.frame_id, len(poses.poses)) == (1, "odom", 2)
