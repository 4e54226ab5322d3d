"""Thousands of damaged clouds and odometry messages: the node outlives them, flat in memory.

Of the good scans between them each is answered, rightly, or named with its reason; and it is
answered when it has a good one to be registered to: one that was answered or started a chain.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.srv import GetState
from rclpy.serialization import serialize_message
from robot import Robot

from cello3d_ros.geometry import se3
from cello3d_ros.recordings import open_recording
from cello3d_ros.ros import messages

N_DAMAGED, N_BATCH = 5000, 100
N_GOOD = 4  # one more than the failures after which a reference is given up
STEP_NS = 1_500_000_000  # longer than a stamp may lie ahead and not be a jump of the clock
N_BYTES = 4
STARTS_A_CHAIN = {
    "reference",  # a stamp had lied about the time, or odometry about its frame
    "broken_chain",  # another frame_id, or odometry that jumped
    "too_far_apart",  # from a stamp that lied
}
EXPLAINED = {
    *STARTS_A_CHAIN,
    "out_of_order",  # the stamp of a cloud lay ahead by less than a second
    "no_odometry",  # that of an odometry message did, so that the good one came late
    "no_overlap",  # the reference is scrambled
    "registration",
    "not_converged",
    "beyond_model",
}
BAG = Path(__file__).parents[2] / "bags" / "demo"


def damaged(raw: bytes, rng: np.random.Generator, n_header: int) -> bytes:
    """Return the bytes with some of them changed, half of the time in the header."""
    data = bytearray(raw)
    end = n_header if rng.random() < 0.5 else len(data)
    for place in rng.integers(4, end, N_BYTES):
        data[place] = rng.integers(256)
    if rng.random() < 0.2:
        del data[rng.integers(4, len(data)) :]
    return bytes(data)


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(s.split()[1]) for s in lines if s.startswith("VmRSS:")) / 1024


class Walker(Robot):
    """Walks to and fro along a recording, with exact odometry."""

    def __init__(self, player: Any) -> None:
        super().__init__(player)
        self.scans = [(scan.T_world_sensor, scan.points[::4]) for scan in open_recording(BAG)]
        self.poses: dict[int, np.ndarray] = {}

    def scan(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the robot is and what it sees."""
        n = self.n % (2 * len(self.scans) - 2)
        return self.scans[min(n, 2 * len(self.scans) - 2 - n)]

    def pose(self) -> np.ndarray:
        return self.scan()[0]

    def points(self) -> np.ndarray:
        return self.scan()[1]

    def good(self) -> dict[str, str]:
        """Take a good step, and return what became of it."""
        self.step(STEP_NS)
        self.poses[self.stamp_ns] = self.pose()
        return self.send(self.points())

    def assert_fates(self) -> None:
        """Take good steps: each has its fate, named, counted and due."""
        has_good_reference = False
        for k in range(N_GOOD):
            before = dict(self.player.replay.last_status)
            status = self.good()
            if (event := status["last_event"]) == "answered":
                self.assert_right(status)
                has_good_reference = True
                continue
            assert not has_good_reference, f"{event}: {status['last_failure']}"
            assert k < N_GOOD - 1
            assert event in EXPLAINED
            has_good_reference = event in STARTS_A_CHAIN
            counter = "references" if event == "reference" else f"dropped.{event}"
            assert int(status[counter]) > int(before.get(counter, 0))
            assert status["last_restart" if event == "reference" else "last_failure"]

    def assert_right(self, status: dict[str, str]) -> None:
        """An answer to a good scan is right, if its reference is one."""
        before_ns = int(status["reference_stamp_ns"])
        if before_ns in self.poses:
            T_true = se3.inverse(self.poses[before_ns]) @ self.pose()
            T = self.player.replay.relative[self.stamp_ns].T
            assert np.abs(se3.log(se3.inverse(T_true) @ T)).max() < 0.1

    def wait(self, ask: Callable[..., Any]) -> None:
        """Let the node hear what was sent: one message of a topic and one request at a time."""
        ask(GetState, "get_state", GetState.Request())


@pytest.fixture(scope="module")
def walker(lone_robot) -> Walker:
    return Walker(lone_robot.player)


def test_thousands_of_damaged_clouds(walker, node, ask) -> None:
    rng = np.random.default_rng(11)
    walker.good()
    n_before, memory_before_mb = _count(walker, "received"), memory_mb(node.pid)
    for _ in range(N_DAMAGED // N_BATCH):
        for i in range(N_BATCH):
            walker.stamp_ns += 1_000_000
            cloud = messages.cloud_to(walker.stamp_ns, "lidar", walker.points())
            walker.player.publish_odometry(walker.stamp_ns, walker.pose())
            walker.player.clouds.publish(damaged(serialize_message(cloud), rng, 160))
            if i % 2:
                walker.wait(ask)
        walker.assert_fates()
    assert_all_accounted_for(walker)
    assert _count(walker, "received") - n_before > 0.9 * N_DAMAGED  # heard or unheard
    assert memory_mb(node.pid) - memory_before_mb < 30.0


def test_thousands_of_damaged_odometry_messages(walker, node, ask) -> None:
    rng = np.random.default_rng(12)
    walker.good()
    n_before, memory_before_mb = _count(walker, "odometry_received"), memory_mb(node.pid)
    for _ in range(N_DAMAGED // N_BATCH):
        for _ in range(N_BATCH):
            walker.stamp_ns += 1_000_000
            odometry = messages.odometry_to(walker.stamp_ns, "odom", "lidar", walker.pose())
            walker.player.odometry.publish(damaged(serialize_message(odometry), rng, 120))
            walker.wait(ask)
        walker.assert_fates()
    assert _count(walker, "odometry_received") - n_before > 0.5 * N_DAMAGED
    assert memory_mb(node.pid) - memory_before_mb < 30.0


def assert_all_accounted_for(walker: Walker) -> None:
    """Every cloud that came has one fate."""
    fates = [_count(walker, key) for key in ("answered", "references", "dropped")]
    assert _count(walker, "received") == sum(fates)


def _count(walker: Walker, key: str) -> int:
    return int(walker.player.replay.last_status[key])
