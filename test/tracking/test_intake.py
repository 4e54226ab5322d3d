"""Order of clouds, waiting for odometry, newest wins."""

import numpy as np
import pytest

from cello3d_ros.config import NodeConfig
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.transforms import TransformTree
from cello3d_ros.tracking.guess import Locator
from cello3d_ros.tracking.intake import Intake, Job, Skip, stamp_order
from cello3d_ros.tracking.odometry import PoseSource

S = 1_000_000_000


def job(stamp_ns: int) -> Job:
    return Job(stamp_ns, np.empty((0, 3)), "lidar", received_s=0.0)


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


def test_the_newest_cloud_wins_and_the_older_is_counted() -> None:
    intake = intake_of(odometry(S, 2 * S, 3 * S))
    intake.offer(job(S))
    intake.offer(job(2 * S))
    taken, skips = intake.take()
    assert taken is not None
    assert taken.stamp_ns == 2 * S
    assert [(skip.stamp_ns, skip.reason) for skip in skips] == [(S, "superseded")]


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
    assert len(answered) >= 6
    assert answered == sorted(answered)


def test_never_more_than_two_wait_and_every_displaced_cloud_is_counted() -> None:
    intake = intake_of(odometry())
    skips = [skip for i in range(10) for skip in intake.offer(job(i * S))]
    assert len(intake) == 2
    assert [skip.stamp_ns // S for skip in skips] == list(range(1, 9))


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
