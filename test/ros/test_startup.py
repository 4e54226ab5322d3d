"""Starting and stopping the node: parameters, model, signals."""

import math
import signal
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import Config, load_config
from cello3d_ros.geometry import se3
from cello3d_ros.ros import parameter_file
from cello3d_ros.ros.process import NodeDiedError, NodeProcess, shared_file
from cello3d_ros.ros.replay import Player
from cello3d_ros.tracking.warmup import room


def last_words(log: Path, domain_id: int, parameters, ros_arguments=()) -> str:
    """Start a node that must refuse: status 1, one sentence, no traceback."""
    with NodeProcess(log, domain_id, parameters, ros_arguments) as process:
        assert process.wait(60.0) == 1
        lines = [line for line in process.output().splitlines() if not line.startswith("[")]
        assert len(lines) == 1
        assert lines[0].startswith("covariance_node: ")
        return lines[0]


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("icp.trim_ratio", "1", "icp.trim_ratio must be of type float (write a decimal point"),
        ("icp.trim_ratio", "1.5", "icp.trim_ratio must be in [0.01, 1]: 1.5"),
        ("icp.max_iterations", "many", "icp.max_iterations must be of type int: 'many'"),
        ("icp.error_metric", "fast", "must be one of point_to_plane, point_to_point: 'fast'"),
        ("node.ceiling", ".nan", "node.ceiling must be in [1e-06, 1000]: nan"),
        ("grid.n_cells", "[5, 5, 5]", "parameters grid.* must be the model's"),
        ("node.covariance_mode", "best", "must be one of cello3d, fused, sigma_points, censi, "),
        ("node.floor_sigma_m", "50.0", "must be below the root of parameter node.ceiling, 30: 50"),
    ],
)
def test_a_bad_parameter_is_named_with_its_value_and_what_is_allowed(
    tmp_path, domain_id, model_path, name, value, sentence
) -> None:
    words = last_words(tmp_path / "log", domain_id, {"node.model": model_path, name: value})
    assert sentence in words


def test_a_parameter_that_ros_cannot_parse(tmp_path, domain_id) -> None:
    words = last_words(tmp_path / "log", domain_id, {}, ["--params-file", "/no/such.yaml"])
    assert "cannot start with these ROS arguments" in words


def test_a_missing_model(tmp_path, domain_id) -> None:
    words = last_words(tmp_path / "log", domain_id, {"node.model": tmp_path / "none.npz"})
    assert f"{tmp_path / 'none.npz'}: no such model file" in words


@pytest.mark.parametrize("n_bytes", [0, 10, 1000])
def test_a_truncated_model(tmp_path, domain_id, model_path, n_bytes) -> None:
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(model_path.read_bytes()[:n_bytes])
    words = last_words(tmp_path / "log", domain_id, {"node.model": damaged})
    assert str(damaged) in words


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_running_node_with_status_0(
    tmp_path, domain_id, model_path, number
) -> None:
    parameters = {
        "node.model": model_path,
        "icp.trim": 0.5,
        "icp.trim_ratio": 0.8,
    }
    with NodeProcess(tmp_path / "log", domain_id, parameters) as process:
        player = Player(domain_id, check=process.check)
        running = player.spin_until(lambda: bool(player.replay.last_status), 60.0)
        player.close()
        assert running
        process.send(number)
        assert process.wait() == 0
        output = process.output()
    assert "unknown parameter icp.trim has no effect" in output
    assert "pipeline robot, this is robot, changed: icp.trim_ratio is 0.8, not 0.7" in output
    assert "Traceback" not in output


def test_a_node_that_died_is_noticed_with_its_last_words(tmp_path, domain_id) -> None:
    with NodeProcess(tmp_path / "log", domain_id, {"node.model": "/no/model"}) as process:
        process.wait(60.0)
        with pytest.raises(NodeDiedError, match=r"status 1: covariance_node: /no/model: no such"):
            process.check()


def test_the_shipped_parameter_file_is_the_default_configuration() -> None:
    path = shared_file("config", "cello3d.yaml")
    assert path is not None
    assert load_config(path) == Config()
    assert path.read_text() == parameter_file.text(), (
        "run python -m cello3d_ros.ros.parameter_file > config/cello3d.yaml"
    )


def test_the_node_takes_the_shipped_parameter_file(tmp_path, domain_id, model_path) -> None:
    path = shared_file("config", "cello3d.yaml")
    arguments = ["--params-file", str(path)]
    parameters = {"node.model": model_path}
    with NodeProcess(tmp_path / "log", domain_id, parameters, arguments) as process:
        player = Player(domain_id, check=process.check)
        running = player.spin_until(lambda: bool(player.replay.last_status), 60.0)
        player.close()
        assert running
        assert process.stop() == 0
        assert "[WARN]" not in process.output()


def test_a_shipped_model_has_a_name(tmp_path, domain_id) -> None:
    with NodeProcess(tmp_path / "log", domain_id, {"node.model": "paper"}) as process:
        player = Player(domain_id, check=process.check)
        running = player.spin_until(lambda: bool(player.replay.last_status), 60.0)
        player.close()
        assert running
        assert player.replay.last_status["model"] == "paper.npz"
        assert process.stop() == 0


def test_the_sensor_may_sit_anywhere_on_the_base(tmp_path, domain_id, model_path) -> None:
    quarter = [0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)]
    T_base_sensor = se3.pose([0.4, -0.2, 1.0], quarter)
    parameters = {
        "node.model": model_path,
        "node.T_base_sensor": f"[0.4, -0.2, 1.0, 0.0, 0.0, {quarter[2]}, {quarter[3]}]",
    }
    rng = np.random.default_rng(0)
    poses = [se3.exp([0.2 * i, 0.1, 0.0, 0.0, 0.0, 0.9 * i]) for i in range(3)]  # of the base
    points = room(rng)
    with NodeProcess(tmp_path / "log", domain_id, parameters) as process:
        player = Player(domain_id, check=process.check)
        player.connect(10**18, poses[0], 60.0)
        for i, T in enumerate(poses):
            stamp_ns = 10**18 + i * 10**8
            player.publish_odometry(stamp_ns, T)
            seen = se3.transform(se3.inverse(T @ T_base_sensor), points)
            player.publish_cloud(stamp_ns, seen)
            assert player.spin_until(lambda s=stamp_ns: player.replay.is_settled(s), 20.0)
        player.close()
    assert len(player.replay.poses) == 2
    np.testing.assert_allclose(
        player.replay.poses[stamp_ns].T, poses[-1] @ T_base_sensor, atol=0.02
    )
