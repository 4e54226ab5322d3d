"""The node undoes the motion within clouds, over DDS."""

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2, PointField
from sweeps import PERIOD_NS, T0, error_m, pose_at, swept

from cello3d_ros.recordings.recording import Scan
from cello3d_ros.ros import messages, replay
from cello3d_ros.ros.process import NodeProcess


def cloud_of(scan: Scan, factor: float = 1.0) -> PointCloud2:
    """Return the message of a scan with the field ``time``, in seconds times a factor."""
    cells = np.column_stack([scan.points, factor * scan.time_s]).astype("<f4")
    message = messages.cloud_to(scan.stamp_ns, "lidar", np.empty((0, 3)))
    message.width, message.point_step, message.row_step = len(cells), 16, 16 * len(cells)
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(("x", "y", "z", "time"))
    ]
    message.data.frombytes(cells.tobytes())
    return message


@pytest.mark.parametrize("stamped", [0.0, 1.0], ids=["start", "end"])
def test_the_node_undoes_the_motion_and_says_by_what(
    tmp_path, domain_id, model_path, stamped
) -> None:
    parameters = {"node.model": model_path, "node.odometry_timeout_s": 5.0}
    parameters["node.pairing"] = "consecutive"
    node = NodeProcess(tmp_path / "log.txt", domain_id, parameters)
    player = replay.Player(domain_id, check=node.check)
    told, errors = [], []
    try:
        player.connect(T0 - PERIOD_NS, pose_at(-0.1), 60.0)
        for k in range(6):
            scan = swept(k, stamped)
            garbled = 1e8 if k == 5 else 1.0  # of no scan in any unit
            player.clouds.publish(cloud_of(scan, garbled))
            after_ns = round((1.0 - stamped) * PERIOD_NS)
            for ns in range(-PERIOD_NS, after_ns + 1, PERIOD_NS // 4):
                stamp_ns = scan.stamp_ns + ns
                if k == 0 or ns > after_ns - PERIOD_NS:
                    player.publish_odometry(stamp_ns, pose_at(1e-9 * (stamp_ns - T0)))
            settled = player.spin_until(
                lambda ns=scan.stamp_ns: player.replay.is_settled(ns), 20.0
            )
            assert settled, player.replay.last_status
            if k:
                told.append(player.replay.status[scan.stamp_ns]["deskewed"])
                errors.append(error_m(player.replay.relative[scan.stamp_ns].T))
    finally:
        player.close()
        assert node.stop() == 0
    assert told[:4] == 4 * ["by odometry"]
    assert told[4].startswith("no: the times of the points span")
    assert max(errors[:4]) < 0.01
    assert node.output().count("the motion within clouds is not undone") == 1
