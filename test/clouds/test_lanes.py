import numpy as np
import pytest
from numba import njit

from cello3d_ros.clouds import lanes


@njit
def compiled(points, boxes, block, low, high, far2, rows):
    x, y, z = low
    return (
        lanes.distances_of(points, block, x, y, z, far2, rows, 1),
        lanes.count_row(rows, 1, far2),
        lanes.boxes_near(boxes, block, x, y, z, far2),
        lanes.boxes_near_box(boxes, block, x, y, z, high[0], high[1], high[2], far2),
    )


def squares(steps):
    """Sum from left to right, as it is written in the module."""
    return steps[0] * steps[0] + steps[1] * steps[1] + steps[2] * steps[2]


def mask_of(inside):
    return sum(1 << lane for lane in np.flatnonzero(inside))


@pytest.mark.parametrize("seed", range(20))
def test_each_lane_rounds_as_the_formula_does(seed):
    rng = np.random.default_rng(seed)
    points, boxes = rng.normal(size=(3, 3, 16)), rng.normal(size=(3, 6, 16))
    boxes[:, 3:] = boxes[:, :3] + rng.exponential(size=(3, 3, 16))
    points[:, :, 13:], boxes[:, :3, 13:], boxes[:, 3:, 13:] = np.inf, np.inf, -np.inf
    low = rng.normal(size=3)
    high, block = low + rng.exponential(size=3), seed % 3
    with np.errstate(invalid="ignore"):
        d2 = squares(points[block] - low[:, None])
        to = [
            squares(np.maximum(np.maximum(boxes[block, :3] - b, a - boxes[block, 3:]), 0.0))
            for a, b in ((low[:, None], low[:, None]), (low[:, None], high[:, None]))
        ]
    limits = [0.0, *d2, *to[0], *to[1], 1.7e308]
    for far2 in [far2 for far2 in limits if far2 < np.inf]:
        rows = np.full(48, -1.0)
        found = compiled(points, boxes, block, low, high, far2, rows)
        n = int((d2 <= far2).sum())
        expected = n, n, mask_of(to[0] <= far2), mask_of(to[1] <= far2)
        assert found == expected
        np.testing.assert_array_equal(rows, [*[-1.0] * 16, *d2, *[-1.0] * 16])


@njit
def in_order(rows, n_rows):
    """All values of some rows, from the least on, each as often as it is there."""
    found, value = [0.0][:0], -np.inf
    while True:
        value = lanes.least_above(rows, n_rows, value)
        if value == np.inf:
            return found
        for row in range(n_rows):
            mask = lanes.lanes_of(rows, row, value)
            while mask:
                found.append(rows[16 * row + lanes.lowest_bit(mask)])
                mask &= mask - 1


@pytest.mark.parametrize("n_rows", [1, 2, 5])
def test_the_least_one_after_the_other_are_sorted(n_rows):
    rng = np.random.default_rng(n_rows)
    rows = rng.integers(0, 30, 16 * 6).astype(float) - 3.0
    rows[7:10] = np.inf
    expected = np.sort(rows[: 16 * n_rows])
    np.testing.assert_array_equal(in_order(rows, n_rows), expected[np.isfinite(expected)])


def test_the_lowest_bit_is_that_of_the_mask():
    lowest = njit(lambda mask: lanes.lowest_bit(mask))
    assert [lowest(mask) for mask in (1, 2, 0b1011000, 1 << 40)] == [0, 1, 3, 40]
