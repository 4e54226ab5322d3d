"""Odometry buffer: interpolation, order, gaps."""

import math

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.ros.odometry import (
    OdometryBuffer,
    OdometryError,
    OdometryMissingError,
    OdometryNotYetError,
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
