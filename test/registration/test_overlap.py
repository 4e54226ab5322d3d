import numpy as np

from cello3d_ros.clouds.shape import filtered, prepare
from cello3d_ros.config import CloudConfig
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.registration.overlap import find_overlap

CONFIG = CloudConfig(min_range_m=0.0, voxel_m=0.01, n_neighbors=3)


def cloud(points):
    return prepare(np.asarray(points, dtype=float), CONFIG, np.random.default_rng(0))


def test_a_point_beyond_the_radius_is_outside():
    near = cloud([[0, 0, 1], [1, 0, 1], [2, 3, 1]])
    far = cloud([[0, 0.2, 1], [1, 0.05, 1], [9, 0, 1]])
    overlap = find_overlap(near, far, np.eye(4), 0.1)
    assert near.points[overlap.reading].tolist() == [[1, 0, 1]]
    assert far.points[overlap.reference].tolist() == [[1, 0.05, 1]]
    assert overlap.n_points == 2
    assert overlap.ratio == 1 / 3


def test_overlap_does_not_depend_on_the_frames(room):
    T = exp([0.5, -1.0, 0.2, 0.1, 0.2, 2.0])
    reference = cloud(room[1][:2000])
    here = find_overlap(cloud(room[0][:2000]), reference, np.eye(4), 0.2)
    there = find_overlap(cloud(transform(inverse(T), room[0][:2000])), reference, T, 0.2)
    assert abs(here.ratio - there.ratio) < 1e-3
    assert abs(int(here.reference.sum()) - int(there.reference.sum())) <= 2


def test_overlap_is_that_of_all_distances_whatever_the_number_of_threads(room):
    T = exp([0.3, -0.2, 0.1, 0.05, 0.0, 0.4])
    reading, reference = cloud(room[0][:6000]), cloud(room[1][:3000])
    found = find_overlap(reading, reference, T, 0.1, 3)
    moved = transform(T, reading.points)
    squares = ((moved[:, None] - reference.points) ** 2).sum(axis=2)
    assert (found.reading == (squares.min(axis=1) <= 0.01)).all()
    assert (found.reference == (squares.min(axis=0) <= 0.01)).all()
    assert 0 < found.reference.sum() < len(found.reference)
    np.testing.assert_allclose(found.distances2, np.sort(squares, axis=1)[:, :3], atol=1e-12)
    for a, b in zip(found, find_overlap(reading, reference, T, 0.1, 3, n_threads=2)):
        np.testing.assert_array_equal(a, b)


def test_some_points_stand_for_all(room):
    T = exp([0.3, -0.2, 0.1, 0.05, 0.0, 0.4])
    reading, reference = cloud(room[0][:6000]), cloud(room[1][:3000])
    every, some, again = (
        find_overlap(reading, reference, T, 0.1, 3, n_looked_at=n) for n in (0, 1500, 1500)
    )
    assert len(some.points) == len(np.unique(some.points, axis=0)) == 1500
    for a, b in zip(some, again):
        np.testing.assert_array_equal(a, b)
    of_all = {tuple(p): i for i, p in enumerate(reading.points)}
    looked_at = [of_all[tuple(p)] for p in some.points]
    np.testing.assert_array_equal(some.reading, every.reading[looked_at])
    np.testing.assert_array_equal(some.indices, every.indices[looked_at])
    assert abs(some.ratio - every.ratio) < 0.04
    assert (some.reference <= every.reference).all()


def test_no_tree_of_the_reading_is_needed_where_some_stand_for_all(room):
    rng = np.random.default_rng(0)
    bare = filtered(room[0][:2000], CONFIG, rng)
    found = find_overlap(bare, cloud(room[1]), np.eye(4), 0.1, 3, n_looked_at=10_000)
    every = find_overlap(cloud(room[0][:2000]), cloud(room[1]), np.eye(4), 0.1, 3)
    assert found.ratio == every.ratio
    assert len(found.points) == len(bare.points)
