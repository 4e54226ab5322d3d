import numpy as np
import pytest
from scipy.spatial import cKDTree

from cello3d_ros.clouds.neighbors import any_within, build_tree, nearest, search

CASES = {
    "normal": lambda rng: rng.normal(size=(2000, 3)),
    "plane": lambda rng: rng.uniform(-5, 5, (2000, 3)) * [1, 1, 0],
    "line": lambda rng: rng.uniform(-5, 5, (500, 1)) * [1.0, 2.0, 3.0],
    "lattice full of ties": lambda rng: rng.integers(0, 6, (3000, 3)).astype(float),
    "all the same": lambda rng: np.ones((100, 3)),
    "fewer than a leaf": lambda rng: rng.normal(size=(5, 3)),
    "duplicates": lambda rng: np.repeat(rng.normal(size=(200, 3)), 30, axis=0),
    "clusters far apart": lambda rng: (
        np.repeat(1e5 * rng.normal(size=(20, 3)), 7, axis=0) + rng.normal(size=(140, 3))
    ),
    "rings of a lidar": lambda rng: np.stack(
        [
            (r := 3.0 * (1 + np.arange(3000) // 300)) * np.cos(a := 0.0209 * np.arange(3000)),
            r * np.sin(a),
            0 * a,
        ],
        axis=1,
    ),
    "far outliers": lambda rng: np.vstack([rng.normal(size=(900, 3)), 1e9 * np.eye(3)]),
    "a node and a point": lambda rng: rng.normal(size=(257, 3)),
    "a sphere": lambda rng: (
        (p := rng.normal(size=(2000, 3))) / np.linalg.norm(p, axis=1, keepdims=True)
    ),
    "one": lambda rng: rng.normal(size=(1, 3)),
    "far from the origin": lambda rng: rng.normal(size=(1000, 3)) + 1e6,
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("k", [1, 3, 20])
def test_neighbors_are_those_of_an_independent_tree(case, k):
    rng = np.random.default_rng(7)
    points = CASES[case](rng)
    queries = np.vstack([points[:200], points.mean(axis=0) + 3 * rng.normal(size=(300, 3))])
    queries[-1] += 1e7
    tree = build_tree(points)
    assert sorted(tree.order) == list(range(len(points)))
    np.testing.assert_array_equal(tree.points, points[tree.order])
    distances2, indices = nearest(tree, queries, k)
    expected = cKDTree(points).query(queries, k=[*range(1, k + 1)])[0]
    np.testing.assert_allclose(np.sqrt(distances2), expected, rtol=1e-12)
    found = indices >= 0
    assert (found.sum(axis=1) == min(k, len(points))).all()
    to_found = np.linalg.norm(queries[:, None] - tree.points[indices], axis=2)
    np.testing.assert_allclose(to_found[found], np.sqrt(distances2[found]), rtol=1e-12)
    assert all(len(set(row[row >= 0])) == (row >= 0).sum() for row in indices)


@pytest.mark.parametrize("case", CASES)
def test_of_equally_far_points_the_first_in_order_wins(case):
    rng = np.random.default_rng(9)
    tree = build_tree(CASES[case](rng)[:1000])
    queries = tree.points[:: max(1, len(tree.points) // 100)]
    difference = tree.points - queries[:, None]
    squares = difference[..., 0] ** 2 + difference[..., 1] ** 2 + difference[..., 2] ** 2
    expected = np.argsort(squares, axis=1, kind="stable")[:, :7]
    _, indices = nearest(tree, queries, 7)
    np.testing.assert_array_equal(indices[:, : expected.shape[1]], expected)
    np.testing.assert_array_equal(indices[:, expected.shape[1] :], -1)


def test_neighbors_beyond_the_largest_distance_are_left_out():
    rng = np.random.default_rng(10)
    tree = build_tree(rng.normal(size=(2000, 3)))
    queries = 2 * rng.normal(size=(500, 3))
    every2, indices = nearest(tree, queries, 4)
    near2, near = nearest(tree, queries, 4, max_distance2=0.09)
    np.testing.assert_array_equal(near2, np.where(every2 <= 0.09, every2, np.inf))
    np.testing.assert_array_equal(near, np.where(every2 <= 0.09, indices, -1))


@pytest.mark.parametrize("max2", [np.inf, 0.09, 0.0])
def test_the_search_counts_what_it_finds(max2):
    rng = np.random.default_rng(12)
    tree = build_tree(rng.normal(size=(2000, 3)))
    queries = np.vstack([tree.points[:40], rng.normal(size=(60, 3))])
    distances2, indices = np.empty((100, 3)), np.empty((100, 3), np.int64)
    n_found = search(tree.leaves, queries, max2, distances2, indices)
    assert n_found == (indices >= 0).sum() == np.isfinite(distances2).sum() >= 40


@pytest.mark.parametrize("scale", [1e-120, 1e-30, 1e30, 1e140])
def test_the_search_does_not_depend_on_the_unit_of_length(scale):
    rng = np.random.default_rng(28)
    points, queries = rng.normal(size=(700, 3)), rng.normal(size=(90, 3))
    plain, scaled = build_tree(points), build_tree(scale * points)
    one, other = nearest(plain, queries, 3), nearest(scaled, scale * queries, 3)
    np.testing.assert_array_equal(plain.order[one[1]], scaled.order[other[1]])
    np.testing.assert_allclose(np.sqrt(other[0]), scale * np.sqrt(one[0]), rtol=1e-12)


def test_a_tree_has_the_same_order_whatever_the_number_of_threads():
    points = np.random.default_rng(11).normal(size=(20000, 3)) * [5, 3, 0.1]
    one, four = build_tree(points), build_tree(points, n_threads=4)
    for a, b in zip(one, four):
        np.testing.assert_array_equal(a, b)


def test_points_too_far_apart_for_a_squared_distance_are_no_neighbors():
    tree = build_tree(np.array([[0.0, 0.0, 0.0], [1e200, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    distances2, indices = nearest(tree, np.array([[1.0, 0.0, 0.0]]), 3)
    np.testing.assert_array_equal(distances2[0, :2], [1.0, 4.0])
    assert indices[0, 2] == -1


def test_many_queries_in_threads_are_answered_as_one_by_one():
    rng = np.random.default_rng(8)
    tree = build_tree(rng.normal(size=(3000, 3)))
    queries = rng.normal(size=(10000, 3))
    together = nearest(tree, queries, 3, n_threads=3)
    apart = [nearest(tree, queries[part], 3) for part in (slice(0, 17), slice(17, None))]
    np.testing.assert_array_equal(together[0], np.vstack([a[0] for a in apart]))
    np.testing.assert_array_equal(together[1], np.vstack([a[1] for a in apart]))


def test_within_means_at_most_the_radius():
    tree = build_tree(np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    queries = np.array([[0.5, 0.0, 0.0], [0.5000001, 0.0, 0.0], [10.0, 0.3, 0.4], [5.0, 0.0, 0.0]])
    np.testing.assert_array_equal(any_within(tree, queries, 0.5), [True, False, True, False])


def test_a_tree_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one point"):
        build_tree(np.empty((0, 3)))
