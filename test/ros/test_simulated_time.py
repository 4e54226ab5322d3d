"""use_sim_time: stamps are judged by /clock, and a clock set back clears what is remembered."""

from collections.abc import Iterator
from typing import Any

import pytest
from rosgraph_msgs.msg import Clock

from cello3d_ros.ros import messages, replay
from cello3d_ros.ros.process import NodeProcess

S = 10**9


@pytest.fixture(scope="module")
def node(tmp_path_factory, domain_id, model_path) -> Iterator[NodeProcess]:
    """A node that lives in simulated time."""
    parameters = {"node.model": model_path, "use_sim_time": "true"}
    with NodeProcess(tmp_path_factory.mktemp("node") / "log", domain_id, parameters) as process:
        yield process
        assert process.stop() == 0


@pytest.fixture(scope="module")
def clock(player) -> Any:
    """Set the simulated time and wait until the node has it."""
    publisher = player._node.create_publisher(Clock, "/clock", 10)

    def set_to(now_ns: int) -> None:
        def has_it() -> bool:
            publisher.publish(Clock(clock=messages.time_of(now_ns)))
            return any(
                abs(stamp_of_diagnostics(raw) - now_ns) < S // 10
                for topic, _, _, raw in player.replay.raw[-3:]
                if topic == "/diagnostics"
            )

        assert player.spin_until(has_it, 20.0)

    return set_to


def stamp_of_diagnostics(raw: bytes) -> int:
    """Return the node's own time of a message."""
    from rclpy.serialization import deserialize_message

    return messages.stamp_ns_of(deserialize_message(raw, replay.DiagnosticArray))


def test_stamps_are_judged_by_the_simulated_clock(lone_robot, clock) -> None:
    robot = lone_robot
    robot.stamp_ns = 100 * S
    clock(101 * S)
    robot.walk(2)
    robot.assert_right_again()
    here_ns = robot.stamp_ns
    robot.stamp_ns = 102 * S
    status = robot.send(robot.points(), odometry=False)
    assert status["last_event"] == "future_stamp"
    robot.stamp_ns = here_ns
    robot.assert_right_again()


def test_a_clock_that_jumps_back_clears_what_is_remembered(lone_robot, clock, node) -> None:
    robot = lone_robot
    before = robot.player.replay.last_status
    clock(50 * S)
    robot.stamp_ns = 49 * S
    status = robot.walk()
    assert status["last_event"] == "reference"
    assert int(status["clock_jumps"]) == int(before["clock_jumps"]) + 1
    assert "time jumped back" in node.output()
    robot.assert_right_again()
    robot.assert_sane()
