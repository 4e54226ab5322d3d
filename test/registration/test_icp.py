"""ICP against a plain numpy version of the rules in registration/icp.py, and reference results."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, IcpConfig
from cello3d_ros.geometry.se3 import exp, inverse, log, transform
from cello3d_ros.registration import icp as module
from cello3d_ros.registration.backends import register_many
from cello3d_ros.registration.icp import icp, register


def oracle(reading, reference, normals, T_init, config):
    """Follow the rules with scipy's tree, a full sort and a dense solve: (T, iterations)."""
    k, mean = config.n_neighbors, reference.mean(axis=0)
    tree = cKDTree(reference - mean)
    T_start = T_init.copy()
    T_start[:3, 3] -= mean
    start = transform(T_start, reading)
    step_sizes = []
    T = np.eye(4)
    for iteration in range(1, config.max_iterations + 1):
        moved = transform(T, start)
        distances, indices = tree.query(moved, k=k)
        distances2 = distances.ravel() ** 2
        rank = min(int(len(distances2) * config.trim_ratio), len(distances2) - 1)
        kept = distances2 <= np.sort(distances2)[rank]
        p = np.repeat(moved, k, axis=0)[kept]
        q = (reference - mean)[indices.ravel()[kept]]
        dT = np.eye(4)
        if config.error_metric == "point_to_plane":
            n = normals[indices.ravel()[kept]]
            J = np.hstack([np.cross(p, n), n])
            x = -np.linalg.lstsq(J, np.einsum("ij,ij->i", p - q, n), rcond=None)[0]
            dT[:3, :3], dT[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        else:
            R = Rotation.align_vectors(q - q.mean(axis=0), p - p.mean(axis=0))[0].as_matrix()
            dT[:3, :3], dT[:3, 3] = R, q.mean(axis=0) - R @ p.mean(axis=0)
        T_new = dT @ T
        turn = Rotation.from_matrix(T[:3, :3].T @ T_new[:3, :3]).magnitude()
        step_sizes.append((turn, np.linalg.norm(T_new[:3, 3] - T[:3, 3])))
        T = T_new
        last = np.mean(step_sizes[-config.n_smoothed :], axis=0)
        limits = (config.rotation_epsilon_rad, config.translation_epsilon_m)
        if iteration >= config.n_smoothed and (last < limits).all():
            break
    T_ref_read = T @ T_start
    T_ref_read[:3, 3] += mean
    return T_ref_read, iteration


@pytest.fixture
def pair(room):
    """Reading, reference and its normals, true T_ref_read."""
    rng = np.random.default_rng(11)
    T = exp([0.3, -0.2, 0.1, 0.02, -0.03, 0.2])
    reference = prepare(room[1], CloudConfig(), rng)
    reading = transform(inverse(T), room[0])[rng.permutation(len(room[0]))[:1500]]
    return reading, reference.points, reference.normals, T


@pytest.mark.parametrize("metric", ["point_to_plane", "point_to_point"])
@pytest.mark.parametrize(("k", "ratio"), [(3, 0.7), (1, 1.0), (5, 0.4)])
def test_icp_follows_the_rules(pair, metric, k, ratio):
    reading, reference, normals, T = pair
    config = IcpConfig(error_metric=metric, n_neighbors=k, trim_ratio=ratio)
    for xi in np.random.default_rng(12).normal(scale=0.15, size=(6, 6)):
        found = icp(reading, reference, normals, T @ exp(xi), config)
        expected, n_iterations = oracle(reading, reference, normals, T @ exp(xi), config)
        np.testing.assert_allclose(found.T_ref_read, expected, atol=1e-9)
        assert found.n_iterations == n_iterations


def test_ties_and_duplicates_do_not_break_the_trim(pair):
    lattice = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    lattice = np.vstack([lattice, lattice[:100]])
    normals = np.tile(np.eye(3), (len(lattice) // 3 + 1, 1))[: len(lattice)]
    config = IcpConfig(n_neighbors=1)
    T_init = exp([0.1, 0.05, -0.1, 0.01, 0.0, 0.02])
    found = icp(lattice[::2], lattice, normals, T_init, config)
    np.testing.assert_allclose(found.T_ref_read, np.eye(4), atol=1e-9)
    assert found.residual_rms_m < 1e-9


def test_a_registration_tells_how_it_ended(pair):
    reading, reference, normals, T = pair
    found = icp(reading, reference, normals, T, IcpConfig())
    assert found.converged
    assert found.reason == ""
    assert abs(found.n_associations - 0.7 * 3 * len(reading)) < 2
    assert np.linalg.norm(log(inverse(T) @ found.T_ref_read)) < 0.01
    stopped = icp(
        reading, reference, normals, T @ exp([0.3, 0, 0, 0, 0, 0.3]), IcpConfig(max_iterations=2)
    )
    assert (stopped.converged, stopped.reason, stopped.n_iterations) == (
        False,
        "max_iterations",
        2,
    )


def test_the_residual_is_that_of_the_kept_associations(pair):
    reading, reference, normals, T = pair
    found = icp(reading, reference, normals, T, IcpConfig(max_iterations=1))
    distances, indices = cKDTree(reference).query(transform(T, reading), k=3)
    kept = distances <= np.sort(distances, axis=None)[int(distances.size * 0.7)]
    errors = np.einsum(
        "nki,nki->nk", transform(T, reading)[:, None] - reference[indices], normals[indices]
    )[kept]
    assert found.n_associations == len(errors)
    assert found.residual_rms_m == pytest.approx(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize("metric", ["point_to_plane", "point_to_point"])
def test_too_few_points_and_singular_systems_say_so(metric):
    config = IcpConfig(error_metric=metric)
    rng = np.random.default_rng(13)
    few = icp(np.ones((1, 3)), np.ones((2, 3)), np.ones((2, 3)), np.eye(4), config)
    assert (few.converged, few.reason) == (False, "too_few_points")
    line = rng.uniform(-5, 5, (300, 1)) * [1.0, 0.0, 0.0]
    up = np.tile([0.0, 0.0, 1.0], (300, 1))
    singular = icp(line, line, up, exp([0.1, 0, 0, 0, 0, 0]), config)
    assert (singular.converged, singular.reason) == (False, "singular")
    assert np.isfinite(singular.T_ref_read).all()


def test_a_perfect_plane_is_singular_for_point_to_plane():
    plane = np.random.default_rng(14).uniform(-5, 5, (500, 3)) * [1, 1, 0]
    up = np.tile([0.0, 0.0, 1.0], (500, 1))
    assert icp(plane, plane, up, np.eye(4), IcpConfig()).reason == "singular"


def test_the_arguments_stay_as_they_are(pair):
    reading, reference, normals, T = pair
    copies = [array.copy() for array in pair]
    icp(reading, reference, normals, T, IcpConfig())
    for array, copy in zip(pair, copies):
        np.testing.assert_array_equal(array, copy)


def test_icp_moves_with_its_frames(pair):
    """Expressing the clouds in other frames changes T_ref_read by those frames, no more."""
    reading, reference, normals, T = pair
    A, B = exp([1.0, 2.0, -0.5, 0.3, -0.2, 1.0]), exp([-0.4, 0.1, 0.2, 0.0, 0.5, -0.3])
    plain = icp(reading, reference, normals, T, IcpConfig()).T_ref_read
    moved = icp(
        transform(B, reading),
        transform(A, reference),
        normals @ A[:3, :3].T,
        A @ T @ inverse(B),
        IcpConfig(),
    ).T_ref_read
    np.testing.assert_allclose(moved, A @ plain @ inverse(B), atol=1e-3)  # the steps that stop it


def test_each_of_many_registrations_depends_on_its_own_seed_only(room):
    rng = np.random.default_rng(15)
    config = IcpConfig(n_reading_points=500, n_reference_points=1500)
    reading, reference = (prepare(scan, CloudConfig(), rng) for scan in room)
    starts = exp(rng.normal(scale=0.1, size=(8, 6)))
    seeds = [[9, i] for i in range(8)]
    one = register_many(reading, reference, starts, seeds, config, n_threads=1)
    two = register_many(reading, reference, starts, seeds, config, n_threads=2)
    alone = register(reading, reference, starts[3], config, np.random.default_rng(seeds[3]))
    for a, b in zip(one, two):
        np.testing.assert_array_equal(a.T_ref_read, b.T_ref_read)
    np.testing.assert_array_equal(one[3].T_ref_read, alone.T_ref_read)
    other = register(reading, reference, starts[3], config, np.random.default_rng([9, 99]))
    assert not np.array_equal(other.T_ref_read, alone.T_ref_read)


@pytest.mark.parametrize("metric", ["point_to_plane", "point_to_point"])
@pytest.mark.parametrize("n_threads", [2, 3, 8])
def test_threads_change_no_bit_of_a_registration(room, n_threads, metric):
    rng = np.random.default_rng(18)
    reading, reference = (prepare(scan, CloudConfig(), rng) for scan in room)
    config = IcpConfig(n_reading_points=700, error_metric=metric)
    start = exp([0.3, -0.2, 0.1, 0.05, 0.0, 0.2])
    one, more = (
        register(reading, reference, start, config, np.random.default_rng(3), n)
        for n in (1, n_threads)
    )
    np.testing.assert_array_equal(one.T_ref_read, more.T_ref_read)
    assert one[1:] == more[1:]


@pytest.mark.parametrize(("n_reading", "n_reference"), [(0, 0), (0, 1500), (500, 0), (500, 1500)])
def test_a_registration_is_that_of_the_points_drawn(room, n_reading, n_reference):
    """0 draws all: the reference is then searched by the tree that it has, with equal results."""
    rng = np.random.default_rng(16)
    reading, reference = (prepare(scan, CloudConfig(), rng) for scan in room)
    config = IcpConfig(n_reading_points=n_reading, n_reference_points=n_reference)
    start = exp([0.1, -0.05, 0.05, 0.02, 0.0, 0.1])
    found = register(reading, reference, start, config, np.random.default_rng(4))
    rng = np.random.default_rng(4)
    read = subsample(len(reading.points), n_reading or 10**6, rng)
    ref = subsample(len(reference.points), n_reference or 10**6, rng)
    expected, n_iterations = oracle(
        reading.points[read], reference.points[ref], reference.normals[ref], start, config
    )
    np.testing.assert_allclose(found.T_ref_read, expected, atol=1e-9)
    assert found.n_iterations == n_iterations


def test_the_whole_reference_needs_no_tree_built(room, monkeypatch):
    rng = np.random.default_rng(17)
    reading, reference = (prepare(scan, CloudConfig(), rng) for scan in room)
    monkeypatch.setattr(module, "build_tree", None)
    whole = IcpConfig(n_reading_points=300, n_reference_points=0)
    starts = exp(rng.normal(scale=0.1, size=(4, 6)))
    found = register_many(reading, reference, starts, [[i] for i in range(4)], whole)
    assert all(r.converged for r in found)


@pytest.mark.parametrize(
    "case", ["indoor_10000_2000", "indoor_20000_5000", "street_10000_2000", "street_20000_5000"]
)
def test_results_are_those_of_libpointmatcher(evaluation, case):
    folder = evaluation / "bench" / case
    names = ("reading_points", "ref_points", "ref_normals", "T0")
    reading, reference, normals, starts = (np.load(folder / f"{name}.npy") for name in names)
    expected = np.load(folder / "T_libpointmatcher.npy")
    n_iterations = np.load(folder / "iterations_libpointmatcher.npy")
    found = [icp(reading, reference, normals, T, IcpConfig()) for T in starts]
    for r, T in zip(found, expected):
        np.testing.assert_allclose(r.T_ref_read, T, atol=1e-12)
    assert [r.n_iterations for r in found] == n_iterations.tolist()


def two_walls_and_a_hill(rng, n):
    """n points with their exact normals, as a scanner at the origin may see them."""
    x, y = rng.uniform(-8, 8, (2, n))
    hill = np.stack([x, y, 0.5 * np.sin(0.4 * x) * np.cos(0.3 * y) - 1.5], axis=1)
    slope = [-0.2 * np.cos(0.4 * x) * np.cos(0.3 * y), 0.15 * np.sin(0.4 * x) * np.sin(0.3 * y)]
    up = np.stack([*slope, np.ones(n)], axis=1)
    wall = rng.integers(0, 3, n)
    walls = np.stack([x, y, rng.uniform(-1.5, 3, n)], axis=1)
    walls[wall == 1, 0], walls[wall == 2, 1] = 8.0, -8.0
    normals = up / np.linalg.norm(up, axis=1, keepdims=True)
    normals[wall == 1], normals[wall == 2] = [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    points = np.where(wall[:, None] == 0, hill, walls)
    return points + 0.01 * rng.normal(size=(n, 3)), normals


@pytest.mark.parametrize("seed", range(10))
def test_ten_registrations_are_those_of_plain_numpy_to_the_last_digits(seed):
    """The size of the reference results of libpointmatcher, and starts as far from the truth."""
    rng = np.random.default_rng([31, seed])
    reference, normals = two_walls_and_a_hill(rng, 10_000)
    T = exp([0.6, -0.2, 0.1, 0.02, -0.03, 0.2])
    reading = transform(inverse(T), two_walls_and_a_hill(rng, 2000)[0])
    start = T @ exp(rng.normal(scale=0.05**0.5, size=6))
    found = icp(reading, reference, normals, start, IcpConfig())
    expected, n_iterations = oracle(reading, reference, normals, start, IcpConfig())
    np.testing.assert_allclose(found.T_ref_read, expected, atol=1e-12)
    assert found.n_iterations == n_iterations
