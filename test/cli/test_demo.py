"""The demo: a bag through the node, and what is left behind."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from consumer_rules import of_pose, of_twist

from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.learning.measures import verdict
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.tracking.warmup import room

ROOM_SIGMAS = [3e-3] * 3 + [1e-3] * 3


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A model that always predicts the same."""
    path = tmp_path_factory.mktemp("model") / "constant.npz"
    save_model(constant_model(np.diag(np.square(ROOM_SIGMAS)), 704), path)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """A walk through a room."""
    path = tmp_path_factory.mktemp("bag") / "walk"
    rng = np.random.default_rng(2)
    poses = [exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]) * i) for i in range(6)]
    write_bag(
        path,
        (
            Scan(
                stamp_ns=10**18 + i * 500_000_000,
                points=transform(inverse(T), room(rng)),
                T_world_sensor=T,
                T_odom_sensor=T @ exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.002]) * i),
            )
            for i, T in enumerate(poses)
        ),
    )
    return path


def cello3d(*arguments: object, code: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, after some lines of Python."""
    run = f"{code}\nfrom cello3d_ros.cli.main import main\nraise SystemExit(main())"
    return subprocess.run(
        [sys.executable, "-c", run, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, "ROS_PYTHON_CHECK_FIELDS": "1"},
    )


def test_every_pair_of_a_bag_is_answered_and_judged(tmp_path, bag, model) -> None:
    pytest.importorskip("rclpy")
    out = tmp_path / "out"
    more = ("-p", "node.seed:=3")
    done = cello3d("demo", "--recording", bag, "--out", out, "--model", model, *more)
    assert done.returncode == 0, done.stderr
    assert "5 of 5" in done.stdout
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["pairs_expected"] == summary["relative_poses"] == summary["poses"] == 5
    assert summary["dropped"] == 0
    assert summary["model"] == "constant.npz"
    assert summary["median_translation_error_m"] < 0.01
    assert summary["final_translation_error_m"] < 0.03
    assert 0.0 < summary["mean_mahalanobis_6dof"] < 10.0
    assert 0.0 <= summary["coverage_95"] <= 1.0
    words = re.search(r"^The covariance is (.+) \(D2/6 ", done.stdout, re.MULTILINE)
    assert words
    assert words[1] == verdict(summary["mean_d2_over_6"])
    assert summary["min_eigenvalue"] == pytest.approx(1e-6, rel=0.01)
    assert 0.0 < summary["latency_ms"]["p50"] <= summary["latency_ms"]["p95"]
    assert (tmp_path / "out" / "trajectory.png").read_bytes().startswith(b"\x89PNG")


def test_the_nodes_messages_are_in_a_bag_that_others_can_read(tmp_path, bag, model) -> None:
    pytest.importorskip("rclpy")
    from rosbags.highlevel import AnyReader

    for _ in range(2):  # the second run replaces what the first has left
        done = cello3d("demo", "--recording", bag, "--out", tmp_path, "--model", model)
        assert done.returncode == 0, done.stderr
    with AnyReader([tmp_path / "bag"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts["/covariance_node/relative_pose"] == 5
        assert counts["/covariance_node/pose"] == 5
        assert counts["/covariance_node/odometry"] == 5
        assert counts["/covariance_node/markers"] > 0
        assert counts["/diagnostics"] >= 6
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic.endswith(("pose", "odometry")):
                assert not of_pose(message)
            if connection.topic.endswith("odometry"):
                assert not of_twist(message)


def test_a_node_that_dies_is_one_sentence_and_a_summary(tmp_path, bag) -> None:
    pytest.importorskip("rclpy")
    done = cello3d("demo", "--recording", bag, "--out", tmp_path, "--model", tmp_path / "no.npz")
    assert done.returncode == 1
    assert done.stderr.startswith("cello3d: covariance_node ended with status 1: ")
    assert len(done.stderr.splitlines()) == 1
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["pairs_expected"], summary["relative_poses"]) == (5, 0)
    assert summary["mean_mahalanobis_6dof"] is None


def test_a_missing_answer_is_one_sentence_and_status_1(tmp_path, model) -> None:
    pytest.importorskip("rclpy")
    rng = np.random.default_rng(2)
    clouds = [room(rng), room(rng), np.zeros((0, 3)), room(rng)]
    write_bag(
        tmp_path / "holes",
        (
            Scan(stamp_ns=10**18 + i * 10**8, points=p, T_odom_sensor=np.eye(4))
            for i, p in enumerate(clouds)
        ),
    )
    done = cello3d(
        "demo", "--recording", tmp_path / "holes", "--out", tmp_path / "out", "--model", model
    )
    assert done.returncode == 1
    assert "2 of 3 pairs were answered; the last failure: 0 of 0 points" in done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["dropped"] == 1
    assert summary["median_translation_error_m"] is None
    assert "has no ground truth" in done.stdout


def test_a_recording_without_any_poses_is_answered_at_constant_velocity(tmp_path, model) -> None:
    pytest.importorskip("rclpy")
    rng = np.random.default_rng(2)
    poses = [exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]) * i) for i in range(4)]
    write_bag(
        tmp_path / "bare",
        (
            Scan(stamp_ns=10**18 + i * 10**8, points=transform(inverse(T), room(rng)))
            for i, T in enumerate(poses)
        ),
    )
    words = ("demo", "--recording", tmp_path / "bare", "--model", model)
    done = cello3d(*words, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "3 of 3" in done.stdout
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["final_translation_error_m"] is None
    done = cello3d(*words, "--out", tmp_path / "simulated", "--odometry", "simulated")
    assert done.returncode == 1
    assert "bare has no ground truth to simulate odometry from" in done.stderr


def test_without_ros_it_says_what_to_install(tmp_path, bag) -> None:
    done = cello3d(
        *("demo", "--recording", bag, "--out", tmp_path),
        code="import sys; sys.modules['rclpy'] = None",
    )
    assert done.returncode == 1
    assert done.stderr.startswith(
        "cello3d: the demo needs ROS 2: source /opt/ros/jazzy/setup.bash"
    )


def test_a_missing_recording(tmp_path) -> None:
    done = cello3d("demo", "--recording", tmp_path / "none", "--out", tmp_path)
    assert done.returncode == 1
    assert "no such file or folder" in done.stderr
