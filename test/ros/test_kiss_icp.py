"""KISS-ICP as the external registration of the node's process, on a real recording."""

import os
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import mahalanobis
from cello3d_ros.recordings import open_recording
from cello3d_ros.ros import messages, replay
from cello3d_ros.ros.process import NodeProcess

STREET = Path(os.environ.get("CELLO3D_EVALUATION", "/nowhere")) / "data" / "street"
STEP_NS = 100_000_000

pytestmark = pytest.mark.skipif(not STREET.is_dir(), reason="no CELLO3D_EVALUATION")


class InMemory(list):
    """Scans as a recording."""

    name = "street"


@pytest.fixture(scope="module")
def scans() -> InMemory:
    """Ten scans of a street, with KISS-ICP's poses where odometry would be."""
    pytest.importorskip("kiss_icp")
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.deskew = False
    odometry, scans = KissICP(config), InMemory()
    for k, scan in enumerate(islice(open_recording(STREET), 10)):
        odometry.register_frame(scan.points, np.zeros(len(scan.points)))
        stamp_ns = 10**18 + k * STEP_NS
        scans.append(replace(scan, stamp_ns=stamp_ns, T_odom_sensor=odometry.last_pose.copy()))
    return scans


def test_every_pose_of_kiss_icp_gets_a_covariance_that_holds(scans, tmp_path, domain_id) -> None:
    arguments = ["-r", "external_odometry:=/odom"]
    parameters = {"node.registration": "external", "node.pairing": "consecutive"}
    with NodeProcess(tmp_path / "log", domain_id, parameters, arguments) as node:
        player = replay.Player(domain_id, check=node.check)
        try:
            played = replay.play(player, scans)
        finally:
            player.close()
    assert list(played.relative) == [scan.stamp_ns for scan in scans[1:]]
    distances2 = []
    for before, scan in pairwise(scans):
        pose = played.relative[scan.stamp_ns]
        T_kiss = se3.inverse(before.T_odom_sensor) @ scan.T_odom_sensor
        np.testing.assert_allclose(pose.T, T_kiss, atol=1e-9)
        T_true = se3.inverse(before.T_world_sensor) @ scan.T_world_sensor
        Y = messages.reading_covariance(pose.C, pose.T[:3, :3])
        distances2.append(mahalanobis(se3.log(se3.inverse(T_true) @ pose.T), Y) ** 2)
    assert 0.2 < np.mean(distances2) / 6 < 2.0
