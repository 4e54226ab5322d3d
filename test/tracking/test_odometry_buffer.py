"""A stream of poses: breaks begin an epoch, late poses are refused."""

import re

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseMissingError, PoseTrack
from cello3d_ros.tracking.odometry import PoseSource

S = 1_000_000_000


def source() -> PoseSource:
    """A source that has heard two poses a tenth of a second apart."""
    poses = PoseSource(PoseTrack(1.0, 10.0, what="odometry"))
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
    with pytest.raises(PoseMissingError):  # nothing is interpolated across it
        poses.poses.pose(S + 3 * S // 20)
    assert poses.hear(S + 3 * S // 10, shifted(x + 1.0), frame_id, child_frame_id, 20.0) == ""
    assert poses.epoch == 2


def test_fast_but_steady_odometry_has_not_jumped() -> None:
    poses = source()
    assert poses.hear(S + S // 5, shifted(2.0), "odom", "base_link", 20.0) == ""
    assert poses.hear(S + S // 5 + 1000, shifted(2.1), "odom", "base_link", 20.0) == ""
    assert poses.epoch == 1


def test_a_late_pose_of_another_frame_changes_nothing() -> None:
    poses = source()
    with pytest.raises(PoseError):
        poses.hear(S, shifted(90.0), "map", "other", 20.0)
    assert (poses.epoch, poses.frame_id, len(poses.poses)) == (1, "odom", 2)


@pytest.mark.parametrize("late_ns", [0, 1, S // 2, 5 * S])
def test_a_stamp_that_is_not_later_is_rejected_and_changes_nothing(late_ns: int) -> None:
    poses = source()
    newest_ns = poses.poses.newest_ns
    with pytest.raises(PoseError, match="the stamp is"):
        poses.hear(newest_ns - late_ns, shifted(0.1), "odom", "base_link", 20.0)
    assert (len(poses.poses), poses.poses.newest_ns) == (2, newest_ns)


def test_a_pose_that_is_none_changes_nothing() -> None:
    poses = source()
    with pytest.raises(PoseError, match="not rigid"):
        poses.hear(S + S, np.diag([2.0, 2.0, 2.0, 1.0]), "odom", "base_link", 20.0)
    assert (poses.epoch, len(poses.poses)) == (1, 2)
