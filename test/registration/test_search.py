"""The search of ICP against every distance computed, on input that makes searches fail."""

import numpy as np
import pytest

from cello3d_ros.clouds.leaves import build_leaves, tree_order
from cello3d_ros.registration.candidates import Places, make_candidates, make_room, nearest
from cello3d_ros.registration.icp import _of_rank
from cello3d_ros.registration.search import build_tree, search

_PLANE = np.array([1.0, 1.0, 0.0])
CASES = {
    "normal": lambda rng: rng.normal(size=(5000, 3)),
    "plane": lambda rng: rng.uniform(-5, 5, (2000, 3)) * _PLANE,
    "line": lambda rng: rng.uniform(-5, 5, (500, 1)) * [1.0, 2.0, 3.0],
    "lattice full of ties": lambda rng: rng.integers(0, 6, (3000, 3)).astype(float),
    "duplicates": lambda rng: np.repeat(rng.normal(size=(100, 3)), 9, axis=0),
    "all the same": lambda rng: np.ones((300, 3)),
    "far outliers": lambda rng: np.vstack([rng.normal(size=(900, 3)), 1e9 * np.eye(3)]),
    "far from the origin": lambda rng: rng.normal(size=(1000, 3)) + 1e6,
    "one leaf": lambda rng: rng.normal(size=(16, 3)),
    "one leaf and a point": lambda rng: rng.normal(size=(17, 3)),
    "one node and a point": lambda rng: rng.normal(size=(257, 3)),
    "fewer than k": lambda rng: rng.normal(size=(2, 3)),
}


def plain(points, queries, k, cap2):
    """Sort all distances, equal ones by index: squared distances and indices, infinite and -1."""
    difference = points - queries[:, None]
    d2 = difference[..., 0] ** 2 + difference[..., 1] ** 2 + difference[..., 2] ** 2
    order = np.argsort(d2, axis=1, kind="stable")[:, :k]
    distances2 = np.full((len(queries), k), np.inf)
    indices = np.full((len(queries), k), -1)
    distances2[:, : order.shape[1]] = np.take_along_axis(d2, order, axis=1)
    indices[:, : order.shape[1]] = order
    far = ~(distances2 <= cap2)
    distances2[far], indices[far] = np.inf, -1
    return distances2, indices


def assert_tree_is_exact(points, queries, k, caps, move):
    tree = build_tree(points)
    distances2, indices = np.full((len(queries), k), np.inf), np.full((len(queries), k), -1)
    for cap2 in caps:  # with the last neighbours as bounds
        n_found = search(queries, tree, cap2, distances2, indices)
        expected2, expected = plain(points, queries, k, cap2)
        np.testing.assert_array_equal(np.where(indices < 0, -1, tree.order[indices]), expected)
        np.testing.assert_array_equal(distances2, expected2)
        assert n_found == (expected >= 0).sum()
        queries = move(queries)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("k", [1, 3, 5, 20])
def test_the_search_finds_what_sorting_all_distances_finds(case, k):
    rng = np.random.default_rng(21)
    points = CASES[case](rng)
    queries = np.vstack([points[:200], points.mean(axis=0) + 2 * rng.normal(size=(101, 3))])
    queries[7] += 1e7
    queries[8] = 1e9, -1e25, 3.0  # beyond float32 once it is squared
    caps = (np.inf, np.inf, 0.5, 0.05, 0.0)
    assert_tree_is_exact(points, queries, k, caps, lambda q: q + 0.05 * rng.normal(size=3))
    assert_tree_is_exact(points, points[:301], k, (np.inf, 0.0), lambda q: q)


@pytest.mark.parametrize("scale", [1e-120, 1e-30, 1.0, 1e30, 1e140])
def test_the_search_does_not_depend_on_the_unit_of_length(scale):
    rng = np.random.default_rng(28)
    points, queries = scale * rng.normal(size=(700, 3)), scale * rng.normal(size=(90, 3))
    assert_tree_is_exact(points, queries, 3, (np.inf, 0.5 * scale * scale), lambda q: q)


def test_of_equally_far_points_the_first_given_wins():
    rng = np.random.default_rng(24)
    given = rng.integers(0, 4, (500, 3)).astype(float)
    leaves = build_tree(given)
    queries = rng.integers(0, 4, (100, 3)) + rng.choice([0.0, 0.5], (100, 3))
    distances2, indices = np.empty((100, 3)), np.full((100, 3), -1)
    search(queries, leaves, np.inf, distances2, indices)
    np.testing.assert_array_equal(leaves.order[indices], plain(given, queries, 3, np.inf)[1])


def assert_candidates_are_exact(points, queries, k, caps, rng, **room):
    candidates = make_candidates(points, k, **room)
    index = Places(candidates, np.zeros(len(queries), np.int32))
    distances2, indices = np.empty((len(queries), k)), np.empty((len(queries), k), np.int64)
    for cap2 in caps:
        n_found = nearest(queries, index, cap2, distances2, indices)
        expected2, expected = plain(points, queries, k, cap2)
        np.testing.assert_array_equal(indices, expected)
        np.testing.assert_array_equal(distances2, expected2)
        assert n_found == (expected >= 0).sum()
        queries = queries + 0.02 * rng.normal(size=3) * (cap2 < np.inf)
    return candidates


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("k", [1, 3, 5])
def test_candidates_are_what_sorting_all_distances_finds(case, k):
    rng = np.random.default_rng(25)
    points = CASES[case](rng)
    points = points - points.mean(axis=0)
    queries = np.vstack(
        [
            points[:200],  # on points
            0.5 * (points[:50] + points[-50:][::-1]) if len(points) > 50 else points,
            2 * rng.normal(size=(200, 3)),
            np.round(4 * rng.normal(size=(100, 3))) / 4,  # on borders of cubes
            [[0.0, 0.0, 0.0], [1e7, 0.0, 0.0], [-1e11, 1e11, 3.0]],  # outside of all cubes
        ]
    )
    assert_candidates_are_exact(points, queries, k, (np.inf, 0.5, 0.05, 0.0), rng)


def test_both_are_exact_where_float32_cannot_tell():
    """Points on a sphere, radii equal but for what double precision holds, hence many leaves."""
    rng = np.random.default_rng(26)
    points = rng.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[::7] += 1e-12 * rng.normal(size=points[::7].shape)
    ring = np.c_[np.cos(np.arange(40.0)), np.sin(np.arange(40.0)), np.zeros(40)]
    points = np.vstack([points * (1.0 + 1e-9 * rng.random((3000, 1))), 0.05 * ring])
    queries = np.vstack([1e-6 * rng.normal(size=(100, 3)), 0.05 * rng.normal(size=(200, 3))])
    assert_candidates_are_exact(points, queries, 3, (np.inf, 1.1), rng)
    assert_tree_is_exact(points, queries, 3, (np.inf, 1.1), lambda q: q + 1e-7)


def test_candidates_are_exact_when_room_is_short_and_start_over():
    rng = np.random.default_rng(27)
    points, queries = rng.normal(size=(2000, 3)), rng.normal(size=(1500, 3))
    full = assert_candidates_are_exact(
        points, queries, 3, (np.inf,), rng, n_cubes=300, n_numbers=20_000
    )
    assert full.used[0] > 290 or full.used[1] > 18_000
    make_room(full)
    assert (full.used[0], full.used[1]) == (9, 2000)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 255, 256, 257, 300, 4095, 4097, 9000])
def test_the_order_is_a_permutation_of_compact_runs(n):
    points = np.random.default_rng(22).normal(size=(n, 3))
    order = tree_order(points)
    assert sorted(order) == list(range(n))
    leaves = build_leaves(points[order])
    lanes = leaves.points.transpose(0, 2, 1).reshape(-1, 3)
    np.testing.assert_array_equal(lanes[:n], points[order])
    assert np.isinf(lanes[n:]).all()
    np.testing.assert_array_equal(leaves.boxes[-1, :3].min(axis=1), points.min(axis=0))
    np.testing.assert_array_equal(leaves.boxes[-1, 3:].max(axis=1), points.max(axis=0))


@pytest.mark.parametrize("most", [np.inf, 1.2, 0.8, 0.0, 1e-320])
def test_the_trim_limit_is_the_value_that_sorting_puts_at_its_rank(most):
    rng = np.random.default_rng(23)
    for values in (rng.random(3000), np.repeat(rng.random(3), 500), np.zeros(50)):
        values = np.where(values <= most, values, np.inf)
        for rank in {0, int(np.isfinite(values).sum()) // 2, int(np.isfinite(values).sum()) - 1}:
            if rank >= 0 and np.isfinite(values).any():
                assert _of_rank(values.copy(), rank, most) == np.sort(values)[rank]
