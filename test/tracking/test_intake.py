"""Order of clouds, waiting for odometry, overload."""

import numpy as np
import pytest

from cello3d_ros.config import NodeConfig
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.transforms import TransformTree
from cello3d_ros.tracking.guess import Locator
from cello3d_ros.tracking.intake import Intake, Job, Skip, stamp_order
from cello3d_ros.tracking.odometry import PoseSource

S = 1_000_000_000


NOTHING = np.empty((0, 3))


def job(stamp_ns: int, points: np.ndarray = NOTHING, received_s: float = 0.0) -> Job:
    return Job(stamp_ns, points, "lidar", received_s)


def odometry(*stamps: int) -> PoseTrack:
    buffer = PoseTrack(1.0, 100.0)
    for stamp_ns in stamps:
        buffer.add(stamp_ns, np.eye(4))
    return buffer


def intake_of(buffer: PoseTrack, timeout_s: float = 0.5, **settings) -> Intake:
    """An intake whose clouds are placed by odometry as the settings have it."""
    source = PoseSource(buffer)
    return Intake(Locator(NodeConfig(**settings), source).place, timeout_s)


@pytest.mark.parametrize(
    ("stamp_ns", "expected"),
    [
        (9 * S + 1, "later"),
        (9 * S, "duplicate_stamp"),
        (9 * S - 1, "out_of_order"),
        (8 * S, "out_of_order"),
        (8 * S - 1, "jump"),
    ],
)
def test_order_of_stamps(stamp_ns: int, expected: str) -> None:
    assert stamp_order(stamp_ns, 9 * S) == expected
    assert stamp_order(stamp_ns, None) == "later"


def test_a_cloud_waits_for_its_odometry_and_then_comes_out_with_it() -> None:
    buffer = odometry(S)
    intake = intake_of(buffer)
    assert intake.offer(job(S + S // 2)) == []
    assert intake.take() == (None, [])
    buffer.add(2 * S, np.eye(4))
    taken, skips = intake.take()
    assert taken is not None
    assert taken.stamp_ns == S + S // 2
    np.testing.assert_array_equal(taken.place.T_odom_sensor, np.eye(4))
    assert (skips, len(intake)) == ([], 0)


def test_clouds_are_taken_in_order_while_the_work_is_fast() -> None:
    intake = intake_of(odometry(S, 2 * S, 3 * S))
    for k in (1, 2, 3):
        intake.offer(job(k * S, received_s=0.1 * k))
        intake.note_work(0.02)
    taken = [intake.take() for _ in range(3)]
    assert [(job.stamp_ns // S, skips) for job, skips in taken] == [(1, []), (2, []), (3, [])]


def overloaded(n_clouds: int) -> Intake:
    """An intake with some clouds that are ready, and work that takes three times too long."""
    intake = intake_of(odometry(*(k * S for k in range(1, 7))))
    for k in range(1, n_clouds + 1):
        intake.offer(job(k * S, received_s=0.1 * k))
    for _ in range(3):
        intake.note_work(0.3)
    return intake


def test_under_overload_the_newest_cloud_wins_and_the_older_are_counted() -> None:
    taken, skips = overloaded(3).take()
    assert taken is not None
    assert taken.stamp_ns == 3 * S
    assert [(skip.stamp_ns // S, skip.reason) for skip in skips] == [
        *((k, "superseded") for k in (1, 2))
    ]


def test_two_that_are_ready_are_both_worked_on_even_under_overload() -> None:
    intake = overloaded(2)
    assert intake.is_overloaded
    assert [intake.take()[0].stamp_ns // S for _ in range(2)] == [1, 2]


def test_clouds_that_were_never_heard_count_for_the_load() -> None:
    intake = intake_of(odometry(S, 2 * S, 3 * S))
    for k in (1, 2):
        intake.offer(job(k * S, received_s=0.5 * k), n_unheard=4)
    for _ in range(3):
        intake.note_work(0.3)
    assert intake.is_overloaded  # two heard in half a second, but ten came


def test_one_long_piece_of_work_is_no_overload() -> None:
    intake = intake_of(odometry(S, 2 * S, 3 * S))
    intake.note_work(0.02)
    for k in (1, 2):
        intake.offer(job(k * S, received_s=0.1 * k))
    intake.note_work(5.0)
    intake.note_work(0.02)
    assert not intake.is_overloaded
    assert intake.take()[0].stamp_ns == S


@pytest.mark.parametrize(
    ("lidar_hz", "odometry_hz", "late_s"),
    [
        (10, 5, 0.0),
        (20, 10, 0.0),
        (20, 50, 0.15),
        (10, 20, 0.3),
        (20, 2, 0.0),
        (10, 10, 0.45),
    ],
)
def test_all_are_answered_whatever_the_rate_and_delay_of_odometry(
    lidar_hz, odometry_hz, late_s
) -> None:
    """In the order of events, as a node with work of 20 ms hears them."""
    buffer = odometry()
    intake, answered = intake_of(buffer), []
    clouds = [(k / lidar_hz, "cloud", k * S // lidar_hz) for k in range(4 * lidar_hz)]
    poses = [
        (k / odometry_hz + late_s, "pose", k * S // odometry_hz)
        for k in range(4 * odometry_hz + 2)
    ]
    for at_s, kind, stamp_ns in sorted(clouds + poses):
        if kind == "pose":
            buffer.add(stamp_ns, np.eye(4))
        else:
            assert intake.offer(job(stamp_ns, received_s=at_s)) == []
        while (found := intake.take())[0] is not None:
            answered.append(found[0].stamp_ns)
            assert found[1] == []
            intake.note_work(0.02)
    assert answered == [stamp_ns for _, _, stamp_ns in clouds]


def test_a_newer_cloud_without_odometry_does_not_hold_up_the_older() -> None:
    intake = intake_of(odometry(S))
    intake.offer(job(S))
    intake.offer(job(2 * S))
    taken, skips = intake.take()
    assert taken is not None
    assert taken.stamp_ns == S
    assert (skips, len(intake)) == ([], 1)


def test_odometry_late_by_many_periods_starves_nobody() -> None:
    buffer = odometry(0)
    intake = intake_of(buffer)
    answered = []
    for i in range(1, 40):  # ten clouds a second, odometry half a second late
        intake.offer(job(i * S // 10))
        if i > 5:
            buffer.add((i - 5) * S // 10, np.eye(4))
        taken, _ = intake.take()
        if taken is not None:
            answered.append(taken.stamp_ns)
    assert len(answered) == 34
    assert answered == sorted(answered)


def test_a_bounded_number_waits_and_every_displaced_cloud_is_counted() -> None:
    intake = intake_of(odometry())
    skips = [skip for i in range(100) for skip in intake.offer(job(i * S))]
    assert len(intake) == 64
    assert [skip.stamp_ns // S for skip in skips] == list(range(63, 99))
    assert {skip.reason for skip in skips} == {"superseded"}
    assert "64 clouds wait for odometry" in skips[0].sentence


def test_a_bounded_number_of_points_waits() -> None:
    intake = intake_of(odometry())
    many = np.broadcast_to(np.zeros(3), (3_000_000, 3))
    skips = [skip for i in range(5) for skip in intake.offer(job(i * S, many))]
    assert len(intake) == 2
    assert [skip.stamp_ns // S for skip in skips] == [1, 2, 3]


def test_a_cloud_older_than_all_odometry_is_skipped_at_once() -> None:
    intake = intake_of(odometry(5 * S))
    intake.offer(job(S))
    taken, skips = intake.take()
    assert taken is None
    assert len(intake) == 0
    assert skips[0].reason == "no_odometry"
    assert "4.000 s newer" in skips[0].sentence


def test_a_cloud_expires_after_the_timeout_of_listening() -> None:
    intake = intake_of(odometry(S))
    intake.offer(job(2 * S))
    assert intake.expire(0.25) == []
    skips = intake.expire(0.25)
    assert [skip.reason for skip in skips] == ["no_odometry"]
    assert "1.000 s older" in skips[0].sentence
    assert len(intake) == 0


def test_a_cloud_whose_odometry_has_come_does_not_expire() -> None:
    intake = intake_of(odometry(S))
    intake.offer(job(S))
    assert intake.expire(10.0) == []
    assert intake.take()[0] is not None


def test_clear_names_what_it_forgot() -> None:
    intake = intake_of(odometry())
    intake.offer(job(S))
    assert intake.clear("clock_jump", "time jumped") == [Skip(S, "clock_jump", "time jumped")]
    assert len(intake) == 0


def test_a_cloud_that_can_do_without_odometry_is_taken_when_it_has_waited() -> None:
    intake = intake_of(odometry(S), guess_without_odometry="constant_velocity")
    intake.offer(job(2 * S))
    assert intake.take() == (None, [])
    assert intake.expire(0.25) == []
    assert intake.take() == (None, [])
    assert intake.expire(0.25) == []
    taken, _ = intake.take()
    assert taken is not None
    assert taken.place.guess == "constant_velocity"


def test_a_missing_external_pose_and_an_unknown_frame_are_counted_apart() -> None:
    poses = PoseTrack(1.0, 100.0, what="external pose")
    where = Locator(NodeConfig(registration="external"), PoseSource(poses))
    intake = Intake(where.place, 0.5, "external pose")
    intake.offer(job(S))
    (skip,) = intake.expire(0.5)
    assert (skip.reason, skip.sentence) == (
        "no_external_pose",
        "no external pose at the stamp of the cloud: no external pose has been received",
    )
    poses.add(S, np.eye(4))
    where.transforms = TransformTree(1.0, 10.0)
    intake.offer(job(S))
    (skip,) = intake.expire(0.5)
    assert skip.reason == "unknown_frame"


def test_the_newest_is_ready_when_it_has_its_odometry_or_never_will() -> None:
    buffer = odometry(5 * S)
    intake = intake_of(buffer)
    assert intake.newest_is_ready()  # nothing to wait for
    intake.offer(job(4 * S))
    assert intake.newest_is_ready()  # older than all odometry
    intake.offer(job(6 * S))
    assert not intake.newest_is_ready()
    buffer.add(6 * S, np.eye(4))
    assert intake.newest_is_ready()
