"""The paper's own model in the node, over DDS: it computes the descriptor."""

import numpy as np
import pytest
from node_plays import played
from room_walks import InMemory, walk_in_a_room

from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.model import load_model
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.ros import messages


@pytest.fixture(scope="module")
def recording() -> InMemory:
    return walk_in_a_room(4, 0.4, n_points=8000)


def test_the_node_answers_with_the_papers_model_as_python_does(
    tmp_path, domain_id, recording
) -> None:
    found = played(tmp_path, domain_id, recording, model="paper", inflate_unknown="false")
    stamps = [scan.stamp_ns for scan in recording]
    assert list(found.relative) == stamps[1:]
    assert found.last_status["model"] == "paper.npz"
    assert all(latency > 0 for latency in found.latencies_ms())
    model = load_model("paper")
    assert model.features == "descriptor"
    assert model.shape == "none"
    estimator = Estimator(model)
    by_stamp = {str(scan.stamp_ns): scan for scan in recording}
    for scan in recording[1:]:
        before = by_stamp[found.status[scan.stamp_ns]["reference_stamp_ns"]]
        T_init = se3.inverse(before.T_world_sensor) @ scan.T_world_sensor
        ours = estimator(scan.points, before.points, T_init)
        pose = found.relative[scan.stamp_ns]
        Y = messages.reading_covariance(pose.C, pose.T[:3, :3])
        assert is_positive_definite(Y)
        # other subsamples, hence another pose within its scatter and nearly the same descriptor
        assert np.abs(se3.log(se3.inverse(ours.T_ref_read) @ pose.T)).max() < 0.01
        ratio = np.linalg.eigvals(np.linalg.solve(ours.covariance, Y)).real
        assert 0.2 < ratio.min() <= ratio.max() < 5.0
