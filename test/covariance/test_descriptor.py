import numpy as np
import pytest

from cello3d_ros.clouds.neighbors import build_tree
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import GridConfig
from cello3d_ros.covariance.descriptor import (
    BINS,
    N_CELL,
    describe_clouds,
    n_features,
)
from cello3d_ros.geometry.se3 import exp, inverse, transform

GRID = GridConfig()
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def described(points, normals, planarity, cylindricality, grid):
    """Return the descriptor of points that all overlap; the tree is not looked at."""
    tree = build_tree(np.zeros((1, 3)))
    cloud = Cloud(points, normals, planarity, cylindricality, tree)
    return describe_clouds([cloud], [np.ones(len(points), bool)], [np.eye(4)], grid)


@pytest.fixture
def overlap():
    rng = np.random.default_rng(21)
    points = rng.uniform([-14, -14, -6], [14, 14, 6], (4000, 3))
    points = points[(points[:, 0] < 3) | (points[:, 1] > 0)]  # leaves cells empty
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals, rng.uniform(size=len(points)), rng.uniform(size=len(points))


def test_the_papers_grid_gives_704_values(overlap):
    assert n_features(GRID) == 704
    assert described(*overlap, GRID).shape == (704,)


def test_each_cell_says_what_a_loop_over_its_points_says(overlap):
    points, normals, planarity, cylindricality = overlap
    d = described(*overlap, GRID).reshape(4, 4, 4, N_CELL)
    for place in np.ndindex(4, 4, 4):
        low = np.array([-12.5, -12.5, -5.0]) + np.array(place) * [6.25, 6.25, 2.5]
        inside = ((points >= low) & (points < low + [6.25, 6.25, 2.5])).all(axis=1)
        if not inside.any():
            np.testing.assert_array_equal(d[place], 0.0)
            continue
        assert d[place][0] == pytest.approx(planarity[inside].mean())
        assert d[place][1] == pytest.approx(cylindricality[inside].mean())
        angles = np.arccos(np.clip(np.abs(normals[inside] @ BINS.T), 0, 1))
        shares = np.bincount(angles.argmin(axis=1), minlength=9) / inside.sum()
        np.testing.assert_allclose(d[place][2:], shares)
        assert d[place][2:].sum() == pytest.approx(1.0)


def test_a_normal_and_its_opposite_are_the_same(overlap):
    points, normals, planarity, cylindricality = overlap
    flipped = described(points, -normals, planarity, cylindricality, GRID)
    np.testing.assert_array_equal(flipped, described(*overlap, GRID))


def test_a_quarter_turn_permutes_cells_and_bins(overlap):
    points, normals, planarity, cylindricality = overlap
    turned = described(
        points @ QUARTER.T, normals @ QUARTER.T, planarity, cylindricality, GRID
    ).reshape(4, 4, 4, N_CELL)
    plain = described(*overlap, GRID).reshape(4, 4, 4, N_CELL)
    moved = np.rot90(plain, axes=(0, 1))  # x -> y
    # x <-> y; (1,1,0) <-> (-1,1,0); the diagonals follow each other round
    bins = [1, 0, 3, 2, 4, 7, 5, 8, 6]
    expected = np.concatenate([moved[..., :2], moved[..., 2:][..., bins]], axis=-1)
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_the_bins_follow_a_quarter_turn_as_the_permutation_says():
    bins = [1, 0, 3, 2, 4, 7, 5, 8, 6]
    turned = np.abs((BINS @ QUARTER.T) @ BINS.T).argmax(axis=1)
    assert [int(np.flatnonzero(turned == b)[0]) for b in range(9)] == bins


def test_cells_are_half_open_and_outside_is_ignored():
    up = np.array([[0.0, 0.0, 1.0]])
    one = np.ones(1)

    def cells(point):
        d = described(np.array([point]), up, one, one, GRID).reshape(4, 4, 4, N_CELL)
        return np.argwhere(d[..., 0] > 0).tolist()

    assert cells([0.0, 0.0, 0.0]) == [[2, 2, 2]]
    assert cells([-1e-9, 0.0, 0.0]) == [[1, 2, 2]]
    assert cells([-12.5, -12.5, -5.0]) == [[0, 0, 0]]
    assert cells([12.5, 0.0, 0.0]) == []
    assert cells([0.0, 0.0, 5.0]) == []


def test_no_points_give_zeros():
    empty = np.empty((0, 3))
    np.testing.assert_array_equal(
        described(empty, empty, np.empty(0), np.empty(0), GRID), np.zeros(704)
    )


def test_clouds_are_described_by_their_overlapping_points_in_one_frame(overlap):
    points, normals, planarity, cylindricality = overlap
    rng = np.random.default_rng(22)
    first, seen = rng.uniform(size=len(points)) < 0.4, rng.uniform(size=len(points)) < 0.7
    T = exp([3.0, -1.0, 0.5, 0.2, -0.1, 2.0])
    back = inverse(T)
    tree = build_tree(points)  # not looked at
    one = Cloud(points[first], normals[first], planarity[first], cylindricality[first], tree)
    other = Cloud(
        transform(back, points[~first]),
        normals[~first] @ back[:3, :3].T,
        planarity[~first],
        cylindricality[~first],
        tree,
    )
    d = describe_clouds((one, other), (seen[first], seen[~first]), (np.eye(4), T), GRID)
    expected = described(*(values[seen] for values in overlap), GRID)
    np.testing.assert_allclose(d, expected, atol=1e-12)
