"""``cello3d replay`` gives the node's numbers, without ROS."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from cello3d_ros.cli.main import main
from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.geometry.gaussian import to_fixed_axes
from cello3d_ros.geometry.se3 import exp, inverse, pose, transform
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.poses import kitti_line, read_tum
from cello3d_ros.tracking.warmup import room

N = 6
MOUNT = pose([0.5, 0.1, 0.8], [0.0, 0.0, np.sin(0.15), np.cos(0.15)])
MOUNT_WORDS = ["0.5", "0.1", "0.8", "0", "0", str(np.sin(0.15)), str(np.cos(0.15))]
TOPICS = ("/covariance_node/relative_pose", "/covariance_node/pose")


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A model whose prediction is relative to the pair's own shape, so that it differs."""
    path = tmp_path_factory.mktemp("model") / "relative.npz"
    save_model(constant_model(np.eye(6), 704, shape="sandwich"), path)
    return path


def walk(
    path: Path,
    holes: tuple[int, ...] = (),
    odometry: bool = True,
    truth: bool = True,
    late: int = 0,
) -> Path:
    """Write a bag; holes: clouds that are empty; late: clouds before the first odometry."""
    rng = np.random.default_rng(2)
    poses = [exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]) * i) for i in range(N)]
    drift = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.002])
    scans = [
        Scan(
            stamp_ns=10**18 + i * 500_000_000,
            points=np.empty((0, 3)) if i in holes else transform(inverse(T), room(rng)),
            T_world_sensor=T if truth else None,
            T_odom_sensor=T @ exp(drift * i) if odometry and i >= late else None,
        )
        for i, T in enumerate(poses)
    ]
    write_bag(path, scans)
    return path


def answers(bag: Path) -> dict[str, list[np.ndarray]]:
    """Return stamp, pose and covariance of each message in one row, by topic."""
    rows: dict[str, list[np.ndarray]] = {topic: [] for topic in TOPICS}
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic in TOPICS:
                m = reader.deserialize(raw, connection.msgtype)
                p, q, stamp = m.pose.pose.position, m.pose.pose.orientation, m.header.stamp
                pose = [stamp.sec, stamp.nanosec, p.x, p.y, p.z, q.x, q.y, q.z, q.w]
                rows[connection.topic].append(np.concatenate([pose, m.pose.covariance]))
    return rows


def test_the_numbers_are_those_of_the_node_on_the_same_bag(tmp_path: Path, model: Path) -> None:
    pytest.importorskip("rclpy")
    bag = walk(tmp_path / "walk")
    run = "from cello3d_ros.cli.main import main\nraise SystemExit(main())"
    words = ["demo", "--recording", bag, "--out", tmp_path / "node", "--model", model]
    done = subprocess.run(
        [sys.executable, "-c", run, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "ROS_PYTHON_CHECK_FIELDS": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert main(["replay", str(bag), "--out", str(tmp_path / "r"), "--model", str(model)]) == 0
    node, ours = answers(tmp_path / "node" / "bag"), answers(tmp_path / "r" / "bag")
    for topic in TOPICS:
        assert len(node[topic]) == len(ours[topic]) == N - 1
        assert np.abs(np.array(node[topic]) - np.array(ours[topic])).max() < 1e-9
    covariances = np.array(ours[TOPICS[0]])[:, 9:]
    assert np.ptp(covariances, axis=0).max() > 1e-9  # the comparison is not of constants


def test_three_files_say_the_same(tmp_path: Path, model: Path, capsys) -> None:
    bag = walk(tmp_path / "walk")
    out = tmp_path / "r"
    assert main(["replay", str(bag), "--out", str(out), "--model", str(model)]) == 0
    assert "5 of 5 pairs answered" in capsys.readouterr().out
    lines = [json.loads(line) for line in (out / "covariances.jsonl").read_text().splitlines()]
    assert lines[0] == {"stamp_ns": 10**18, "reason": "reference", "sentence": ""}
    tum = read_tum((out / "poses.tum").read_bytes(), "poses")
    rows = answers(out / "bag")
    assert [line["stamp_ns"] for line in lines[1:]] == tum.stamps_ns
    for k, line in enumerate(lines[1:]):
        np.testing.assert_allclose(line["covariance_ros"], rows[TOPICS[0]][k][9:], atol=1e-15)
        T, Y = (np.reshape(line[name], (n, n)) for name, n in (("T_odom_read", 4), ("Y_chain", 6)))
        C = to_fixed_axes(T[:3, :3], Y)
        np.testing.assert_allclose(C.ravel(), rows[TOPICS[1]][k][9:], atol=1e-15)
        assert np.array_equal(tum.rows[k], rows[TOPICS[1]][k][2:9])
        assert np.allclose(np.reshape(line["T_odom_read"], (4, 4))[:3, 3], tum.rows[k, :3])


def test_failures_are_counted_and_named(tmp_path: Path, model: Path, capsys) -> None:
    bag = walk(tmp_path / "walk", holes=(2,))
    out = tmp_path / "r"
    assert main(["replay", str(bag), "--out", str(out), "--model", str(model), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["n_answered"], summary["n_pairs"]) == (4, 5)
    assert summary["failures"] == {"too_few_points": 1}
    lines = [json.loads(line) for line in (out / "covariances.jsonl").read_text().splitlines()]
    assert lines[2]["reason"] == "too_few_points"


def lines_of(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "covariances.jsonl").read_text().splitlines()]


def test_without_odometry_the_guess_is_constant_velocity_and_ground_truth_is_not_read(
    tmp_path: Path, model: Path
) -> None:
    (tmp_path / "c.yaml").write_text("node: {pairing: consecutive}")
    words = ["--model", str(model), "--config", str(tmp_path / "c.yaml")]
    for name in ("walk", "bare"):
        bag = walk(tmp_path / name, odometry=False, truth=name == "walk")
        assert main(["replay", str(bag), "--out", str(tmp_path / f"{name}-out"), *words]) == 0
    with_truth, without = lines_of(tmp_path / "walk-out"), lines_of(tmp_path / "bare-out")
    assert with_truth == without
    assert len(with_truth) == N
    step = exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]))
    for line in without[1:]:
        assert np.abs(np.reshape(line["T_ref_read"], (4, 4)) - step).max() < 0.02


def test_odometry_is_simulated_where_that_is_asked_for_by_name(tmp_path, model) -> None:
    bag = walk(tmp_path / "walk", odometry=False)
    words = ["replay", str(bag), "--model", str(model), "--odometry", "simulated"]
    assert main([*words, "--out", str(tmp_path / "a")]) == 0
    assert main([*words, "--out", str(tmp_path / "b")]) == 0
    assert lines_of(tmp_path / "a") == lines_of(tmp_path / "b")
    assert main([*words[:4], "--out", str(tmp_path / "c")]) == 0
    assert lines_of(tmp_path / "a") != lines_of(tmp_path / "c")


def test_external_poses_that_nobody_gave_are_not_made(tmp_path, model, capsys) -> None:
    bag = walk(tmp_path / "walk", odometry=False)
    (tmp_path / "c.yaml").write_text("node: {registration: external}\n")
    words = ["replay", str(bag), "--model", str(model), "--config", str(tmp_path / "c.yaml")]
    assert main([*words, "--out", str(tmp_path / "r")]) == 1
    assert "walk has no odometry, and node.registration external needs" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_a_cloud_before_the_first_odometry_does_not_change_the_others(tmp_path, model) -> None:
    """Only that cloud has no answer; recorded odometry is used for all others."""
    bag = walk(tmp_path / "walk", late=1)
    out = tmp_path / "r"
    assert main(["replay", str(bag), "--out", str(out), "--model", str(model)]) == 0
    lines = lines_of(out)
    assert [line.get("reason", "") for line in lines] == ["no_odometry", "reference", *[""] * 4]
    T = exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]))
    start = T @ exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.002]))
    first = np.reshape(lines[2]["T_odom_read"], (4, 4)) @ inverse(
        np.reshape(lines[2]["T_ref_read"], (4, 4))
    )
    assert np.allclose(first, start, atol=1e-9)


def test_the_sensor_is_where_the_node_s_parameter_says(tmp_path: Path, model: Path) -> None:
    bag = walk(tmp_path / "walk")
    quarter = [0.1, 0.2, 0.3, 0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]
    (tmp_path / "c.yaml").write_text(f"node: {{T_base_sensor: {quarter}}}\n")
    words = ["replay", str(bag), "--model", str(model)]
    assert main([*words, "--out", str(tmp_path / "b"), "--config", str(tmp_path / "c.yaml")]) == 0
    lines = (tmp_path / "b" / "covariances.jsonl").read_text().splitlines()
    first = next(answer for line in lines if "T_odom_read" in (answer := json.loads(line)))
    T = np.reshape(first["T_odom_read"], (4, 4)) @ inverse(np.reshape(first["T_ref_read"], (4, 4)))
    start = np.reshape([0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1], (4, 4))
    assert first["reference_ns"] == 10**18  # where the odometry is the identity
    assert np.allclose(T, start, atol=1e-9)


def test_recorded_poses_as_external_registrations_are_the_result(tmp_path, model) -> None:
    bag = walk(tmp_path / "walk")
    (tmp_path / "c.yaml").write_text("node: {registration: external}\n")
    words = ["replay", str(bag), "--model", str(model), "--config", str(tmp_path / "c.yaml")]
    assert main([*words, "--out", str(tmp_path / "r")]) == 0
    lines = (tmp_path / "r" / "covariances.jsonl").read_text().splitlines()[1:]
    drift = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.002])
    for i, line in enumerate(map(json.loads, lines), start=1):
        T = exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]) * i) @ exp(drift * i)
        assert np.allclose(np.reshape(line["T_odom_read"], (4, 4)), T, atol=1e-9)


@pytest.mark.parametrize("odometry", [True, False])
def test_poses_by_file_take_the_place_of_odometry(tmp_path, model, odometry) -> None:
    """Also of odometry that a bag has, unless it is asked for by name."""
    bag = walk(tmp_path / "walk", odometry=odometry)
    T = [exp(np.array([0.21, 0.0, 0.0, 0.0, 0.0, 0.1]) * i) for i in range(N)]
    (tmp_path / "slam.txt").write_text("".join(map(kitti_line, T)))
    (tmp_path / "c.yaml").write_text("node: {registration: external}\n")
    words = ["replay", str(bag), "--model", str(model), "--config", str(tmp_path / "c.yaml")]
    words += ["--poses", str(tmp_path / "slam.txt")]
    assert main([*words, "--out", str(tmp_path / "r")]) == 0
    for i, line in enumerate(lines_of(tmp_path / "r")[1:], start=1):
        assert np.allclose(np.reshape(line["T_odom_read"], (4, 4)), T[i], atol=1e-9)
    if odometry:
        assert main([*words, "--out", str(tmp_path / "own"), "--odometry", "/odom"]) == 0
        last = np.reshape(lines_of(tmp_path / "own")[-1]["T_odom_read"], (4, 4))
        assert not np.allclose(last, T[-1], atol=1e-3)


def test_no_answer_at_all_is_an_error_and_leaves_nothing(tmp_path, model, capsys) -> None:
    bag = walk(tmp_path / "walk", holes=tuple(range(N)))
    assert main(["replay", str(bag), "--out", str(tmp_path / "r"), "--model", str(model)]) == 1
    assert "no pair was answered" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["walk"]


def test_it_runs_where_ros_cannot_be_imported(tmp_path: Path, model: Path) -> None:
    bag = walk(tmp_path / "walk")
    code = (
        "import sys\n"
        "for name in ('rclpy', 'sensor_msgs', 'geometry_msgs', 'nav_msgs', 'open3d'):\n"
        "    sys.modules[name] = None\n"
        "from cello3d_ros.cli.main import main\nraise SystemExit(main())"
    )
    words = ["replay", str(bag), "--out", str(tmp_path / "r"), "--model", str(model)]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def mounted(path: Path, given: bool) -> Path:
    """Write a walk whose odometry is of base_link, the lidar half a metre ahead, and say it so."""
    from rosbags.typesys import Stores, get_typestore

    from cello3d_ros.recordings.bag_messages import Messages
    from cello3d_ros.recordings.bag_writer import write_messages

    make = Messages(get_typestore(Stores.ROS2_JAZZY))
    rng = np.random.default_rng(2)
    messages = []
    for i in range(N):
        T, stamp_ns = exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1]) * i), 10**18 + i * 5 * 10**8
        odometry = make.odometry(T, stamp_ns, "odom")
        odometry.child_frame_id = "base_link"
        points = transform(inverse(T @ MOUNT), room(rng))
        messages.append(("/odom", stamp_ns, odometry))
        if given:
            tf = make.transform(MOUNT, stamp_ns, "base_link", "lidar")
            messages.append(("/tf", stamp_ns, tf))
        messages.append(("/points", stamp_ns, make.cloud(Scan(stamp_ns=stamp_ns, points=points))))
    write_messages(path, messages)
    return path


def test_the_sensor_is_where_the_transforms_of_the_bag_say_or_the_user(tmp_path, model) -> None:
    words = ["--model", str(model)]
    told, silent = mounted(tmp_path / "told", True), mounted(tmp_path / "silent", False)
    assert main(["replay", str(told), "--out", str(tmp_path / "a"), *words]) == 0
    given = ["--extrinsic", *MOUNT_WORDS]
    assert main(["replay", str(silent), "--out", str(tmp_path / "b"), *words, *given]) == 0
    for a, b in zip(lines_of(tmp_path / "a")[1:], lines_of(tmp_path / "b")[1:], strict=True):
        assert np.abs(np.array(a["T_odom_read"]) - b["T_odom_read"]).max() < 1e-9
    T = exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.1])) @ MOUNT
    first = np.reshape(lines_of(tmp_path / "a")[1]["T_odom_read"], (4, 4))
    assert np.abs(first - T).max() < 0.02


def test_an_unknown_place_of_the_sensor_is_an_error(tmp_path, model, capsys) -> None:
    bag = mounted(tmp_path / "silent", False)
    assert main(["replay", str(bag), "--out", str(tmp_path / "r"), "--model", str(model)]) == 1
    assert "--extrinsic" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()
