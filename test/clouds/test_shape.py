import numpy as np
import pytest
from rings import scan, to_box, to_plane
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cello3d_ros.clouds.covariances import covariances
from cello3d_ros.clouds.neighbors import build_tree
from cello3d_ros.clouds.shape import _shape, local_shape, prepare
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


CASES = {
    "normal": lambda rng: rng.normal(size=(1500, 3)),
    "plane": lambda rng: rng.uniform(-5, 5, (1500, 3)) * [1, 1, 0],
    "line": lambda rng: rng.uniform(-5, 5, (500, 1)) * [1.0, 2.0, 3.0],
    "lattice full of ties": lambda rng: rng.integers(0, 9, (3000, 3)).astype(float),
    "plane lattice": lambda rng: np.stack(
        np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), axis=-1
    ).reshape(-1, 3),
    "duplicates": lambda rng: np.repeat(rng.normal(size=(200, 3)), 7, axis=0),
    "far from the origin": lambda rng: rng.normal(size=(1000, 3)) + 1e6,
    "fewer than the neighbors": lambda rng: rng.normal(size=(11, 3)),
    "two scales": lambda rng: np.vstack(
        [1e-4 * rng.normal(size=(500, 3)), 1e4 * rng.normal(size=(500, 3))]
    ),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("k", [1, 6, 20])
def test_covariances_are_of_the_nearest_and_of_equally_far_ones_of_the_first(case, k):
    tree = build_tree(CASES[case](np.random.default_rng(12)))
    points = tree.points
    n, n_leaves = len(points), len(tree.lanes)
    found = np.empty((n_leaves, 6, 16))
    covariances(tree.leaves, n, k, 0, n_leaves, np.ones(n, np.bool_), found)
    difference = points - points[:, None]
    squares = difference[..., 0] ** 2 + difference[..., 1] ** 2 + difference[..., 2] ** 2
    first = np.argsort(squares, axis=1, kind="stable")[:, :k]
    near = np.take_along_axis(difference, first[..., None], axis=1)
    near = near - near.mean(axis=1, keepdims=True)
    expected = np.einsum("nki,nkj->nij", near, near) / min(k, n)
    upper = expected[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    scale = np.take_along_axis(squares, first[:, -1:], axis=1) + 1e-300
    ours = found.transpose(0, 2, 1).reshape(-1, 6)
    np.testing.assert_allclose(ours[:n] / scale, upper / scale, atol=1e-13)
    np.testing.assert_array_equal(ours[n:], 0.0)


def test_local_shape_does_not_depend_on_the_number_of_threads():
    tree = build_tree(np.random.default_rng(13).normal(size=(9000, 3)) * [9, 9, 0.1])
    for a, b in zip(local_shape(tree, 20), local_shape(tree, 20, n_threads=3)):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("ratios", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (3, 2, 1)])
@pytest.mark.parametrize("noise", [0.0, 1e-9, 1e-3])
def test_shapes_are_those_of_the_eigenvalues(scale, ratios, noise):
    rng = np.random.default_rng(14)
    A = rng.normal(size=(48, 3, 3))
    turns = np.linalg.qr(A)[0]
    turns[:6] = np.eye(3)[[[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]]]
    squares = scale * (np.square(ratios) + noise * rng.uniform(size=(48, 3)))
    C = np.einsum("nij,nj,nkj->nik", turns, squares, turns)
    rows = C[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].reshape(3, 16, 6).transpose(0, 2, 1)
    normals, planarity, cylindricality = np.empty((45, 3)), np.empty(45), np.empty(45)
    every = np.ones(45, np.bool_)
    _shape(np.ascontiguousarray(rows), every, normals, planarity, cylindricality)
    values = np.linalg.eigvalsh(C)[:45]
    s3, s2, s1 = np.sqrt(np.maximum(values, 0.0)).T
    # s3 of a flat one is the square root of what rounding left
    s1 = np.where(s1 > 0.0, s1, 1.0)
    np.testing.assert_allclose(planarity, (s2 - s3) / s1, atol=1e-7)
    np.testing.assert_allclose(cylindricality, (s1 - s2) / s1 * (values[:, 2] > 0), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    along = np.einsum("ni,nij,nj->n", normals, C[:45], normals)
    np.testing.assert_allclose(along, values[:, 0], atol=1e-14 * scale)


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


def tilts_deg(normals):
    """Angles of the normals that there are from the vertical."""
    planes = np.abs(normals).sum(axis=1) > 0
    return np.degrees(np.arccos(np.minimum(np.abs(normals[planes, 2]), 1.0)))


@pytest.mark.parametrize("n_beams", [16, 32])
def test_rings_on_flat_ground_are_flat_or_no_plane(n_beams):
    points = scan(to_plane(2, -1.5), np.eye(4), n_beams)
    ring, _, _ = local_shape(build_tree(points), 20)
    assert np.quantile(tilts_deg(ring), 0.5) > 2.0  # they lean by the beams' elevations
    normals, _, cylindricality = local_shape(build_tree(points), 20, min_spread=0.25)
    planes = np.abs(normals).sum(axis=1) > 0
    assert planes.mean() > 0.2
    assert np.quantile(tilts_deg(normals), 0.95) < 2.0
    np.testing.assert_array_equal(planes, cylindricality <= 0.75)
    np.testing.assert_allclose(np.linalg.norm(normals[planes], axis=1), 1.0)


def test_only_points_on_a_line_get_a_wider_neighborhood():
    tree = build_tree(scan(to_box(8.0, 5.0, 2.0), np.eye(4), 32))
    plain, law = local_shape(tree, 20), local_shape(tree, 20, n_threads=2, min_spread=0.25)
    spread = plain[2] <= 0.75
    assert 0.2 < spread.mean() < 0.99
    for a, b in zip(plain, law):
        np.testing.assert_array_equal(a[spread], b[spread])
    wide = local_shape(tree, 40)
    second = ~spread & (wide[2] <= 0.75)
    assert second.any()
    for a, b in zip(wide, law):
        np.testing.assert_array_equal(a[second], b[second])
    line = np.linspace(0.0, 5.0, 200)[:, None] * [1.0, 2.0, 0.5]
    np.testing.assert_array_equal(local_shape(build_tree(line), 20, min_spread=0.25)[0], 0.0)


def test_prepare_filters_and_follows_its_seed(room):
    config = CloudConfig(min_range_m=1.0, max_range_m=4.0)
    cloud = prepare(room[0], config, np.random.default_rng(5))
    distances = np.linalg.norm(cloud.points, axis=1)
    assert distances.min() >= 1.0
    assert distances.max() <= 4.0
    again = prepare(room[0], config, np.random.default_rng(5), n_threads=2)
    for a, b in zip(cloud[:4], again[:4]):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(cloud.tree.points, cloud.points)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((3, 3)), np.full((500, 3), 1e3)])
def test_too_few_points_after_the_filters_are_an_error(points):
    with pytest.raises(CloudError, match="points are left between"):
        prepare(points, CloudConfig(), np.random.default_rng(0))
