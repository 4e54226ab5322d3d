"""A map is cropped around the sensor and prepared once for as long as that will do."""

import numpy as np
import pytest

from cello3d_ros.config import CloudConfig, NodeConfig
from cello3d_ros.errors import NoOverlapError
from cello3d_ros.geometry import se3
from cello3d_ros.tracking.map import Map

PLAIN, NODE, NARROW = CloudConfig(), NodeConfig(), NodeConfig(reference_range_m=40.0)


@pytest.fixture
def ground() -> Map:
    """A square kilometre of ground far from the origin."""
    rng = np.random.default_rng(0)
    return Map(1, rng.uniform([4500, -500, 0], [5500, 500, 1], (200_000, 3)), "map")


def test_the_crop_is_a_ball_about_the_sensor_in_a_frame_of_its_own(ground) -> None:
    position = np.array([5000.0, 10.0, 2.0])
    cloud, T_map_crop = ground.around(position, NODE, PLAIN)
    np.testing.assert_array_equal(T_map_crop[:3, 3], position)
    assert np.linalg.norm(cloud.points, axis=1).max() <= 60.0
    inside = np.linalg.norm(ground.points - position, axis=1) <= 60.0
    assert len(cloud.points) == inside.sum()  # sparser than the density that is kept
    back = se3.transform(T_map_crop, cloud.points)
    np.testing.assert_allclose(
        np.sort(back, axis=0), np.sort(ground.points[inside], axis=0), atol=1e-9
    )


def test_it_is_kept_while_the_sensor_is_near_its_centre(ground) -> None:
    first, _ = ground.around(np.array([5000.0, 0.0, 0.0]), NODE, PLAIN)
    again, T = ground.around(np.array([5014.0, 0.0, 0.0]), NODE, PLAIN)
    assert again is first
    assert T[0, 3] == 5000.0
    moved, T = ground.around(np.array([5016.0, 0.0, 0.0]), NODE, PLAIN)
    assert moved is not first
    assert T[0, 3] == 5016.0


def test_other_settings_prepare_it_anew(ground) -> None:
    position = np.array([5000.0, 0.0, 0.0])
    first, _ = ground.around(position, NODE, PLAIN)
    assert ground.around(position, NARROW, PLAIN)[0] is not first
    coarse = CloudConfig(voxel_m=5.0, max_points_per_voxel=1)
    assert len(ground.around(position, NARROW, coarse)[0].points) < len(first.points)


def test_where_the_map_ends_there_is_no_overlap(ground) -> None:
    with pytest.raises(NoOverlapError, match="the reference cloud around the guess"):
        ground.around(np.zeros(3), NODE, PLAIN)
    ground.around(np.array([5000.0, 0.0, 0.0]), NODE, PLAIN)


def test_a_dense_map_is_thinned_to_a_bound_and_evenly() -> None:
    rng = np.random.default_rng(1)
    sparse = rng.uniform([-20, -20, 0], [0, 20, 0.1], (20_000, 3))
    dense = rng.uniform([0, -5, 0], [10, 5, 0.1], (400_000, 3))
    crowded = Map(1, np.vstack([sparse, dense]), "map")
    few, coarse = NodeConfig(max_reference_points=10_000), CloudConfig(voxel_m=0.2)
    points = crowded.around(np.zeros(3), few, coarse)[0].points
    assert 9_000 < len(points) <= 10_000
    assert (points[:, 0] > 0).sum() < 4 * (points[:, 0] < 0).sum()  # of 20 times as many
    again = Map(1, crowded.points, "map").around(np.zeros(3), few, coarse)[0].points
    np.testing.assert_array_equal(points, again)
