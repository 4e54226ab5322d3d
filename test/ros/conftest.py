"""Real ROS with checked message fields, seen by this machine only, in a domain of this run."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from consumer_rules import complaints, of_pose, of_twist

from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.ros.process import NodeProcess, environment
from cello3d_ros.tracking.warmup import room

DOMAIN_ID = 1 + os.getpid() % 100

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ.update(environment(DOMAIN_ID))

STEP_NS = 100_000_000


class Robot:
    """Walks about a room, one scan a step, and sends what it sees or whatever a test makes up."""

    def __init__(self, player: Any) -> None:
        self.player = player
        self.rng = np.random.default_rng(1)
        self.stamp_ns = 10**18
        self.n = 0

    def pose(self) -> np.ndarray:
        """Where the robot is now."""
        a = 0.2 * self.n
        return se3.exp([0.5 * np.sin(a), 0.3 * np.cos(a), 0, 0, 0, 0.1 * np.sin(a)])

    def points(self, n_points: int = 4000, size_m: float = 6.0) -> np.ndarray:
        """What the robot sees now, in its room or in a hall that does not fit it."""
        return se3.transform(se3.inverse(self.pose()), room(self.rng, n_points, size_m))

    def step(self, dt_ns: int = STEP_NS) -> int:
        """Walk on; return the new stamp."""
        self.n += 1
        self.stamp_ns += dt_ns
        return self.stamp_ns

    def reconnect(self) -> None:
        """Wait until a node that has listened before hears again."""
        player, n_before = self.player, int(self.player.replay.last_status["odometry_received"])

        def heard() -> bool:
            if player.odometry.get_subscription_count() and player.clouds.get_subscription_count():
                self.stamp_ns += STEP_NS // 100
                player.publish_odometry(self.stamp_ns, self.pose())
            return int(player.replay.last_status["odometry_received"]) > n_before

        assert player.spin_until(heard, 20.0)

    def send(self, cloud: Any, odometry: bool = True, timeout_s: float = 10.0) -> dict[str, str]:
        """Send points or a whole message stamped now; return what diagnostics say of it."""
        if odometry:
            self.player.publish_odometry(self.stamp_ns, self.pose())
        if isinstance(cloud, np.ndarray):
            self.player.publish_cloud(self.stamp_ns, cloud)
        else:
            self.player.clouds.publish(cloud)
        return self.settled(timeout_s)

    def settled(self, timeout_s: float = 10.0) -> dict[str, str]:
        """Wait for the fate of the cloud stamped now."""
        replay = self.player.replay
        assert self.player.spin_until(lambda: replay.is_settled(self.stamp_ns), timeout_s), (
            f"nothing was heard of the cloud; the last was {replay.last_status}"
        )
        return replay.status[self.stamp_ns]

    def walk(self, n_steps: int = 1) -> dict[str, str]:
        """Take good steps and return the status of the last; a first scan is a reference."""
        for _ in range(n_steps):
            self.step()
            status = self.send(self.points())
        return status

    def assert_right_again(self) -> None:
        """The next good scan is answered, and rightly."""
        status = self.walk()
        assert status["last_event"] == "answered"
        before_ns = int(status["reference_stamp_ns"])
        n_before = self.n - round((self.stamp_ns - before_ns) / STEP_NS)
        here = self.pose()
        self.n, n_here = n_before, self.n
        T_true = se3.inverse(self.pose()) @ here
        self.n = n_here
        error = se3.log(se3.inverse(T_true) @ self.player.replay.relative[self.stamp_ns].T)
        assert np.abs(error).max() < 0.02

    def assert_sane(self) -> None:
        """Everything ever published is finite, exactly symmetric and positive definite."""
        replay = self.player.replay
        for pose in [*replay.relative.values(), *replay.poses.values()]:
            assert np.isfinite(pose.T).all()
            assert se3.is_rigid(pose.T, 1e-9)
            assert (pose.C == pose.C.T).all()
            assert is_positive_definite(pose.C)
            assert np.linalg.eigvalsh(pose.C)[0] > 0.0
            assert not complaints(pose.T.ravel(), pose.C)
        for message in replay.odometry.values():
            assert not [*of_pose(message), *of_twist(message)]


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
    pytest.importorskip("rclpy")
    log = tmp_path_factory.mktemp("node") / "log.txt"
    parameters = {"node.model": model_path, "node.odometry_timeout_s": 0.3}
    with NodeProcess(log, domain_id, parameters) as process:
        yield process
        process.check()
        assert process.stop() == 0
        assert "Traceback" not in process.output()


@pytest.fixture(scope="module")
def player(node: NodeProcess, domain_id: int) -> Iterator[Any]:
    """The other side of the graph."""
    replay = pytest.importorskip("cello3d_ros.ros.replay", exc_type=ImportError)
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
