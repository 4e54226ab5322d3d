import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cello3d_ros.clouds.neighbors import build_tree
from cello3d_ros.clouds.shape import local_shape, prepare
from cello3d_ros.config import CloudConfig
from cello3d_ros.errors import CloudError


def oracle(points, k):
    """The same quantities by scipy and LAPACK."""
    _, indices = cKDTree(points).query(points, k=k)
    near = points[indices] - points[indices].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / k)
    s3, s2, s1 = np.sqrt(np.maximum(values, 0)).T
    return vectors[:, :, 0], (s2 - s3) / s1, (s1 - s2) / s1


def test_local_shape_is_that_of_an_independent_computation(room):
    tree = build_tree(room[0])
    normals, planarity, cylindricality = local_shape(tree, 20)
    expected_normals, expected_planarity, expected_cylindricality = oracle(tree.points, 20)
    np.testing.assert_allclose(planarity, expected_planarity, atol=1e-9)
    np.testing.assert_allclose(cylindricality, expected_cylindricality, atol=1e-9)
    agreement = np.abs(np.einsum("ij,ij->i", normals, expected_normals))
    assert (agreement > 1 - 1e-9).mean() > 0.999  # corners may have no single normal
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("scales", "linear", "planar"), [((1, 0, 0), 1, 0), ((1, 1, 0), 0, 1), ((1, 1, 1), 0, 0)]
)
def test_a_line_a_plane_and_a_ball_have_the_ideal_features(scales, linear, planar):
    directions = np.vstack([np.eye(3), -np.eye(3)]) * scales
    turned = directions @ Rotation.from_rotvec([0.3, -0.7, 0.2]).as_matrix()
    _, planarity, cylindricality = local_shape(build_tree(turned), 6)
    np.testing.assert_allclose(cylindricality, linear, atol=1e-6)
    np.testing.assert_allclose(planarity, planar, atol=1e-6)


def test_points_that_coincide_have_no_shape_and_no_nan():
    normals, planarity, cylindricality = local_shape(build_tree(np.ones((30, 3))), 20)
    np.testing.assert_array_equal(planarity, 0.0)
    np.testing.assert_array_equal(cylindricality, 0.0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_normals_turn_with_the_cloud(room):
    R = Rotation.from_rotvec([0.2, 0.5, -1.0]).as_matrix()
    points = room[0][:3000]
    tree = build_tree(points)
    turned = build_tree(points @ R.T)
    normals, planarity, _ = local_shape(tree, 20)
    turned_normals, turned_planarity, _ = local_shape(turned, 20)
    back, turned_back = np.argsort(tree.order), np.argsort(turned.order)
    np.testing.assert_allclose(planarity[back], turned_planarity[turned_back], atol=1e-9)
    cosines = np.einsum("ij,ij->i", normals[back] @ R.T, turned_normals[turned_back])
    assert (np.abs(cosines) > 1 - 1e-9).mean() > 0.999


def test_prepare_filters_and_follows_its_seed(room):
    config = CloudConfig(min_range_m=1.0, max_range_m=4.0)
    cloud = prepare(room[0], config, np.random.default_rng(5))
    distances = np.linalg.norm(cloud.points, axis=1)
    assert distances.min() >= 1.0
    assert distances.max() <= 4.0
    again = prepare(room[0], config, np.random.default_rng(5))
    for a, b in zip(cloud[:4], again[:4]):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(cloud.tree.points, cloud.points)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((3, 3)), np.full((500, 3), 1e3)])
def test_too_few_points_after_the_filters_are_an_error(points):
    with pytest.raises(CloudError, match="points are left between"):
        prepare(points, CloudConfig(), np.random.default_rng(0))
