import numpy as np

from cello3d_ros.clouds.filters import cell_means, crop_range, limit_density, subsample


def test_the_range_crop_keeps_both_limits():
    points = np.array([[0.4, 0, 0], [0.5, 0, 0], [0, -3.0, 0], [0, 0, 5.0], [0, 0, 5.1]])
    np.testing.assert_array_equal(crop_range(points, 0.5, 5.0), points[1:4])


def test_a_huge_coordinate_is_out_of_range_not_an_overflow():
    points = np.array([[1e300, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(crop_range(points, 0.5, 100.0), points[1:])


def test_no_cube_keeps_more_than_the_limit_and_sparse_cubes_keep_all():
    rng = np.random.default_rng(0)
    points = np.vstack([rng.uniform(0, 0.2, (500, 3)), rng.uniform(-5, 5, (100, 3))])
    origin = points.min(axis=0)

    def counts(p):
        return np.unique(np.floor((p - origin) / 0.5), axis=0, return_counts=True)

    kept = limit_density(points, 0.5, 7, np.random.default_rng(1))
    cells, before = counts(points)
    kept_cells, after = counts(kept)
    np.testing.assert_array_equal(cells, kept_cells)
    np.testing.assert_array_equal(after, np.minimum(before, 7))


def test_those_kept_of_a_crowded_cube_are_a_uniform_draw():
    points = np.linspace(0.0, 0.9, 10)[:, None] * [1.0, 0.0, 0.0]
    rng = np.random.default_rng(2)
    times = np.zeros(10)
    for _ in range(4000):
        kept = limit_density(points, 1.0, 3, rng)
        times[np.round(kept[:, 0] * 10).astype(int)] += 1
    np.testing.assert_allclose(times / 4000, 0.3, atol=0.035)  # 5 standard errors


def test_the_limit_keeps_the_order_and_takes_an_empty_cloud():
    points = np.random.default_rng(3).normal(size=(50, 3))
    np.testing.assert_array_equal(limit_density(points, 1e-3, 1, np.random.default_rng(0)), points)
    assert limit_density(np.empty((0, 3)), 0.1, 1, np.random.default_rng(0)).shape == (0, 3)


def test_a_subsample_has_no_repetition_and_follows_its_seed():
    first = subsample(1000, 100, np.random.default_rng(4))
    assert len(set(first)) == 100
    assert (np.diff(first) > 0).all()
    np.testing.assert_array_equal(first, subsample(1000, 100, np.random.default_rng(4)))
    assert not np.array_equal(first, subsample(1000, 100, np.random.default_rng(5)))
    np.testing.assert_array_equal(subsample(7, 100, np.random.default_rng(0)), np.arange(7))


def test_the_draw_is_the_first_of_a_permutation_in_each_cube():
    points = np.random.default_rng(5).normal(size=(5000, 3)) * [1, 1, 0.01] - 1e3
    kept = limit_density(points, 0.1, 2, np.random.default_rng(6))
    cells = np.floor((points - points.min(axis=0)) / 0.1).astype(int)
    counts, expected = {}, np.zeros(5000, bool)
    for i in np.random.default_rng(6).permutation(5000):
        counts[cell] = counts.get(cell := tuple(cells[i]), 0) + 1
        expected[i] = counts[cell] <= 2
    np.testing.assert_array_equal(kept, points[expected])


def test_the_means_of_cells_are_those_of_their_points():
    points = np.random.default_rng(3).uniform(-2.0, 9.0, (700, 3))
    _, cells = np.unique(
        np.floor((points - points.min(axis=0)) / 0.9), axis=0, return_inverse=True
    )
    expected = [points[cells.ravel() == cell].mean(axis=0) for cell in range(cells.max() + 1)]
    np.testing.assert_allclose(cell_means(points, 0.9), expected, atol=1e-12)
