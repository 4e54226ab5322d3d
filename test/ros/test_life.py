"""The node as a lifecycle node: states, what is heard in each, what fails and why."""

import shutil
from collections.abc import Iterator

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_srvs.srv import Trigger

from cello3d_ros.ros.process import NodeProcess
from cello3d_ros.ros.replay import Player

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = (
    *(State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE),
    *(State.PRIMARY_STATE_ACTIVE, State.PRIMARY_STATE_FINALIZED),
)


@pytest.fixture(scope="module")
def node(tmp_path_factory, domain_id) -> Iterator[NodeProcess]:
    """A node that waits to be told, with a model that is not there."""
    parameters = {"node.model": "/no/model.npz", "node.autostart": "false"}
    with NodeProcess(tmp_path_factory.mktemp("node") / "log", domain_id, parameters) as process:
        yield process
        process.check()
        assert process.stop() == 0
        assert "Traceback" not in process.output()


@pytest.fixture(scope="module")
def go(ask):
    """Ask for a transition; return whether it was made and the state after it."""

    def call(transition: int) -> tuple[bool, int]:
        request = ChangeState.Request(transition=Transition(id=transition))
        made = ask(ChangeState, "change_state", request).success
        return made, ask(GetState, "get_state", GetState.Request()).current_state.id

    return call


def test_a_whole_life(
    go, ask, change, node, player: Player, model_path, request, tmp_path
) -> None:
    model = tmp_path / "model.npz"
    shutil.copy(model_path, model)
    assert go(Transition.TRANSITION_ACTIVATE) == (False, UNCONFIGURED)
    assert go(Transition.TRANSITION_CONFIGURE) == (False, UNCONFIGURED)
    assert "/no/model.npz: no such model file" in node.output()
    assert change("node.model", str(model)).successful
    assert go(Transition.TRANSITION_CONFIGURE) == (True, INACTIVE)
    heard = player.replay
    assert player.spin_until(lambda: heard.last_status.get("last_event") == "inactive", 10.0)
    assert player.clouds.get_subscription_count() == 0
    assert go(Transition.TRANSITION_CONFIGURE) == (False, INACTIVE)

    assert go(Transition.TRANSITION_ACTIVATE) == (True, ACTIVE)
    robot = request.getfixturevalue("lone_robot")
    robot.walk(2)
    robot.assert_right_again()

    assert go(Transition.TRANSITION_DEACTIVATE) == (True, INACTIVE)
    assert player.spin_until(lambda: player.clouds.get_subscription_count() == 0, 10.0)
    assert "configure" in change("cloud.voxel_m", 0.25).reason
    assert go(Transition.TRANSITION_ACTIVATE) == (True, ACTIVE)
    robot.reconnect()
    assert robot.walk()["last_event"] == "reference"
    robot.assert_right_again()

    whole = model.read_bytes()
    model.write_bytes(whole[:1000])  # replaced on disk, in place, while it is used
    robot.walk(3)
    robot.assert_right_again()

    assert go(Transition.TRANSITION_DEACTIVATE) == (True, INACTIVE)
    assert go(Transition.TRANSITION_CLEANUP) == (True, UNCONFIGURED)
    assert go(Transition.TRANSITION_CONFIGURE) == (False, UNCONFIGURED)
    assert f"{model} is truncated or damaged" in node.output()
    model.write_bytes(whole)
    assert change("cloud.voxel_m", 0.25).successful
    assert go(Transition.TRANSITION_CONFIGURE) == (True, INACTIVE)
    assert "robot, this is robot, changed: cloud.voxel_m is 0.25, not 0.1" in node.output()
    assert go(Transition.TRANSITION_ACTIVATE) == (True, ACTIVE)
    robot.reconnect()
    assert robot.walk()["last_event"] == "reference"
    robot.assert_right_again()

    before = robot.walk()
    assert int(before["chain_restarts"]) == 0
    assert ask(Trigger, "reset", Trigger.Request()).success
    assert robot.walk()["last_event"] == "reference"
    status = robot.walk()
    assert int(status["chain_restarts"]) == 1
    robot.assert_right_again()

    assert go(Transition.TRANSITION_ACTIVE_SHUTDOWN) == (True, FINALIZED)
    robot.assert_sane()
