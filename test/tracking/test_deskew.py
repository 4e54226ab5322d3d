"""A stream of scans taken in motion: undone by odometry or the last registration, or told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from sweeps import PERIOD_NS, T0, TWIST, error_m, pose_at, swept

from cello3d_ros.clouds.motion import undistorted
from cello3d_ros.config import Config, NodeConfig
from cello3d_ros.covariance.model import constant_model
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.pose_track import PoseNotYetError, PoseTrack
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.tracking.guess import CONSTANT_VELOCITY, EXTERNAL, Locator, Place
from cello3d_ros.tracking.intake import Intake, Job
from cello3d_ros.tracking.odometry import PoseSource
from cello3d_ros.tracking.offline import replay
from cello3d_ros.tracking.tracker import Tracker

MODEL = constant_model(1e-4 * np.eye(6), 704)
N = 6


def tracker_of(**settings) -> Tracker:
    config = Config(node=NodeConfig(**{"pairing": "consecutive", **settings}))
    return Tracker(MODEL, config, config.node)


def answers(kind: str, swing: float, times: bool = True) -> tuple[list[float], str]:
    """Return the errors of the last steps of a stream, and what undid the motion.

    kind: who tells where the sensor is, and its motion: "odometry", "stamps" (odometry that does
    not tell the motion), "external" or "nobody".
    """
    at_s = np.arange(-0.2, 1.2, 0.01)
    track = PoseTrack.of_poses(T0 + np.round(1e9 * at_s).astype(np.int64), pose_at(at_s, swing))
    tracker, errors, told = tracker_of(), [], ""
    for k in range(10):
        scan = swept(k, swing=swing)
        place = Place(scan.T_odom_sensor)
        if kind == "odometry":
            place = replace(place, motion=track.motion(scan.stamp_ns, -0.1, 0.0))
        elif kind != "stamps":
            guess = EXTERNAL if kind == "external" else CONSTANT_VELOCITY
            place = Place(scan.T_odom_sensor if kind == "external" else None, guess=guess)
        answer = tracker.step(scan.stamp_ns, scan.points, place, scan.time_s if times else None)
        tracker.finish()
        if answer is not None:
            errors.append(error_m(answer.estimate.T_ref_read, k, swing))
            told = answer.deskewed
    return errors[1:], told


def test_odometry_undoes_a_motion_that_changes() -> None:
    undone, told = answers("odometry", 0.7)
    raw, not_told = answers("odometry", 0.7, times=False)
    assert (told, not_told) == ("by odometry", "no: the points carry no times")
    assert max(undone) < 0.01
    assert np.mean(raw) > 5.0 * np.mean(undone)


@pytest.mark.parametrize("kind", ["stamps", "nobody", "external"])
def test_without_odometry_the_last_registration_undoes_a_steady_motion(kind: str) -> None:
    """Reading and reference alike: else the error of the velocity would feed itself."""
    errors, told = answers(kind, 0.0)
    assert told == "by the last registration"
    assert max(errors) < 0.01


@pytest.mark.parametrize("pairing", ["consecutive", "keyframe"])
def test_the_first_scan_of_a_chain_is_undone_once_its_motion_is_known(pairing: str) -> None:
    tracker = tracker_of(pairing=pairing, keyframe_distance_ratio=0.2)
    for k in range(2):
        scan = swept(k)
        tracker.step(scan.stamp_ns, scan.points, Place(scan.T_odom_sensor), scan.time_s)
        tracker.finish()
    reference = tracker._pairing.next_reference
    scan = swept(0 if pairing == "keyframe" else 1)
    assert reference.stamp_ns == scan.stamp_ns
    straight = undistorted(scan.points, scan.time_s, Motion.constant(TWIST))
    distances = cKDTree(straight).query(reference.cloud.points)[0]
    assert np.quantile(distances, 0.9) < 0.02


def test_before_anything_tells_the_motion_a_cloud_is_used_as_it_is_and_that_is_told() -> None:
    tracker, first, second = tracker_of(), swept(0), swept(1)
    assert tracker.step(T0, first.points, Place(pose_at(0.0)), first.time_s) is None
    answer = tracker.step(second.stamp_ns, second.points, Place(pose_at(0.1)), second.time_s)
    assert answer.deskewed == "no: nothing tells the motion yet"
    plain = tracker_of()
    plain.step(T0, first.points, Place(pose_at(0.0)))
    same = plain.step(second.stamp_ns, second.points, Place(pose_at(0.1)))
    assert np.array_equal(same.step.T, answer.step.T)


def test_a_velocity_of_long_ago_undoes_nothing() -> None:
    tracker = tracker_of(pairing="keyframe", max_pair_gap_s=0.15)
    for k in (0, 1):
        scan = swept(k)
        tracker.step(scan.stamp_ns, scan.points, Place(pose_at(0.1 * k)), scan.time_s)
    scan = swept(2)
    late = tracker._deskewed(scan.stamp_ns + 10**9, scan.points, Place(None), scan.time_s)
    assert late[1] == "no: the last registration is too old to tell the motion"
    assert late[0] is scan.points


X = se3.exp([0.2, 0.0, 1.0, 0.0, 0.0, 0.5])


def locator(*stamps: int) -> Locator:
    """One that has heard odometry of a base whose lidar moves with TWIST."""
    source = PoseSource(PoseTrack(1.0, 100.0))
    for ns in stamps:
        source.hear(ns, pose_at(1e-9 * (ns - T0)) @ se3.inverse(X), "odom", "base_link", 50.0)
    numbers = tuple(float(x) for x in (*X[:3, 3], *se3.quaternion(X)))
    return Locator(NodeConfig(T_base_sensor=numbers), source)


def test_the_locator_tells_the_motion_of_the_sensor_during_the_sweep() -> None:
    where = locator(*(T0 + n * 20_000_000 for n in range(-8, 8)))
    time_s = np.linspace(-0.1, 0.05, 20)
    motion = where.place(T0, "lidar", False, (-0.1, 0.05)).motion
    np.testing.assert_allclose(motion.at(time_s), pose_at(time_s), atol=1e-6)
    assert where.place(T0, "lidar", False).motion is None


def test_a_cloud_waits_until_odometry_covers_its_last_point_but_not_for_ever() -> None:
    where = locator(T0 - PERIOD_NS, T0, T0 + 50_000_000)
    intake = Intake(where.place, 0.5)
    scan = swept(0, stamped=0.0)
    intake.offer(Job(scan.stamp_ns, scan.points, "lidar", 0.0, time_s=scan.time_s))
    assert intake.take() == (None, [])
    with pytest.raises(PoseNotYetError, match="older than the last point"):
        where.place(T0, "lidar", False, (0.0, 0.1))
    where.source.hear(T0 + PERIOD_NS, pose_at(0.1) @ se3.inverse(X), "odom", "base_link", 50.0)
    assert intake.take()[0].place.motion is not None
    late = locator(T0 - PERIOD_NS, T0, T0 + 50_000_000)
    intake = Intake(late.place, 0.5)
    intake.offer(Job(scan.stamp_ns, scan.points, "lidar", 0.0, time_s=scan.time_s))
    assert intake.expire(0.6) == []
    taken, skips = intake.take()
    assert (taken.place.motion, skips) == (None, [])
    np.testing.assert_allclose(taken.place.T_odom_sensor, np.eye(4), atol=1e-9)


def test_odometry_that_begins_within_the_sweep_does_not_tell_its_motion() -> None:
    where = locator(T0 - 50_000_000, T0, T0 + 50_000_000)
    assert where.place(T0, "lidar", False, (-0.1, 0.0)).motion is None


@pytest.mark.parametrize("stamped", [0.0, 1.0], ids=["start", "end"])
@pytest.mark.parametrize("odometry", [True, False])
def test_replay_undoes_the_motion_whatever_is_stamped(tmp_path, stamped, odometry) -> None:
    scans = [swept(k, stamped) for k in range(N)]
    if not odometry:
        scans = [replace(scan, T_odom_sensor=None) for scan in scans]
    write_bag(tmp_path / "bag", scans, double=True, odometry=4)
    told = {}
    for deskew in (True, False):
        config = NodeConfig(
            deskew=deskew, guess_without_odometry="skip" if odometry else "constant_velocity"
        )
        steps = list(replay(open_recording(tmp_path / "bag"), tracker_of(), config))
        assert [step.reason for step in steps] == ["reference", *[""] * (N - 1)]
        last = steps[-2].answer
        told[deskew] = last.deskewed, error_m(last.estimate.T_ref_read)
    expected = "by odometry" if odometry else "by the last registration"
    assert (told[True][0], told[False][0]) == (expected, "no: node.deskew is false")
    assert told[True][1] < 0.01


def test_the_answer_is_that_of_points_seen_at_the_stamp(tmp_path) -> None:
    """The motion is undone before all filters: the same bits as of straightened clouds."""
    motion = Motion.constant(TWIST)
    one, other = tracker_of(), tracker_of()
    for k in range(3):
        scan = swept(k)
        straight = undistorted(scan.points, scan.time_s, motion)
        place = Place(pose_at(0.1 * k), motion=motion)
        a = one.step(scan.stamp_ns, scan.points, place, scan.time_s)
        b = other.step(scan.stamp_ns, straight, Place(pose_at(0.1 * k)))
    assert np.array_equal(a.step.T, b.step.T)
    assert np.array_equal(a.step.Y, b.step.Y)
