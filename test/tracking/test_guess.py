"""Where the sensor is: sources, extrinsic, what is done without odometry."""

from types import SimpleNamespace as Message

import numpy as np
import pytest

from cello3d_ros.config import NodeConfig
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import to_left
from cello3d_ros.geometry.pose_track import PoseMissingError, PoseNotYetError, PoseTrack
from cello3d_ros.geometry.transforms import TransformTree, UnknownFrameError
from cello3d_ros.tracking.guess import FixedFrameError, Locator
from cello3d_ros.tracking.odometry import PoseSource

S = 10**9
STEP = se3.exp([0.5, 0.1, 0.0, 0.02, -0.05, 0.3])
X = se3.exp([0.2, 0.0, 1.0, 0.0, 0.0, 0.5])


def locator(*poses: tuple[int, np.ndarray], transforms=None, **settings) -> Locator:
    """A locator that has heard some poses of base_link in odom."""
    source = PoseSource(PoseTrack(1.0, 100.0))
    for stamp_ns, T in poses:
        source.hear(stamp_ns, T, "odom", "base_link", 50.0)
    return Locator(NodeConfig(**settings), source, transforms)


def test_the_sensor_is_where_odometry_and_extrinsic_put_it() -> None:
    numbers = tuple(float(x) for x in (*X[:3, 3], *se3.quaternion(X)))
    where = locator((S, STEP), T_base_sensor=numbers)
    place = where.place(S, "lidar", is_late=False)
    np.testing.assert_allclose(place.T_odom_sensor, STEP @ X, atol=1e-9)
    assert (place.guess, place.odom_frame, place.base_frame) == ("odometry", "odom", "base_link")


@pytest.mark.parametrize("policy", ["skip", "constant_velocity", "extrapolate"])
def test_odometry_is_waited_for_before_anything_else_is_done(policy) -> None:
    where = locator((S, STEP), (S + S // 2, STEP), guess_without_odometry=policy)
    with pytest.raises(PoseNotYetError):
        where.place(S + S // 2 + 1, "lidar", is_late=False)


def test_skip_without_odometry() -> None:
    with pytest.raises(PoseNotYetError):
        locator((S, STEP)).place(2 * S, "lidar", is_late=True)


def test_constant_velocity_leaves_the_pose_to_the_chain() -> None:
    where = locator((S, STEP), guess_without_odometry="constant_velocity")
    place = where.place(2 * S, "lidar", is_late=True)
    assert place.T_odom_sensor is None
    assert place.guess == "constant_velocity"


def test_constant_velocity_does_not_wait_for_odometry_that_cannot_come() -> None:
    where = locator((5 * S, STEP), guess_without_odometry="constant_velocity")
    assert where.place(S, "lidar", is_late=False).guess == "constant_velocity"


def test_extrapolation_carries_on_the_last_twist_of_the_base() -> None:
    poses = (S, np.eye(4)), (S + S // 2, STEP)
    where = locator(*poses, guess_without_odometry="extrapolate", max_extrapolation_s=0.5)
    place = where.place(S + 3 * S // 4, "lidar", is_late=True)
    expected = STEP @ se3.exp(0.5 * se3.log(STEP))
    np.testing.assert_allclose(place.T_odom_sensor, expected, atol=1e-12)
    assert place.guess == "extrapolated"


@pytest.mark.parametrize("stamp_ns", [S // 2, 2 * S + S // 2])
def test_extrapolation_has_a_limit_and_does_not_go_back(stamp_ns) -> None:
    where = locator((S, np.eye(4)), (S + S // 2, STEP), guess_without_odometry="extrapolate")
    with pytest.raises(PoseMissingError):
        where.place(stamp_ns, "lidar", is_late=True)


def test_one_pose_is_not_extrapolated() -> None:
    with pytest.raises(PoseMissingError, match="no two messages"):
        locator((S, STEP), guess_without_odometry="extrapolate").place(S + 1, "lidar", True)


def test_an_external_registration_is_taken_at_the_stamp_and_never_interpolated() -> None:
    where = locator((S, np.eye(4)), (2 * S, STEP), registration="external")
    place = where.place(2 * S - 500_000, "lidar", is_late=False)
    np.testing.assert_array_equal(place.T_odom_sensor, STEP)
    assert place.guess == "external"
    with pytest.raises(PoseMissingError, match=r"0\.500 s away, more than 0\.001 s"):
        where.place(S + S // 2, "lidar", is_late=False)
    with pytest.raises(PoseNotYetError):
        where.place(2 * S + 2_000_000, "lidar", is_late=True)


def test_the_extrinsic_is_that_of_tf_or_there_is_none() -> None:
    transforms = TransformTree(1.0, 10.0)
    where = locator((S, STEP), transforms=transforms)
    with pytest.raises(UnknownFrameError, match="'base_link' and 'lidar'"):
        where.place(S, "lidar", is_late=True)
    _hear(transforms, "base_link", "lidar", X)
    np.testing.assert_allclose(where.place(S, "lidar", False).T_odom_sensor, STEP @ X, atol=1e-9)


def test_the_map_is_where_tf_puts_it_or_as_the_answers_say() -> None:
    where = locator((S, STEP))
    where.map_frame = "map"
    assert where.place(S, "lidar", False).T_map_odom is None
    where.transforms = TransformTree(1.0, 10.0)
    _hear(where.transforms, "base_link", "lidar", X)
    with pytest.raises(UnknownFrameError, match="'map' and 'odom'"):
        where.place(S, "lidar", False)
    _hear(where.transforms, "map", "odom", STEP)
    np.testing.assert_allclose(where.place(S, "lidar", False).T_map_odom, STEP, atol=1e-9)


def test_an_external_pose_must_be_in_the_frame_of_the_map() -> None:
    where = locator((S, STEP), registration="external")
    where.map_frame = "map"
    with pytest.raises(UnknownFrameError, match="in 'odom' but the reference cloud in 'map'"):
        where.place(S, "lidar", False)
    where.map_frame = "odom"
    assert where.place(S, "lidar", False).guess == "external"


def _hear(transforms: TransformTree, parent: str, child: str, T: np.ndarray) -> None:
    p, q = T[:3, 3], se3.quaternion(T)
    transform = Message(
        translation=Message(x=p[0], y=p[1], z=p[2]),
        rotation=Message(x=q[0], y=q[1], z=q[2], w=q[3]),
    )
    header = Message(frame_id=parent, stamp=Message(sec=0, nanosec=0))
    item = Message(header=header, child_frame_id=child, transform=transform)
    assert transforms.add(Message(transforms=[item]), True) == []


@pytest.mark.parametrize("frame", ["odom", "/odom", "map", "world", "earth"])
def test_clouds_in_a_frame_that_stands_still_are_refused(frame: str) -> None:
    where = locator((S, STEP))
    with pytest.raises(FixedFrameError, match="does not move with the sensor") as caught:
        where.place(S, frame, is_late=False)
    assert caught.value.reason == "fixed_frame"


def test_clouds_in_the_frame_of_the_map_or_beyond_the_odometry_are_refused() -> None:
    where = locator((S, STEP))
    where.map_frame = "site"
    with pytest.raises(FixedFrameError):
        where.place(S, "site", is_late=False)
    transforms = TransformTree(1.0, 10.0)
    for parent, child in (("base_link", "lidar"), ("odom", "base_link"), ("city", "odom")):
        _hear(transforms, parent, child, X)
    where = locator((S, STEP), transforms=transforms)
    with pytest.raises(FixedFrameError):
        where.place(S, "city", is_late=False)
    np.testing.assert_allclose(where.place(S, "lidar", is_late=False).T_base_sensor, X)


def test_the_identity_is_not_assumed_without_a_word() -> None:
    where = locator((S, STEP))
    where.place(S, "lidar", is_late=False)
    assert "clouds are in 'lidar' and the odometry is of 'base_link'" in where.warning
    where.place(S, "base_link", is_late=False)
    assert where.warning == ""
    where.place(S, "", is_late=False)
    assert "no frame_id" in where.warning
    given = locator((S, STEP), T_base_sensor=(0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    given.place(S, "lidar", is_late=False)
    assert given.warning == ""
    on_purpose = Locator(NodeConfig(), where.source, extrinsic_is_given=True)
    on_purpose.place(S, "lidar", is_late=False)
    assert on_purpose.warning == ""


def test_where_all_odometry_was_rejected_the_cloud_is_told_so() -> None:
    where = locator()
    for _ in range(3):
        where.source.reject("the stamp is 37.000 s in the future")
    with pytest.raises(PoseNotYetError, match=r"all 3 messages .* 37\.000 s in the future"):
        where.place(S, "lidar", is_late=True)
    where.source.hear(S, STEP, "odom", "base_link", 50.0)
    where.place(S, "lidar", is_late=True)
    assert where.source.rejection == ""


def test_a_place_has_the_covariance_of_the_odometry_at_the_sensor() -> None:
    Y = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
    numbers = (0.2, 0.0, 1.0, 0.0, 0.0, float(np.sin(0.25)), float(np.cos(0.25)))
    where = locator(T_base_sensor=numbers)
    where.source.hear(S, STEP, "odom", "base_link", 50.0, Y)
    X_ = se3.pose(numbers[:3], numbers[3:])
    found = where.place(S, "lidar", is_late=False).Y_odom
    np.testing.assert_allclose(to_left(X_, found), Y, atol=1e-15)
    where.source.hear(2 * S, STEP, "odom", "base_link", 50.0)
    where.source.clear()
    assert where.source.covariance(S) is None
