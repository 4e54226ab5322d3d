"""A robot of the node's tests: it walks about a room and checks what it hears."""

from typing import Any

import numpy as np
from consumer_rules import complaints, of_pose, of_twist

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.tracking.warmup import room

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


def ellipsoid_of(marker: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return centre (3,) and (3, 3) matrix A of a SPHERE: its surface is ``centre + A e``."""
    p, q = marker.pose.position, marker.pose.orientation
    R = se3.pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))[:3, :3]
    diameters = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    return np.array([p.x, p.y, p.z]), R * (0.5 * diameters)
