"""Damaged bytes of clouds and odometry: the node outlives them and is right on the next scans."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rclpy.serialization import serialize_message

from cello3d_ros.ros import messages

N_BATCHES, N_BYTES = 25, 4


def damaged(raw: bytes, rng: np.random.Generator, n_header: int) -> bytes:
    """Return the bytes with some of them changed, half of the time in the header."""
    data = bytearray(raw)
    end = n_header if rng.random() < 0.5 else len(data)
    for place in rng.integers(4, end, N_BYTES):
        data[place] = rng.integers(256)
    if rng.random() < 0.2:
        del data[rng.integers(4, len(data)) :]
    return bytes(data)


def test_the_node_outlives_damaged_messages(robot, node) -> None:
    rng = np.random.default_rng(11)
    for _ in range(N_BATCHES):
        robot.step()
        cloud = messages.cloud_to(robot.stamp_ns, "lidar", robot.points())
        odometry = messages.odometry_to(robot.stamp_ns, "odom", "lidar", robot.pose())
        robot.player.odometry.publish(damaged(serialize_message(odometry), rng, 120))
        robot.player.clouds.publish(damaged(serialize_message(cloud), rng, 160))
        robot.walk(2)  # a damaged stamp may have reset the clock: the second has a reference
        robot.assert_right_again()
    node.check()
