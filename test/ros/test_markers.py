"""Ellipsoids and arrows against the covariances that they show."""

import numpy as np
import pytest
from robot import ellipsoid_of

from cello3d_ros.geometry import se3
from cello3d_ros.ros import markers
from cello3d_ros.ros.messages import pose_with_covariance

T = se3.exp([1.0, -2.0, 0.5, 0.4, -0.5, 1.6])


def covariance(seed: int, sigma: float = 1e-2) -> np.ndarray:
    A = sigma * np.random.default_rng(seed).normal(size=(6, 6))
    return A @ A.T


def shown(C_step, C_chain=None, **settings):
    C_chain = C_step if C_chain is None else C_chain
    pose = pose_with_covariance(7, "odom", T, C_chain)
    array = markers.markers_to(pose, C_step, **{"number": 0, **settings})
    return {marker.ns: marker for marker in array.markers}


@pytest.mark.parametrize("scale", [1.0, 20.0])
@pytest.mark.parametrize("seed", range(4))
def test_ellipsoids_are_three_sigma_at_the_pose(seed: int, scale: float) -> None:
    C, C_chain = covariance(seed), covariance(seed + 10)
    found = shown(C, C_chain, scale=scale)
    for name, expected in (
        ("translation", C[:3, :3]),
        ("rotation", markers.RADIAN_M**2 * C[3:, 3:]),
        ("chain", C_chain[:3, :3]),
    ):
        centre, A = ellipsoid_of(found[name])
        np.testing.assert_allclose(centre, T[:3, 3], atol=1e-12)
        np.testing.assert_allclose(A @ A.T, 9.0 * scale**2 * expected, rtol=1e-6, atol=1e-9)


def test_the_arrow_ends_where_the_translation_is_known_least() -> None:
    C = covariance(1)
    start, end = (np.array([p.x, p.y, p.z]) for p in shown(C)["weakest"].points)
    values, vectors = np.linalg.eigh(C[:3, :3])
    np.testing.assert_allclose(start, T[:3, 3], atol=1e-12)
    assert np.linalg.norm(end - start) == pytest.approx(3.0 * np.sqrt(values[-1]))
    assert abs((end - start) @ vectors[:, -1]) == pytest.approx(np.linalg.norm(end - start))


def test_the_arrow_does_not_flip_between_like_answers() -> None:
    rng = np.random.default_rng(0)
    base = np.diag([1e-2, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    directions = []
    for _ in range(20):
        E = 1e-4 * rng.normal(size=(6, 6))
        start, end = shown(base + E @ E.T)["weakest"].points
        directions.append(end.x - start.x)
    assert (np.array(directions) > 0).all()


def test_no_more_markers_than_the_trail_is_long() -> None:
    keys = set()
    for number in range(3 * markers.N_TRAIL):
        pose = pose_with_covariance(number, "odom", T, np.eye(6))
        array = markers.markers_to(pose, np.eye(6), number=number, lifetime_s=2.5)
        keys |= {(marker.ns, marker.id) for marker in array.markers}
        assert all(
            m.lifetime.sec == 2 and m.lifetime.nanosec == 500_000_000 for m in array.markers
        )
    assert len(keys) == 4 * markers.N_TRAIL


def test_a_flat_ellipsoid_keeps_a_thickness() -> None:
    C = np.diag([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
    for marker in shown(C).values():
        assert min(marker.scale.x, marker.scale.y, marker.scale.z) > 0.0


def test_colours_follow_the_level() -> None:
    colours = [shown(np.eye(6), level=level)["translation"].color for level in range(3)]
    assert [c.g > c.r for c in colours] == [True, False, False]
    assert colours[1].g > colours[2].g
