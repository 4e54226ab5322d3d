"""Transforms between named frames, and answers moved from the sensor to the base."""

from types import SimpleNamespace as Message

import numpy as np
import pytest

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.transforms import TransformTree, UnknownFrameError, seen_from_base

S = 10**9
MAST = se3.exp([0.1, 0.2, 1.5, 0.0, 0.1, 0.4])
HEAD = se3.exp([0.0, 0.1, 0.3, 0.2, 0.0, -0.3])


def transforms(*items: tuple[int, str, str, np.ndarray]) -> Message:
    """A TFMessage."""
    return Message(transforms=[_transform(*item) for item in items])


def _transform(stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Message:
    p, q = T[:3, 3], se3.quaternion(T)
    return Message(
        header=Message(
            stamp=Message(sec=stamp_ns // S, nanosec=stamp_ns % S),
            frame_id=parent,
        ),
        child_frame_id=child,
        transform=Message(
            translation=Message(x=p[0], y=p[1], z=p[2]),
            rotation=Message(x=q[0], y=q[1], z=q[2], w=q[3]),
        ),
    )


@pytest.fixture
def tree() -> TransformTree:
    """base_link -> mast (static) -> lidar (static), and base_link -> arm (moving)."""
    buffer = TransformTree(1.0, 10.0)
    buffer.add(transforms((0, "base_link", "mast", MAST), (0, "mast", "lidar", HEAD)), True)
    for k in range(3):
        arm = se3.exp([0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.2 * k])
        buffer.add(transforms((k * S, "/base_link", "arm", arm)), False)
    return buffer


def test_static_transforms_compose_at_any_time_and_in_both_directions(tree) -> None:
    for stamp_ns in (0, 10**18):
        np.testing.assert_allclose(tree.at("base_link", "lidar", stamp_ns), MAST @ HEAD)
        np.testing.assert_allclose(
            tree.at("lidar", "base_link", stamp_ns), se3.inverse(MAST @ HEAD), atol=1e-12
        )
    np.testing.assert_array_equal(tree.at("lidar", "lidar", 0), np.eye(4))


def test_moving_transforms_are_taken_at_the_stamp(tree) -> None:
    expected = se3.inverse(MAST @ HEAD) @ se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.2])
    np.testing.assert_allclose(tree.at("lidar", "arm", S), expected, atol=1e-12)
    halfway = tree.at("base_link", "arm", S + S // 2)
    np.testing.assert_allclose(se3.log(halfway)[5], 0.3, atol=1e-12)


@pytest.mark.parametrize(
    ("parent", "child", "stamp_ns", "sentence"),
    [
        ("base_link", "camera", 0, "no transforms connect 'base_link' and 'camera'"),
        ("base_link", "arm", 3 * S, "is 1.000 s older"),
        ("base_link", "arm", -S, "is 1.000 s newer"),
    ],
)
def test_an_unknown_transform_is_an_error_and_never_the_identity(
    tree, parent, child, stamp_ns, sentence
) -> None:
    with pytest.raises(UnknownFrameError, match=sentence):
        tree.at(parent, child, stamp_ns)


def test_a_transform_that_comes_later_connects(tree) -> None:
    with pytest.raises(UnknownFrameError):
        tree.at("base_link", "camera", 0)
    tree.add(transforms((0, "lidar", "camera", HEAD)), True)
    np.testing.assert_allclose(tree.at("base_link", "camera", 0), MAST @ HEAD @ HEAD)


def test_a_frame_has_one_parent_the_last(tree) -> None:
    tree.add(transforms((0, "base_link", "lidar", HEAD)), True)
    np.testing.assert_allclose(tree.at("base_link", "lidar", 0), HEAD)
    with pytest.raises(UnknownFrameError):
        TransformTree(1.0, 1.0).at("mast", "lidar", 0)


def test_clear_forgets_what_moves_and_keeps_what_does_not(tree) -> None:
    tree.clear()
    np.testing.assert_allclose(tree.at("base_link", "lidar", 0), MAST @ HEAD)
    with pytest.raises(UnknownFrameError):
        tree.at("base_link", "arm", S)
    tree.add(transforms((0, "base_link", "arm", MAST)), False)  # time starts anew
    np.testing.assert_allclose(tree.at("base_link", "arm", 0), MAST)


def test_damaged_transforms_are_rejected_by_name_and_change_nothing(tree) -> None:
    bad = _transform(0, "mast", "lidar", HEAD)
    bad.transform.translation.x = float("nan")
    message = Message(transforms=[bad, _transform(0, "lidar", "lidar", HEAD)])
    rejected = tree.add(message, True)
    assert len(rejected) == 2
    assert "from 'mast' to 'lidar' rejected: the pose is not finite" in rejected[0]
    assert "its own parent" in rejected[1]
    np.testing.assert_allclose(tree.at("base_link", "lidar", 0), MAST @ HEAD)


def test_the_same_transform_twice_is_no_fault(tree) -> None:
    message = transforms((3 * S, "base_link", "arm", MAST))
    assert tree.add(message, False) == []
    assert tree.add(message, False) == []


def test_transforms_that_never_change_are_constant_wherever_they_come_from(tree) -> None:
    np.testing.assert_allclose(tree.constant("base_link", "lidar"), MAST @ HEAD)
    for k in range(3):  # repeated on /tf, as ROS 1 did
        tree.add(transforms((k * S, "lidar", "camera", HEAD)), False)
    np.testing.assert_allclose(tree.constant("base_link", "camera"), MAST @ HEAD @ HEAD)
    assert tree.constant("base_link", "arm") is None
    assert tree.constant("base_link", "nowhere") is None


def test_a_transform_that_comes_late_is_sorted_in(tree) -> None:
    assert tree.add(transforms((S // 2, "base_link", "arm", MAST)), False) == []
    np.testing.assert_allclose(tree.at("base_link", "arm", S // 2), MAST)


def test_covariance_at_the_base_is_that_of_sampled_base_poses() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.repeat([0.02, 0.01], 3)[:, None]
    T, Y = se3.exp([1.0, 0.3, 0.1, 0.05, -0.1, 0.4]), A @ A.T
    X_ref = se3.exp([0.5, 0.1, 2.0, 0.0, 0.3, 1.2])
    X_read = se3.exp([0.6, 0.0, 2.0, 0.0, 0.2, 1.0])
    base = seen_from_base(T, Y, X_ref, X_read)
    xi = rng.multivariate_normal(np.zeros(6), Y, 200_000)
    poses = X_ref @ (T @ se3.exp(xi)) @ se3.inverse(X_read)
    sampled = sampled_covariance(se3.log(se3.inverse(base.T) @ poses))
    sigma = np.sqrt(np.diag(base.Y))
    assert (np.abs(sampled - base.Y) < 0.01 * np.outer(sigma, sigma)).all()
    turned = np.kron(np.eye(2), X_read[:3, :3])  # a rotation alone leaves the lever arm out
    assert np.abs(turned @ Y @ turned.T - base.Y).max() > 0.2 * sigma.max() ** 2
