"""Real ROS with checked message fields, seen by this machine only, in a domain of this run."""

import os
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot import Robot

from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.ros.process import NodeProcess, environment

DOMAIN_ID = 1 + os.getpid() % 100

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ.update(environment(DOMAIN_ID))


class _WithoutRos(pytest.Module):
    """A test module that is skipped whole."""

    def collect(self) -> Iterator[pytest.Item]:
        pytest.skip("rclpy is not installed: source ROS 2 or install the extra 'ros'")


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> Any:
    """Skip modules that need ROS before anything imports them."""
    if find_spec("rclpy") is None:
        return _WithoutRos.from_parent(parent, path=module_path)
    return None


@pytest.fixture(scope="session")
def domain_id() -> int:
    """The ROS domain of this run."""
    return DOMAIN_ID


@pytest.fixture(scope="session")
def constant_Y() -> np.ndarray:
    """The covariance that the tests' model always predicts, reading side."""
    A = np.random.default_rng(7).normal(size=(6, 6)) * np.repeat([4e-3, 1e-3], 3)[:, None]
    return A @ A.T + np.diag(np.repeat([1e-6, 1e-7], 3))


@pytest.fixture(scope="session")
def model_path(tmp_path_factory: pytest.TempPathFactory, constant_Y: np.ndarray) -> Path:
    """A model of one example."""
    path = tmp_path_factory.mktemp("model") / "constant.npz"
    save_model(constant_model(constant_Y, 704), path)
    return path


@pytest.fixture(scope="module")
def node(
    tmp_path_factory: pytest.TempPathFactory, domain_id: int, model_path: Path
) -> Iterator[NodeProcess]:
    """A node that serves a whole module; it must live to the end and leave with status 0."""
    log = tmp_path_factory.mktemp("node") / "log.txt"
    parameters = {
        "node.model": model_path,
        "node.odometry_timeout_s": 0.3,
        "node.pairing": "consecutive",
    }
    with NodeProcess(log, domain_id, parameters) as process:
        yield process
        process.check()
        assert process.stop() == 0
        assert "Traceback" not in process.output()


@pytest.fixture(scope="module")
def player(node: NodeProcess, domain_id: int) -> Iterator[Any]:
    """The other side of the graph."""
    from cello3d_ros.ros import replay

    player = replay.Player(domain_id, check=node.check)
    yield player
    player.close()


@pytest.fixture(scope="module")
def lone_robot(player: Any) -> Robot:
    """A robot that has not taken a step."""
    robot = Robot(player)
    player.connect(robot.stamp_ns, robot.pose(), 180.0)  # a first start compiles
    return robot


@pytest.fixture(scope="module")
def ask(player: Any) -> Callable[..., Any]:
    """Call a service of the node; the first request of a kind may come to it twice."""

    clients: dict[str, Any] = {}

    def call(kind: Any, name: str, request: Any) -> Any:
        n_tries = 1
        if name not in clients:
            clients[name] = player._node.create_client(kind, f"/covariance_node/{name}")
            assert player.spin_until(clients[name].service_is_ready, 60.0)
            n_tries = 10  # a reply is lost when the node does not know yet who asks
        for _ in range(n_tries):
            future = clients[name].call_async(request)
            if player.spin_until(future.done, 180.0 / n_tries):
                return future.result()
        raise AssertionError(f"no reply from {name}")

    return call


@pytest.fixture(scope="module")
def change(ask: Callable[..., Any]) -> Callable[..., Any]:
    """Set one parameter and return the node's verdict."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    def call(name: str, value: object) -> Any:
        message = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return ask(SetParameters, "set_parameters", request).results[0]

    return call


@pytest.fixture
def robot(lone_robot: Robot) -> Iterator[Robot]:
    """A robot whose last scan is the reference; what it heard is checked in the end."""
    lone_robot.walk(2)
    yield lone_robot
    lone_robot.assert_sane()
