"""What goes wrong outside of a registration costs a cloud or a reference, never the node."""

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace as Info

import numpy as np
import pytest
import rclpy

from cello3d_ros.config import Config, NodeConfig
from cello3d_ros.errors import ConfigError
from cello3d_ros.geometry import se3
from cello3d_ros.ros import messages
from cello3d_ros.ros.inputs import topics
from cello3d_ros.ros.node import CovarianceNode
from cello3d_ros.tracking.warmup import room

S = 1_000_000_000


@pytest.fixture
def node(model_path: Path) -> Iterator[CovarianceNode]:
    """An active node in this process, which hears by its own methods."""
    rclpy.init(args=["--ros-args", "-p", f"node.model:={model_path}", "--log-level", "fatal"])
    node = CovarianceNode("guarded")
    node.start()
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def hear(node: CovarianceNode, k: int) -> None:
    """Let a node hear the odometry and the cloud of the step k, and work."""
    T = se3.exp([0.1 * k, 0, 0, 0, 0, 0.02 * k])
    points = se3.transform(se3.inverse(T), room(np.random.default_rng(k)))
    node._on_pose(messages.odometry_to(S + k * S // 10, "odom", "lidar", T))
    node._on_cloud(messages.cloud_to(S + k * S // 10, "lidar", points), {})
    node._work()


def test_an_exception_after_an_answer_costs_the_reference_and_not_the_node(
    node, monkeypatch
) -> None:
    for k in range(3):
        hear(node, k)

    def fail() -> None:
        raise ZeroDivisionError("unforeseen")

    monkeypatch.setattr(node._worker._tracker, "finish", fail)
    hear(node, 3)
    monkeypatch.undo()
    assert (node._statistics.counts["answered"], sum(node._statistics.dropped.values())) == (3, 0)
    assert node._worker.n_restarts == 1
    hear(node, 4)
    hear(node, 5)
    assert node._statistics.counts["answered"] == 4
    assert node._statistics.counts["references"] == 2


def publisher(number: int) -> Info:
    return Info(endpoint_gid=[number, 7])


def test_only_clouds_of_one_and_the_same_publisher_are_missed(node, monkeypatch) -> None:
    """Each publisher numbers its own clouds: another one begins anywhere."""
    heard: list[int] = []
    for publishers, number in [
        ([1], 5),
        ([1], 6),
        ([1], 9),  # two were not heard
        ([2], 400),  # another publisher
        ([2], 402),  # one was not heard
        ([2, 3], 900),
        ([2, 3], 950),
        ([3], 2),
        ([3], 3),
    ]:
        found = [publisher(k) for k in publishers]
        monkeypatch.setattr(node, "get_publishers_info_by_topic", lambda _, found=found: found)
        heard.append(node._n_unheard({"publication_sequence_number": number}))
    assert heard == [0, 0, 2, 0, 1, 0, 0, 0, 0]


def test_a_constant_offset_of_the_clouds_clock_is_added(node) -> None:
    node._worker.set_config(with_node(node, cloud_time_offset_s=-37.0))
    for k in range(3):
        T = se3.exp([0.1 * k, 0, 0, 0, 0, 0.02 * k])
        points = se3.transform(se3.inverse(T), room(np.random.default_rng(k)))
        stamp_ns = 100 * S + k * S // 10
        node._on_pose(messages.odometry_to(stamp_ns, "odom", "lidar", T))
        node._on_cloud(messages.cloud_to(stamp_ns + 37 * S, "lidar", points), {})
        node._work()
    assert node._statistics.counts["answered"] == 2
    assert node._statistics._last_stamp_ns == 100 * S + 2 * S // 10


def with_node(node: CovarianceNode, **settings: object) -> Config:
    return replace(node._config, node=replace(node._config.node, **settings))


def test_odometry_from_the_future_is_named_where_clouds_wait_in_vain(node) -> None:
    ahead_ns = node._now_ns() + 5 * S
    for k in range(4):
        node._on_pose(messages.odometry_to(ahead_ns + k, "odom", "lidar", np.eye(4)))
    node._on_cloud(messages.cloud_to(node._now_ns(), "lidar", room(np.random.default_rng(0))), {})
    for _ in range(20):
        node._expire()
    assert node._statistics.dropped["no_odometry"] == 1
    assert "all 4 messages of odometry were rejected" in node._statistics._last_failure
    assert "s in the future" in node._statistics._last_failure
    assert "all 4 messages" in node._state().warnings[0]


def test_a_publisher_whose_clouds_never_arrive_names_the_profile(node, monkeypatch) -> None:
    monkeypatch.setattr(node, "count_publishers", lambda topic: 1)
    assert node._state().warnings == ()
    for _ in range(5):
        node._look_about()
    assert "fastdds_large_clouds.xml" in node._state().warnings[0]
    hear(node, 0)
    node._look_about()
    assert node._state().warnings == ()


def test_two_publishers_of_clouds_are_told(node, monkeypatch) -> None:
    found = [publisher(1), publisher(2)]
    monkeypatch.setattr(node, "get_publishers_info_by_topic", lambda _: found)
    hear(node, 0)
    assert "2 publishers send clouds on /points" in node._state().warnings[0]


def test_livox_clouds_are_answered_and_damaged_ones_are_skipped(node) -> None:
    """The message type itself comes with Livox's driver; the node reads its fields."""
    for k in range(3):
        T = se3.exp([0.1 * k, 0, 0, 0, 0, 0.02 * k])
        points = se3.transform(se3.inverse(T), room(np.random.default_rng(k), 2000))
        cloud = messages.cloud_to(S + k * S // 10, "lidar", points[:0])
        cells = [
            Info(x=x, y=y, z=z, reflectivity=7, tag=0, line=1, offset_time=i)
            for i, (x, y, z) in enumerate([*points, (0.0, 0.0, 0.0)])
        ]
        node._on_pose(messages.odometry_to(S + k * S // 10, "odom", "lidar", T))
        node._on_cloud(Info(header=cloud.header, points=cells), {})
        node._work()
    assert node._statistics.counts["answered"] == 2
    cloud.header.stamp = messages.time_of(2 * S)
    node._on_cloud(Info(header=cloud.header, points=[Info(x=1.0)]), {})
    assert node._statistics.dropped["malformed"] == 1


def test_without_livox_s_driver_its_clouds_are_refused_in_one_sentence() -> None:
    if find_spec("livox_ros_driver2") is not None:
        pytest.skip("livox_ros_driver2 is installed")
    with pytest.raises(ConfigError, match="needs the package livox_ros_driver2"):
        topics(NodeConfig(points_type="CustomMsg"))
