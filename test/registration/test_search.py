"""The search of ICP against every distance computed, on input that makes searches fail."""

import numpy as np
import pytest

from cello3d_ros.registration.icp import _of_rank
from cello3d_ros.registration.search import build_leaves, search, tree_order

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


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("k", [1, 3, 5])
def test_the_search_finds_what_sorting_all_distances_finds(case, k):
    rng = np.random.default_rng(21)
    points = CASES[case](rng)
    points = points[tree_order(points)]
    leaves = build_leaves(points)
    queries = np.vstack([points[:200], points.mean(axis=0) + 2 * rng.normal(size=(101, 3))])
    queries[7] += 1e7
    distances2, indices = np.full((len(queries), k), np.inf), np.full((len(queries), k), -1)
    for cap2 in (np.inf, np.inf, 0.5, 0.05, 0.0):  # with the last neighbours as bounds
        queries = queries + 0.05 * rng.normal(size=3) if cap2 > 0.0 else points[:301].copy()
        distances2, indices = distances2[: len(queries)], indices[: len(queries)]
        n_found = search(queries, leaves, cap2, distances2, indices)
        expected2, expected = plain(points, queries, k, cap2)
        np.testing.assert_array_equal(indices, expected)
        np.testing.assert_array_equal(distances2, expected2)
        assert n_found == (expected >= 0).sum()


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
