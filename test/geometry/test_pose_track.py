"""Poses over time: interpolation, order, gaps."""

import math
from types import SimpleNamespace as Message

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import (
    PoseError,
    PoseMissingError,
    PoseNotYetError,
    PoseTrack,
    checked_pose,
)

S = 1_000_000_000


def parts(position, rotation) -> tuple[Message, Message]:
    """A position and a quaternion as messages have them."""
    return Message(**dict(zip("xyz", position))), Message(**dict(zip("xyzw", rotation)))


def buffer_of(*entries: tuple[int, np.ndarray], length_s: float = 10.0) -> PoseTrack:
    buffer = PoseTrack(1.0, length_s, what="odometry")
    for stamp_ns, T in entries:
        buffer.add(stamp_ns, T)
    return buffer


def test_interpolation_is_slerp_in_rotation_and_a_line_in_translation() -> None:
    quarter = se3.pose([2.0, 0.0, 0.0], [0, 0, math.sin(math.pi / 4), math.cos(math.pi / 4)])
    T = buffer_of((S, np.eye(4)), (2 * S, quarter)).pose(S + S // 4)
    np.testing.assert_allclose(T[:3, 3], [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(se3.log(T)[3:], [0.0, 0.0, math.pi / 8], atol=1e-12)


def test_a_pose_at_a_remembered_stamp_is_that_pose() -> None:
    T = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    buffer = buffer_of((S, np.eye(4)), (2 * S, T))
    np.testing.assert_array_equal(buffer.pose(2 * S), T)
    np.testing.assert_array_equal(buffer.pose(S), np.eye(4))


def test_changing_what_came_out_does_not_change_the_memory() -> None:
    buffer = buffer_of((S, np.eye(4)))
    buffer.pose(S)[0, 3] = 7.0
    np.testing.assert_array_equal(buffer.pose(S), np.eye(4))


def test_later_than_the_newest_is_not_yet_and_earlier_than_the_oldest_is_missing() -> None:
    buffer = buffer_of((2 * S, np.eye(4)), (3 * S, np.eye(4)))
    with pytest.raises(PoseNotYetError, match=r"newest odometry is 0\.500 s older"):
        buffer.pose(3 * S + S // 2)
    with pytest.raises(PoseMissingError, match=r"oldest odometry is 1\.000 s newer"):
        buffer.pose(S)
    with pytest.raises(PoseNotYetError, match="no odometry has been received"):
        PoseTrack(what="odometry").pose(S)


def test_a_gap_is_not_bridged() -> None:
    buffer = buffer_of((S, np.eye(4)), (4 * S, np.eye(4)))
    with pytest.raises(PoseMissingError, match=r"3\.000 s apart, more than 1\.0 s"):
        buffer.pose(2 * S)


def test_poses_may_come_in_any_order() -> None:
    T = [se3.exp([float(k), 0, 0, 0, 0, 0.1 * k]) for k in range(5)]
    in_order = buffer_of(*((k * S, T[k]) for k in range(5)))
    mixed = buffer_of(*((k * S, T[k]) for k in (3, 0, 4, 1, 2)))
    for (a_ns, a), (b_ns, b) in zip(in_order, mixed, strict=True):
        assert a_ns == b_ns
        np.testing.assert_array_equal(a, b)


def test_a_pose_older_than_what_is_remembered_is_refused() -> None:
    buffer = buffer_of((20 * S, np.eye(4)))
    with pytest.raises(PoseError, match=r"11\.000 s older"):
        buffer.add(9 * S, np.eye(4))
    assert len(buffer) == 1


def test_of_two_poses_of_one_stamp_the_last_counts() -> None:
    T = se3.exp([1.0, 0, 0, 0, 0, 0.2])
    buffer = buffer_of((S, np.eye(4)), (2 * S, np.eye(4)), (S, T))
    assert len(buffer) == 2
    np.testing.assert_array_equal(buffer.pose(S), T)


def test_clear_lets_time_start_again() -> None:
    buffer = buffer_of((9 * S, np.eye(4)))
    buffer.clear()
    assert buffer.newest_ns is None
    buffer.add(S, np.eye(4))
    assert buffer.newest_ns == S


def test_memory_is_bounded_in_seconds_and_in_number() -> None:
    many = [(i * S // 10, np.eye(4)) for i in range(1000)]
    assert len(buffer_of(*many, length_s=2.0)) == 21
    small = PoseTrack(1.0, 1e6, max_poses=7)
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
    with pytest.raises(PoseError, match=reason):
        checked_pose(*parts(translation, quaternion))


def test_a_rounded_quaternion_is_accepted_as_a_rotation() -> None:
    T = checked_pose(*parts((1, 2, 3), (0, 0, 0.7071, 0.7071)))
    assert se3.is_rigid(T, 1e-12)
    np.testing.assert_allclose(T[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_pose_that_is_not_rigid_is_rejected() -> None:
    with pytest.raises(PoseError, match="not rigid"):
        buffer_of((S, np.diag([2.0, 2.0, 2.0, 1.0])))


ROWS = [[0, 0, 0, 0, 0, 0, 1], [2, 0, 0, 0, 0, np.sin(0.5), np.cos(0.5)]]


def test_a_track_is_interpolated_between_its_poses() -> None:
    track = PoseTrack.of_rows([100, 200], ROWS)
    T = track.at(125)
    assert np.allclose(T[:3, 3], [0.5, 0, 0])
    assert np.allclose(se3.log(T)[3:], [0, 0, 0.25])


def test_a_track_says_nothing_outside_its_span() -> None:
    track = PoseTrack.of_rows([100, 200], ROWS)
    assert track.at(99) is None
    assert track.at(201) is None
    assert np.allclose(track.at(100), np.eye(4))
    assert np.allclose(track.at(200)[:3, 3], [2, 0, 0])
    assert PoseTrack.of_rows([], []).at(0) is None


def test_large_stamps_keep_their_nanoseconds() -> None:
    start = 1_600_000_000_000_000_001
    track = PoseTrack.of_rows([start, start + 4], ROWS)
    assert np.allclose(track.at(start + 1)[:3, 3], [0.5, 0, 0], atol=1e-12)


def test_a_track_sorts_its_poses_and_keeps_the_last_of_one_stamp() -> None:
    track = PoseTrack.of_rows([200, 100, 200], [ROWS[0], ROWS[0], ROWS[1]])
    assert [stamp for stamp, _ in track] == [100, 200]
    assert np.allclose(track.at(200)[:3, 3], [2, 0, 0])


@pytest.mark.parametrize("bad", [[np.nan, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 0]])
def test_a_pose_with_nan_or_a_zero_quaternion_is_named(bad: list[float]) -> None:
    with pytest.raises(PoseError, match="pose 1 "):
        PoseTrack.of_rows([100, 200], [ROWS[0], bad])


def test_no_pose_is_made_up_in_a_gap_of_a_minute() -> None:
    """A lost tracker: its poses pause for 60 s while the clouds go on."""
    stamps = [*range(0, 5 * S, S // 10), *range(65 * S, 70 * S, S // 10)]
    T = se3.exp(np.outer(np.array(stamps) / S, [0.5, 0, 0, 0, 0, 0.1]))
    track = PoseTrack.of_poses(stamps, T)
    answered = [t for t in range(0, 69 * S, S // 20) if track.at(t) is not None]
    assert max(t for t in answered if t < 60 * S) == stamps[49]
    assert min(t for t in answered if t > 5 * S) == 65 * S
    assert track.covers(S, 4 * S)
    assert track.covers(S, S)
    assert not track.covers(4 * S, 66 * S)
    assert not track.covers(10 * S, 10 * S)
    assert not track.covers(0, 80 * S)


def test_motion_is_on_the_geodesics_between_the_poses() -> None:
    xi = np.array([2.0, 0.3, 0.0, 0.0, 0.2, 1.5])
    track = PoseTrack.of_poses([0, S, 2 * S, 3 * S], se3.exp(np.arange(4)[:, None] * xi))
    after_s = np.array([-0.4, 0.0, 0.1, 0.8, 1.7])
    motion = track.motion(S // 2, after_s[0], after_s[-1])
    np.testing.assert_allclose(motion.at(after_s), se3.exp(after_s[:, None] * xi), atol=1e-12)


def test_a_track_of_equal_poses_is_constant() -> None:
    T = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    assert buffer_of((0, T), (S, T)).is_constant()
    assert not buffer_of((0, T), (S, T @ se3.exp([1e-3, 0, 0, 0, 0, 0]))).is_constant()
    assert not PoseTrack().is_constant()
