"""Every covariance mode on the node's own process: what its consumers would say."""

import dataclasses
import math

import numpy as np
import pytest
from consumer_rules import of_pose, of_twist
from node_plays import played
from robot import ellipsoid_of
from room_walks import InMemory, walk_in_a_room

from cello3d_ros.config import NodeConfig
from cello3d_ros.covariance.lost import Lost
from cello3d_ros.covariance.model import load_model, save_model, shipped_model_path
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import to_fixed_axes
from cello3d_ros.ros.process import NodeProcess

MODES = NodeConfig.__dataclass_fields__["covariance_mode"].metadata["choices"]
STEP_S = 0.2


@pytest.fixture(scope="module")
def recording() -> InMemory:
    return walk_in_a_room(4, STEP_S)


@pytest.fixture(scope="module")
def by_mode(tmp_path_factory, domain_id, recording):
    """What the node says in each mode."""
    return {
        mode: played(
            *(tmp_path_factory.mktemp(mode), domain_id, recording),
            covariance_mode=mode,
            inflate_unknown="false",
        )
        for mode in MODES
    }


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_answers_what_fuse_and_robot_localization_take(
    by_mode, recording, mode
) -> None:
    found = by_mode[mode]
    stamps = [scan.stamp_ns for scan in recording][1:]
    assert list(found.odometry) == list(found.relative) == list(found.poses) == stamps
    assert found.last_status["covariance_mode"] == mode
    for message in found.odometry.values():
        assert not of_pose(message)
        assert not of_twist(message)
    floors = np.repeat([1e-4, 1e-4], 3) ** 2
    for pose in found.relative.values():
        assert np.linalg.eigvalsh(pose.C - np.diag(floors))[0] > -1e-15
        assert np.linalg.eigvalsh(pose.C)[-1] <= 900.0


def test_modes_are_not_each_other(by_mode, recording) -> None:
    stamp_ns = recording[-1].stamp_ns
    traces = [np.trace(by_mode[mode].relative[stamp_ns].C) for mode in MODES]
    assert len({f"{trace:.6e}" for trace in traces}) == len(MODES)


@pytest.mark.parametrize("mode", ["cello3d", "hessian"])
def test_odometry_is_the_chain_and_the_velocity_since_the_answer_before(by_mode, mode) -> None:
    """The scans have one keyframe; its first registration is the first motion as well."""
    found, T_before = by_mode[mode], np.eye(4)
    for k, (stamp_ns, message) in enumerate(found.odometry.items()):
        pose, step = found.poses[stamp_ns], found.relative[stamp_ns]
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "lidar")
        np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), pose.C)
        u, w = message.twist.twist.linear, message.twist.twist.angular
        twist = np.array([u.x, u.y, u.z, w.x, w.y, w.z])
        np.testing.assert_allclose(T_before @ se3.exp(twist * STEP_S), pose.T, atol=1e-9)
        T_before = pose.T
        Y = to_fixed_axes(step.T[:3, :3].T, step.C)
        C = message.twist.covariance.reshape(6, 6)
        if k == 0:
            np.testing.assert_allclose(C * STEP_S**2, Y, rtol=1e-6, atol=1e-12)
        else:  # two registrations, less what they share
            assert 0.1 < np.trace(C) * STEP_S**2 / np.trace(Y) < 3.0


def test_markers_show_what_is_published(by_mode) -> None:
    found = by_mode["cello3d"]
    assert found.markers
    for stamp_ns, array in found.markers.items():
        pose, step = found.poses[stamp_ns], found.relative[stamp_ns]
        named = {marker.ns: marker for marker in array.markers}
        assert set(named) == {"translation", "rotation", "weakest", "chain"}
        assert {marker.header.frame_id for marker in array.markers} == {"odom"}
        centre, A = ellipsoid_of(named["chain"])
        np.testing.assert_allclose(centre, pose.T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(A @ A.T, 9.0 * pose.C[:3, :3], rtol=1e-6, atol=1e-10)
        R = pose.T[:3, :3] @ step.T[:3, :3].T  # from the frame of the reference to odom
        _, A = ellipsoid_of(named["translation"])
        np.testing.assert_allclose(A @ A.T, 9.0 * R @ step.C[:3, :3] @ R.T, rtol=1e-6, atol=1e-10)


def test_scale_floor_and_ceiling_hold_at_once(tmp_path, domain_id, recording, by_mode) -> None:
    found = played(
        *(tmp_path, domain_id, recording),
        covariance_mode="hessian",
        scale=1e6,
        floor_sigma_m=0.02,
        floor_sigma_rad=0.01,
        ceiling=0.03,
    )
    for stamp_ns, pose in found.relative.items():
        values = np.linalg.eigvalsh(pose.C)
        assert values[-1] <= 0.03
        assert np.linalg.eigvalsh(pose.C - np.diag([4e-4] * 3 + [1e-4] * 3))[0] > -1e-15
        assert np.trace(pose.C) > 2.0 * np.trace(by_mode["hessian"].relative[stamp_ns].C)


def test_a_scale_multiplies(tmp_path, domain_id, recording, by_mode) -> None:
    found = played(tmp_path, domain_id, recording, scale=2.5, inflate_unknown="false")
    for stamp_ns, pose in found.relative.items():
        plain = by_mode["cello3d"].relative[stamp_ns].C
        np.testing.assert_allclose(pose.C, 2.5 * plain, rtol=1e-6, atol=1e-15)


def test_a_pair_unlike_all_examples_warns_and_is_widened(tmp_path, domain_id, recording) -> None:
    """The room of the tests is unlike the training set's nearest when that is held very near."""
    settings = {"unknown_quantile": 0.0}
    (tmp_path / "kept").mkdir()
    (tmp_path / "widened").mkdir()
    kept, widened = (
        played(tmp_path / name, domain_id, recording, inflate_unknown=value, **settings)
        for name, value in (("kept", "false"), ("widened", "true"))
    )
    limit = load_model(shipped_model_path()).rho_quantiles[0]
    n_unknown = 0
    for stamp_ns, status in widened.status.items():
        if status["last_event"] != "answered":
            continue
        is_unknown = float(status["nearest_rho"]) > limit
        assert status["out_of_distribution"] == str(is_unknown).lower()
        n_unknown += is_unknown
        if is_unknown:
            assert status["level"] == "1"
            assert "out of distribution" in status["message"]
        wide, plain = widened.relative[stamp_ns].C, kept.relative[stamp_ns].C
        assert np.linalg.eigvalsh(wide - plain)[0] > -1e-12
    assert n_unknown > 0


@pytest.mark.parametrize("mode", ["cello3d", "hessian"])
def test_a_registration_that_is_probably_lost_is_told_of_and_wide(
    tmp_path, domain_id, recording, by_mode, mode
) -> None:
    """A model that takes every sandwich for a lost registration's."""
    V = np.diag([0.8, 0.5, 0.3, 0.09, 0.03, 0.12])
    suspicious = dataclasses.replace(load_model(shipped_model_path()), lost=Lost(1e-6, V))
    save_model(suspicious, tmp_path / "model.npz")
    found = played(
        *(tmp_path, domain_id, recording),
        model=str(tmp_path / "model.npz"),
        covariance_mode=mode,
        inflate_unknown="false",
    )
    answered = [status for status in found.status.values() if "probably_lost" in status]
    assert answered
    for status in answered:
        assert status["probably_lost"] == "true"
        assert "probably lost" in status["message"]
        assert status["level"] == ("2" if mode == "cello3d" else "1")
    for stamp_ns, pose in found.relative.items():
        plain = by_mode[mode].relative[stamp_ns].C
        assert (np.linalg.eigvalsh(pose.C - plain)[-1] > 0.7) == (mode == "cello3d")
    assert {
        status["probably_lost"]
        for status in by_mode[mode].status.values()
        if "probably_lost" in status
    } == {"false"}


def test_sizes_beyond_the_thresholds_warn_and_are_errors_but_are_published(
    tmp_path, domain_id, recording
) -> None:
    for name, level, limits in (
        ("warn", "1", {"warn_sigma_m": 1e-5}),
        ("error", "2", {"warn_sigma_m": 1e-6, "error_sigma_m": 1e-5}),
    ):
        (tmp_path / name).mkdir()
        found = played(tmp_path / name, domain_id, recording, **limits)
        status = found.status[recording[-1].stamp_ns]
        assert (status["last_event"], status["level"]) == ("answered", level)
        assert f"node.{name}_sigma_m" in status["message"]
        longest_m = 3.0 * math.sqrt(
            np.linalg.eigvalsh(found.relative[recording[-1].stamp_ns].C[:3, :3])[-1]
        )
        assert float(status["long_axis_3_sigma_m"]) == pytest.approx(longest_m, rel=1e-4)


def test_tf_is_published_when_asked_for_or_the_node_says_what_is_missing(
    tmp_path, domain_id, recording
) -> None:
    try:
        import tf2_msgs.msg
    except ImportError:
        with NodeProcess(tmp_path / "log", domain_id, {"node.publish_tf": "true"}) as process:
            assert process.wait(60.0) == 1
            assert "node.publish_tf needs the package tf2_msgs" in process.output()
            assert "Traceback" not in process.output()
        return
    assert tf2_msgs.msg.TFMessage
    found = played(tmp_path, domain_id, recording, publish_tf="true")
    assert len(found.poses) == len(recording) - 1
