"""Pairing, registration, guess and frames of the node as its own process, over DDS."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from cello3d_ros.geometry import se3
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.ros import messages, replay
from cello3d_ros.ros.process import NodeProcess
from cello3d_ros.tracking.warmup import room

T0 = 10**18
STEP_NS = 100_000_000
START = se3.exp([5.0, 1.0, 0.0, 0.0, 0.0, 2.0])
X = se3.pose([0.2, 0.1, 1.1], [0.0, 0.1, 0.5, np.sqrt(1 - 0.01 - 0.25)])
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

Start = Callable[..., replay.Player]


class InMemory(list):
    """Scans as a recording."""

    name = "in memory"


def truth(i: int) -> np.ndarray:
    """Where the sensor is at step i, in its room."""
    return se3.exp(np.array([0.15, 0.05, 0.01, 0.01, -0.02, 0.06]) * i)


def walk(n_scans: int = 5, X_sensor: np.ndarray | None = None) -> InMemory:
    """Scans of a room with the odometry of the sensor, or of a base that carries it."""
    rng, scans = np.random.default_rng(3), InMemory()
    to_base = np.eye(4) if X_sensor is None else se3.inverse(X_sensor)
    for i in range(n_scans):
        points = se3.transform(se3.inverse(truth(i)), room(rng))
        T_odom = START @ truth(i) @ to_base
        stamp_ns = T0 + i * STEP_NS
        scans.append(
            Scan(stamp_ns=stamp_ns, points=points, T_world_sensor=truth(i), T_odom_sensor=T_odom)
        )
    return scans


@pytest.fixture
def start(tmp_path, domain_id, model_path) -> Iterator[Start]:
    """Start a node with some parameters and return a player beside it."""
    with ExitStack() as stack:

        def call(*ros_arguments: str, **settings: Any) -> replay.Player:
            parameters = {"node.model": model_path, "node.odometry_timeout_s": 0.3}
            parameters["node.pairing"] = "consecutive"
            parameters |= {f"node.{name}": value for name, value in settings.items()}
            log = tmp_path / "log.txt"
            node = NodeProcess(log, domain_id, parameters, ros_arguments)
            stack.callback(ended_well, node)
            player = replay.Player(domain_id, check=node.check)
            stack.callback(player.close)
            player.log = node.output
            return player

        yield call


def ended_well(node: NodeProcess) -> None:
    """The node has lived to the end."""
    node.check()
    assert node.stop() == 0
    assert "Traceback" not in node.output()


def connect(player: replay.Player, pose: Callable[[int], None] | None = None) -> None:
    """Wait until the node hears clouds and, if there are some, poses, and is heard.

    pose: publishes one with a stamp.
    """
    stamp_ns = T0 - 10 * STEP_NS

    def connected() -> bool:
        nonlocal stamp_ns
        stamp_ns = min(stamp_ns + STEP_NS // 100, T0 - 1)
        player.publish_cloud(stamp_ns, np.empty((0, 3)))
        if pose is not None:
            pose(stamp_ns)
        status = player.replay.last_status
        heard = int(status.get("received", 0)) > 0 and (
            pose is None or int(status["odometry_received"]) > 0
        )
        return heard and all(s.get_publisher_count() for s in player._subscriptions)

    assert player.spin_until(connected, 60.0)


def send(player: replay.Player, scan: Scan, odometry: bool = True) -> dict[str, str]:
    """Send one scan, with its odometry or without; return its fate."""
    if odometry:
        player.publish_odometry(scan.stamp_ns, scan.T_odom_sensor)
    player.publish_cloud(scan.stamp_ns, scan.points)
    return settled(player, scan.stamp_ns)


def settled(player: replay.Player, stamp_ns: int) -> dict[str, str]:
    """Wait for the fate of a cloud."""
    assert player.spin_until(lambda: player.replay.is_settled(stamp_ns), 20.0), (
        f"nothing was heard of the cloud; the last was {player.replay.last_status}"
    )
    return player.replay.status[stamp_ns]


def frames(player: replay.Player, name: str) -> set[str]:
    """The frames of all messages of one of the node's topics."""
    return {
        deserialize_message(raw, PoseWithCovarianceStamped).header.frame_id
        for topic, _, _, raw in player.replay.raw
        if topic == f"/covariance_node/{name}"
    }


def assert_near(T_true: np.ndarray, T: np.ndarray, tolerance: float = 0.02) -> None:
    """Two poses are the same up to what ICP can do."""
    assert np.abs(se3.log(se3.inverse(T_true) @ T)).max() < tolerance


def test_external_takes_one_parameter_and_one_remapping(start, constant_Y) -> None:
    player = start("-r", "external_odometry:=/odom", registration="external")
    scans = walk()
    played = replay.play(player, scans)
    offsets = []
    assert list(played.relative) == [scan.stamp_ns for scan in scans[1:]]
    for before, scan in itertools.pairwise(scans):
        pose, status = played.relative[scan.stamp_ns], played.status[scan.stamp_ns]
        expected = se3.inverse(before.T_odom_sensor) @ scan.T_odom_sensor
        np.testing.assert_allclose(pose.T, expected, atol=1e-9)  # to the last digit: no ICP
        np.testing.assert_allclose(played.poses[scan.stamp_ns].T, scan.T_odom_sensor, atol=1e-9)
        assert (status["guess"], status["iterations"]) == ("external", "0")
        extra = messages.reading_covariance(pose.C, pose.T[:3, :3]) - constant_Y
        offsets.append(float(status["external_offset_m"]))
        np.testing.assert_allclose(np.sqrt(np.trace(extra[:3, :3])), offsets[-1], atol=1e-4)
        assert np.linalg.eigvalsh(extra)[4] < 1e-9  # of rank one
    assert max(offsets) < 0.02  # the poses are the truth


def test_an_external_pose_belongs_to_the_cloud_of_its_stamp(start) -> None:
    player = start(registration="external")
    poses = player._node.create_publisher(PoseWithCovarianceStamped, "/external_pose", 10)

    def publish(stamp_ns: int, T: np.ndarray = START) -> None:
        poses.publish(messages.pose_with_covariance(stamp_ns, "map", T, np.zeros((6, 6))))

    connect(player, publish)
    fates = []
    for scan in walk(4):
        late_ns = STEP_NS // 2 if len(fates) == 2 else 0
        player.publish_cloud(scan.stamp_ns, scan.points)
        player.spin_for(0.05)  # the other program takes its time
        publish(scan.stamp_ns + late_ns, scan.T_odom_sensor)
        fates.append(settled(player, scan.stamp_ns))
    assert [fate["last_event"] for fate in fates] == [
        *("reference", "answered", "no_external_pose", "answered")
    ]
    assert "0.050 s away, more than 0.001 s" in fates[2]["last_failure"]
    assert fates[3]["reference_stamp_ns"] == str(T0 + STEP_NS)
    assert frames(player, "pose") == {"map"}


def test_a_keyframe_stays_until_the_sensor_has_left_it(start) -> None:
    player = start(pairing="keyframe", keyframe_distance_ratio=0.145, keyframe_min_overlap=0.0)
    scans = walk(8)  # half of the points are within 2.76 m: 0.4 m make a keyframe
    played = replay.play(player, scans)
    references = [
        (int(played.status[scan.stamp_ns]["reference_stamp_ns"]) - T0) // STEP_NS
        for scan in scans[1:]
    ]
    assert references == [0, 0, 0, 3, 3, 3, 6]
    for scan, i in zip(scans[1:], references, strict=True):
        T_true = se3.inverse(scans[i].T_world_sensor) @ scan.T_world_sensor
        assert_near(T_true, played.relative[scan.stamp_ns].T)
    traces = [np.trace(played.poses[scan.stamp_ns].C) for scan in scans[1:]]
    np.testing.assert_allclose(traces[:3], traces[0], rtol=1e-3)
    assert traces[3] > 1.5 * traces[2]


def until_not(reason: str, scan: Scan, show: Callable[[Scan], dict[str, str]]) -> None:
    """Send a scan with stamps in the last second before the first until it has another fate."""
    for k in range(100, 0, -1):
        status = show(replace(scan, stamp_ns=T0 - k * STEP_NS // 10))
        if status["last_event"] != reason:
            return
    pytest.fail(f"every cloud met {reason}: {status}")


def reference_cloud() -> PointCloud2:
    """The room as a map."""
    return messages.cloud_to(7, "map", room(np.random.default_rng(8), 40_000))


def test_clouds_are_registered_to_a_latched_map(start, constant_Y) -> None:
    player = start(pairing="topics")
    node = player._node
    node.create_publisher(PointCloud2, "/reference_points", LATCHED).publish(reference_cloud())
    player.connect(T0 - 11 * STEP_NS, np.eye(4), 60.0)
    until_not("no_reference", walk(1)[0], partial(send_in_map, player))
    jump = se3.exp([10.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for i, scan in enumerate(walk(6)):
        drift = se3.exp([0.05 * i, 0.0, 0.0, 0.0, 0.0, 0.0])  # odometry leaves the map slowly
        T_odom = (jump if i >= 4 else np.eye(4)) @ drift @ scan.T_world_sensor  # and at once
        player.publish_odometry(scan.stamp_ns, T_odom)
        player.publish_cloud(scan.stamp_ns, scan.points)
        status = settled(player, scan.stamp_ns)
        assert status["last_event"] == "answered", status["last_failure"]
        assert status["guess"] == ("constant_velocity" if i == 4 else "odometry")
        relative, pose = (d[scan.stamp_ns] for d in (player.replay.relative, player.replay.poses))
        assert_near(scan.T_world_sensor, pose.T)
        np.testing.assert_allclose(relative.T, pose.T, atol=1e-12)
        Y = messages.reading_covariance(pose.C, pose.T[:3, :3])
        np.testing.assert_allclose(Y, constant_Y, atol=1e-9)  # one registration, none before it
        assert status["reference_stamp_ns"] == "7"
    assert frames(player, "pose") == frames(player, "relative_pose") == {"map"}


def test_a_map_may_come_late_from_who_does_not_latch(start) -> None:
    player = start(pairing="topics")
    player.connect(T0 - 12 * STEP_NS, np.eye(4), 60.0)
    first, second = walk(2)
    before = replace(first, stamp_ns=T0 - 11 * STEP_NS)
    assert send_in_map(player, before)["last_event"] == "no_reference"
    maps = player._node.create_publisher(PointCloud2, "/reference_points", 1)
    assert player.spin_until(lambda: maps.get_subscription_count() == 1, 10.0)
    bad = reference_cloud()
    bad.header.frame_id = ""
    maps.publish(bad)
    assert player.spin_until(lambda: "reference cloud rejected: it has no f" in player.log(), 10.0)
    maps.publish(reference_cloud())
    until_not("no_reference", first, partial(send_in_map, player))
    assert send_in_map(player, second)["last_event"] == "answered"


def send_in_map(player: replay.Player, scan: Scan) -> dict[str, str]:
    """Send a scan with odometry that knows the map."""
    player.publish_odometry(scan.stamp_ns, scan.T_world_sensor)
    player.publish_cloud(scan.stamp_ns, scan.points)
    return settled(player, scan.stamp_ns)


@pytest.mark.parametrize("policy", ["skip", "constant_velocity", "extrapolate"])
def test_without_odometry_the_policy_decides(start, policy) -> None:
    player = start(guess_without_odometry=policy)
    scans = walk(6)
    player.connect(T0, scans[0].T_odom_sensor, 60.0)
    for scan in scans[:3]:
        send(player, scan)
    status = send(player, scans[3], odometry=False)
    if policy == "skip":
        assert status["last_event"] == "no_odometry"
    else:
        assert status["last_event"] == "answered", status["last_failure"]
        assert status["guess"] == ("extrapolated" if policy == "extrapolate" else policy)
        T_true = se3.inverse(truth(2)) @ truth(3)
        assert_near(T_true, player.replay.relative[scans[3].stamp_ns].T)
    for scan in scans[4:]:  # odometry is back
        status = send(player, scan)
        assert (status["last_event"], status["guess"]) == ("answered", "odometry")
    assert_near(START @ truth(5), player.replay.poses[scans[5].stamp_ns].T, 0.05)
    assert status["chain_restarts"] == "0"


def test_no_odometry_at_all(start) -> None:
    player = start(guess_without_odometry="constant_velocity", odometry_timeout_s=0.0)
    connect(player)
    scans = walk(5)
    fates = [send(player, scan, odometry=False) for scan in scans]
    assert [fate["last_event"] for fate in fates] == ["reference"] + 4 * ["answered"]
    assert_near(truth(4), player.replay.poses[scans[4].stamp_ns].T, 0.05)  # from where it began


def test_at_the_base_poses_are_those_of_the_odometrys_child(start, constant_Y) -> None:
    numbers = [float(x) for x in (*X[:3, 3], *se3.quaternion(X))]
    player = start(output_frame="base", T_base_sensor=numbers)
    scans = walk(4, X)
    played = replay.play(player, scans)
    Ad = se3.adjoint(se3.pose(numbers[:3], numbers[3:]))
    for before, scan in itertools.pairwise(scans):
        pose = played.relative[scan.stamp_ns]
        assert_near(se3.inverse(before.T_odom_sensor) @ scan.T_odom_sensor, pose.T, 0.03)
        Y = messages.reading_covariance(pose.C, pose.T[:3, :3])
        np.testing.assert_allclose(Y, Ad @ constant_Y @ Ad.T, atol=1e-12)
        assert_near(scan.T_odom_sensor, played.poses[scan.stamp_ns].T, 0.05)
    assert frames(player, "relative_pose") == {"lidar"}  # what the player calls its base
    assert frames(player, "pose") == {"odom"}


def transforms(T: np.ndarray, parent: str, child: str) -> Any:
    """One transform as a message of /tf_static."""
    from tf2_msgs.msg import TFMessage

    item = TransformStamped(child_frame_id=child)
    item.header.frame_id = parent
    pose = messages.pose_to(T)
    item.transform.rotation = pose.orientation
    for axis in "xyz":
        setattr(item.transform.translation, axis, getattr(pose.position, axis))
    return TFMessage(transforms=[item])


@pytest.mark.skipif(find_spec("tf2_msgs") is None, reason="tf2_msgs is not on PyPI")
def test_a_frame_unknown_to_tf_is_waited_for_and_then_refused(start) -> None:
    from tf2_msgs.msg import TFMessage

    player = start(use_tf="true")
    scans = walk(5, X)
    player.connect(T0 - 12 * STEP_NS, scans[0].T_odom_sensor, 60.0)
    static = player._node.create_publisher(TFMessage, "/tf_static", LATCHED)

    def shown(scan: Scan, frame_id: str) -> dict[str, str]:
        """Send a scan of base_link's lidar in a frame of some name."""
        odometry = messages.odometry_to(scan.stamp_ns, "odom", "base_link", scan.T_odom_sensor)
        player.odometry.publish(odometry)
        player.clouds.publish(messages.cloud_to(scan.stamp_ns, frame_id, scan.points))
        return settled(player, scan.stamp_ns)

    status = shown(replace(scans[0], stamp_ns=T0 - 11 * STEP_NS), "lidar")
    assert status["last_event"] == "unknown_frame"
    assert "no transforms connect 'base_link' and 'lidar'" in status["last_failure"]
    static.publish(transforms(X, "base_link", "lidar"))
    until_not("unknown_frame", scans[0], partial(shown, frame_id="lidar"))
    assert shown(scans[1], "camera")["last_event"] == "unknown_frame"
    for scan in scans[2:]:
        status = shown(scan, "lidar")
        assert status["last_event"] == "answered", status["last_failure"]
        assert_near(START @ scan.T_world_sensor, player.replay.poses[scan.stamp_ns].T)


@pytest.mark.skipif(find_spec("tf2_msgs") is not None, reason="tf2_msgs is installed")
def test_tf_without_its_messages_is_refused_by_name(tmp_path, domain_id, model_path) -> None:
    parameters = {"node.model": model_path, "node.use_tf": "true"}
    with NodeProcess(tmp_path / "log", domain_id, parameters) as node:
        assert node.wait(60.0) == 1
        assert "parameter node.use_tf needs the package tf2_msgs" in node.output()
        assert "Traceback" not in node.output()
