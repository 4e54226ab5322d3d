"""What is published for an answer, whatever was paired with what."""

import numpy as np
import pytest
from consumer_rules import of_pose, of_twist

from cello3d_ros.config import NodeConfig
from cello3d_ros.covariance.estimator import Estimate
from cello3d_ros.errors import CovarianceError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import GaussianPose
from cello3d_ros.registration.icp import Registration
from cello3d_ros.ros import messages, outputs
from cello3d_ros.tracking.tracker import Answer

S = 1_000_000_000
STEP = se3.exp([0.2, 0.01, 0.0, 0.0, 0.01, 0.05])
Y = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])


def answer(span_s: float | None = 0.1, Y_step: np.ndarray = Y) -> Answer:
    registration = Registration(STEP, 7, True, "", 0.02, 900)
    found = Estimate(registration, 0.8, Y_step, 0.5, 4.0)
    step, pose = GaussianPose(STEP, Y_step), GaussianPose(STEP @ STEP, 2.0 * Y)
    motion = None if span_s is None else step
    return Answer(101 * S, 100 * S, found, step, pose, motion=motion, span_s=span_s)


def test_the_twist_is_the_motion_over_its_time() -> None:
    twist, C = outputs._twist(answer(), NodeConfig())
    np.testing.assert_allclose(se3.exp(0.1 * twist), STEP, atol=1e-12)
    np.testing.assert_allclose(C, 100.0 * Y, rtol=1e-9)


def test_a_velocity_that_nobody_knows_weighs_nothing() -> None:
    twist, C = outputs._twist(answer(None), NodeConfig())
    np.testing.assert_array_equal(twist, np.zeros(6))
    np.testing.assert_array_equal(C, 900.0 * np.eye(6))


def adversarial() -> list[np.ndarray]:
    v = np.arange(1.0, 7.0)
    return [np.zeros((6, 6)), np.outer(v, v), 1e300 * np.eye(6), -np.eye(6), 1e-300 * np.eye(6)]


@pytest.mark.parametrize("Y_step", adversarial())
@pytest.mark.parametrize("span_s", [1e-9, 0.1, 9.0])
def test_odometry_is_taken_by_its_consumers_whatever_the_covariance(Y_step, span_s) -> None:
    given, config = answer(span_s, Y_step), NodeConfig()
    pose = outputs._pose(given.stamp_ns, "odom", GaussianPose(given.pose.T, Y_step), config)
    message = messages.full_odometry(pose, "lidar", *outputs._twist(given, config))
    assert not of_pose(message)
    assert not of_twist(message)
    assert message.header == pose.header
    assert message.child_frame_id == "lidar"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    Y_bad = Y.copy()
    Y_bad[1, 1] = bad
    with pytest.raises(CovarianceError):
        outputs._twist(answer(Y_step=Y_bad), NodeConfig())
    with pytest.raises(CovarianceError):
        outputs._pose(1, "odom", GaussianPose(STEP, Y_bad), NodeConfig())
    pose = outputs._pose(1, "odom", GaussianPose(STEP, Y), NodeConfig())
    with pytest.raises(CovarianceError):
        messages.full_odometry(pose, "lidar", np.full(6, bad), Y)


def test_a_transform_is_the_pose() -> None:
    T = messages.transform_to(3 * S + 5, "odom", "lidar", STEP)
    assert (T.header.frame_id, T.child_frame_id, T.header.stamp.nanosec) == ("odom", "lidar", 5)
    t, q = T.transform.translation, T.transform.rotation
    np.testing.assert_allclose(se3.pose((t.x, t.y, t.z), (q.x, q.y, q.z, q.w)), STEP, atol=1e-12)
