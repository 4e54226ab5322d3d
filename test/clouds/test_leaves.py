import numpy as np
import pytest

from cello3d_ros.clouds.leaves import WIDTH, build_leaves, leaves_near, select, tree_order


def a_tree(n):
    points = np.random.default_rng(n).normal(size=(n, 3)) * [4, 2, 1]
    points = points[tree_order(points)]
    return points, build_leaves(points)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 256, 257, 5000])
def test_each_point_is_in_its_lane_and_each_box_around_its_children(n):
    points, leaves = a_tree(n)
    flat = leaves.points.transpose(0, 2, 1).reshape(-1, 3)
    np.testing.assert_array_equal(flat[:n], points)
    assert np.isinf(flat[n:]).all()

    def bounds(node):
        found = []
        for lane in range(16):
            box = leaves.boxes[node, :, lane]
            if not np.isfinite(box).all():
                assert np.isinf(box).all()
                continue
            child = leaves.children[node] + lane
            if child < len(leaves.points):
                inside = flat[16 * child : min(16 * child + 16, n)]
                least, greatest = inside.min(axis=0), inside.max(axis=0)
            else:
                least, greatest = bounds(child - len(leaves.points))
            np.testing.assert_array_equal(box, [*least, *greatest])
            found.append((least, greatest))
        return np.min([b[0] for b in found], axis=0), np.max([b[1] for b in found], axis=0)

    least, greatest = bounds(len(leaves.boxes) - 1)
    np.testing.assert_array_equal(least, points.min(axis=0))
    np.testing.assert_array_equal(greatest, points.max(axis=0))


@pytest.mark.parametrize("radius", [0.0, 0.3, 2.0, 100.0])
def test_leaves_near_a_box_are_those_and_in_order(radius):
    _, leaves = a_tree(5000)
    n = len(leaves.points)
    box = np.array([0.5, 0.0, -0.2, 0.9, 0.3, 0.1])
    near, boxes = np.empty(n, np.int64), np.empty((n // 16 + 1, 6, 16))
    count = leaves_near(leaves, box, radius**2, np.empty(256, np.int64), near, boxes)
    low = np.where(np.isfinite(leaves.points), leaves.points, np.inf).min(axis=2)
    high = np.where(np.isfinite(leaves.points), leaves.points, -np.inf).max(axis=2)
    gap = np.maximum(np.maximum(low - box[3:], box[:3] - high), 0.0)
    np.testing.assert_array_equal(near[:count], np.flatnonzero((gap**2).sum(1) <= radius**2))
    found = boxes.transpose(0, 2, 1).reshape(-1, 6)
    np.testing.assert_array_equal(found[:count], np.hstack([low, high])[near[:count]])
    assert np.isinf(found[count : -(-count // 16) * 16]).all()


def test_leaves_are_more_compact_than_a_random_order():
    points, leaves = a_tree(16**3)
    extent = np.ptp(leaves.points, axis=2).prod(axis=1)
    shuffled = np.random.default_rng(0).permutation(points).reshape(-1, WIDTH, 3)
    assert np.median(extent) < 0.02 * np.median(np.ptp(shuffled, axis=1).prod(axis=1))


def test_selecting_puts_at_a_rank_what_sorting_does():
    rng = np.random.default_rng(23)
    for values in (rng.random(3000), np.repeat(rng.random(3), 500), np.zeros(50)):
        values = np.append(rng.permutation(values), [np.inf, np.inf])
        for rank in (0, len(values) // 2, len(values) - 3, len(values) - 1):
            keys, order = values.copy(), np.arange(len(values))
            select(keys, order, 0, len(keys), rank)
            assert keys[rank] == np.sort(values)[rank]
            np.testing.assert_array_equal(keys, values[order])
            assert (keys[:rank] <= keys[rank]).all()
            assert (keys[rank:] >= keys[rank]).all()
