"""What goes wrong around a node: time, publishers, the node itself, parameters, the scene."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from robot import STEP_NS, Robot

from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.ros import messages
from cello3d_ros.ros.process import NodeProcess
from cello3d_ros.ros.replay import Player

S = 10**9


def test_a_bag_that_is_played_in_a_loop(robot) -> None:
    robot.walk()
    start_ns, restarts = robot.stamp_ns, []
    for loop in range(3):  # a microsecond apart: diagnostics that come late are not this loop's
        robot.stamp_ns, heard = start_ns - 100 * S - 1000 * loop, robot.player.replay
        for of_last_time in (heard.status, heard.relative, heard.poses):
            of_last_time.clear()
        fates = [robot.walk() for _ in range(12)]
        assert [fate["last_event"] for fate in fates] == ["reference", *["answered"] * 11]
        restarts.append(int(fates[-1]["chain_restarts"]))
    assert np.diff(restarts).tolist() == [1, 1]
    robot.stamp_ns = start_ns + S


def test_parameters_that_change_under_load(robot, change, ask) -> None:
    """Clouds come as fast as they can be sent while settings go to and fro."""
    player, verdicts = robot.player, []
    change("icp.trim_ratio", 0.7)  # the service is known
    client = player._node.create_client(SetParameters, "/covariance_node/set_parameters")
    assert player.spin_until(client.service_is_ready, 20.0)

    def replied() -> bool:  # the first reply is lost when the node does not know yet who asks
        future = client.call_async(SetParameters.Request())
        player.spin_for(0.5)
        return bool(future.done())

    assert player.spin_until(replied, 20.0)
    for i in range(60):
        robot.step()
        player.publish_odometry(robot.stamp_ns, robot.pose())
        player.publish_cloud(robot.stamp_ns, robot.points())
        given = [
            Parameter("icp.trim_ratio", value=0.6 + 0.2 * (i % 2)),
            Parameter("node.ceiling", value=[900.0, 1e-6, 2e3][i % 3]),  # the last is refused
        ]
        request = SetParameters.Request(parameters=[p.to_parameter_msg() for p in given])
        verdicts.append(client.call_async(request))
        oldest = verdicts[max(0, i - 4)]  # ROS keeps no more than ten requests
        assert player.spin_until(oldest.done, 20.0)
    assert player.spin_until(lambda: all(v.done() for v in verdicts), 20.0)
    robot.settled()
    player._node.destroy_client(client)
    taken = [[result.successful for result in v.result().results] for v in verdicts]
    assert taken == [[True, i % 3 != 2] for i in range(60)]
    assert change("icp.trim_ratio", 0.7).successful
    assert change("node.ceiling", 900.0).successful
    robot.assert_right_again()


def test_the_newest_cloud_is_next_when_many_came_during_long_work(robot, change) -> None:
    """Each with its odometry, which waits in a queue of its own."""
    player = robot.player
    assert change("node.covariance_mode", "fused").successful
    assert change("node.n_registrations", 60).successful
    before = robot.walk(2)
    clouds, poses = [], []
    for _ in range(30):
        robot.step()
        clouds.append(messages.cloud_to(robot.stamp_ns, "lidar", robot.points()))
        poses.append(messages.odometry_to(robot.stamp_ns, "odom", "lidar", robot.pose()))
    for i, (cloud, pose) in enumerate(zip(clouds, poses)):
        player.odometry.publish(pose)
        player.clouds.publish(cloud)
        if i == 0:
            player.spin_for(0.1)  # the node is at work on it when the others come
    after = robot.settled(60.0)
    assert after["last_event"] == "answered"
    counts = [int(after[key]) - int(before[key]) for key in ("received", "answered", "dropped")]
    assert counts[0] == 30  # every cloud is accounted for
    assert counts[0] == counts[1] + counts[2]
    assert int(after["dropped.unheard"]) > int(before.get("dropped.unheard", 0))
    stamps = [messages.stamp_ns_of(cloud) for cloud in clouds[1:]]
    assert [ns for ns in stamps if ns in player.replay.relative] == stamps[-1:]
    assert change("node.covariance_mode", "cello3d").successful
    robot.assert_right_again()


PUBLISHER = """
import sys
from cello3d_ros.ros.replay import Player
from robot import Robot
robot = Robot(Player(int(sys.argv[1])))
robot.stamp_ns = int(sys.argv[2])
robot.player.connect(robot.stamp_ns, robot.pose(), 180.0)
while True:
    robot.walk()
    print(robot.n, flush=True)
"""


def test_a_publisher_that_is_killed_and_comes_back(robot, node, domain_id) -> None:
    for _ in range(2):
        robot.step(S)
        command = [sys.executable, "-c", PUBLISHER, str(domain_id), str(robot.stamp_ns)]
        path = os.pathsep.join(sys.path)
        other = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path}
        )
        try:
            assert other.stdout is not None
            assert [int(other.stdout.readline()) for _ in range(5)] == [1, 2, 3, 4, 5]
        finally:
            other.kill()
            other.wait()
        robot.stamp_ns += 1000 * STEP_NS
    player = robot.player

    def heard() -> bool:  # best effort: what is sent as the other dies may be lost
        robot.step()
        player.publish_odometry(robot.stamp_ns, robot.pose())
        player.publish_cloud(robot.stamp_ns, robot.points())
        player.spin_for(0.5)
        return player.replay.is_settled(robot.stamp_ns)

    assert player.spin_until(heard, 20.0)
    robot.walk(2)
    robot.assert_right_again()


def test_a_node_that_is_killed_and_comes_back(tmp_path, domain_id, model_path) -> None:
    name = "mortal_node"
    player = Player(domain_id, f"/{name}")
    robot = Robot(player)
    try:
        for i in range(2):
            with _named(name, tmp_path / str(i), domain_id, model_path) as process:
                _connect(robot, process)
                assert robot.walk(2)["chain_restarts"] == "0"
                robot.assert_right_again()
                if i == 0:
                    process.send(signal.SIGKILL)
                    assert process.wait() == -signal.SIGKILL
                else:
                    assert process.stop() == 0
            player.replay.last_status.clear()
            robot.step(S)
    finally:
        player.close()


def test_two_nodes_side_by_side(tmp_path, domain_id, model_path) -> None:
    names = ["left_node", "right_node"]
    domain_id += 101  # no other node listens there
    players = [Player(domain_id, f"/{name}") for name in names]
    robots = [Robot(player) for player in players]
    try:
        with (
            _named(names[0], tmp_path / "0", domain_id, model_path) as left,
            _named(names[1], tmp_path / "1", domain_id, model_path) as right,
        ):
            for robot, process in zip(robots, (left, right)):
                _connect(robot, process)
            heard, n_before = players[1].replay, _n_odometry(players[1])

            def both_hear() -> bool:
                robots[0].stamp_ns += STEP_NS // 100
                players[0].publish_odometry(robots[0].stamp_ns, robots[0].pose())
                players[0].spin_for(0.01)
                return players[0].clouds.get_subscription_count() == 2 and (
                    int(heard.last_status["odometry_received"]) > n_before
                )

            assert players[1].spin_until(both_hear, 20.0)
            for _ in range(4):  # both hear the first robot
                robots[0].walk()
                robots[1].stamp_ns, robots[1].n = robots[0].stamp_ns, robots[0].n
                robots[1].settled()
            robots[0].assert_right_again()
            robots[1].stamp_ns, robots[1].n = robots[0].stamp_ns, robots[0].n
            assert robots[1].settled()["last_event"] == "answered"
            stamp_ns = robots[0].stamp_ns
            a, b = (player.replay.relative[stamp_ns] for player in players)
            np.testing.assert_allclose(a.T, b.T, atol=0.02)
            assert left.stop() == right.stop() == 0
    finally:
        for player in players:
            player.close()


def _n_odometry(player: Player) -> int:
    """How many odometry messages the node has heard, when it hears no more of them."""
    player.spin_for(1.5)
    return int(player.replay.last_status["odometry_received"])


def _named(name: str, log, domain_id: int, model_path) -> NodeProcess:
    parameters = {"node.model": model_path}
    return NodeProcess(log, domain_id, parameters, ["-r", f"__node:={name}"])


def _connect(robot: Robot, process: NodeProcess) -> None:
    robot.player._check = process.check
    robot.player.connect(robot.stamp_ns, robot.pose(), 180.0)


def corridor(rng: np.random.Generator, x: float) -> np.ndarray:
    """Floor and walls of a corridor without ends, seen from ``x`` along it: (N, 3)."""
    u = rng.uniform([-15.0, -1.0], [15.0, 1.0], (6000, 2))
    floor = np.column_stack([u[:2000, 0], 1.2 * u[:2000, 1], np.full(2000, -1.0)])
    wall = np.column_stack([u[2000:, 0], np.full(4000, 1.2), 1.4 * u[2000:, 1] + 0.4])
    wall[::2, 1] *= -1.0
    return np.vstack([floor, wall])


def test_a_scene_that_degenerates_and_recovers(tmp_path, domain_id) -> None:
    """Nothing holds the way along a corridor without ends: no answer there, and one after."""
    model = tmp_path / "sandwich.npz"
    save_model(constant_model(np.eye(6), 704, shape="sandwich"), model)
    player = Player(domain_id, "/aware_node")
    robot, rng = Robot(player), np.random.default_rng(5)
    try:
        with _named("aware_node", tmp_path / "log", domain_id, model) as process:
            _connect(robot, process)
            at_home = _weakest(robot, robot.points)
            inside = _walk(robot, lambda: corridor(rng, 0.0), "free_direction")
            again = _weakest(robot, robot.points)
            assert process.stop() == 0
    finally:
        player.close()
    assert inside["last_event"] == "free_direction"
    assert again < 2.0 * at_home
    robot.assert_sane()


def _walk(robot: Robot, points: Callable[[], np.ndarray], event: str) -> dict[str, str]:
    """Walk on into the new scene until something becomes of a cloud; return the status then."""
    for n in range(20):
        robot.step()
        status = robot.send(points())
        if n > 3 and status["last_event"] == event:  # the old reference is given up by then
            break
    return status


def _weakest(robot: Robot, points: Callable[[], np.ndarray]) -> float:
    """Walk on into the new scene; return the largest sigma when a cloud is answered."""
    status = _walk(robot, points, "answered")
    assert status["last_event"] == "answered"
    return float(status["weakest_sigma_m"])
