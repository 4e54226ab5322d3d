import numpy as np
import pytest

from cello3d_ros.clouds.neighbors import build_tree, nearest
from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import CloudConfig, IcpConfig
from cello3d_ros.covariance.closed_form import (
    _implicit_derivative,
    _normal_matrices,
    _tilted,
    censi,
    closed_form,
    common_bias,
)
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.se3 import exp, hat, inverse, log, transform
from cello3d_ros.registration.icp import icp
from cello3d_ros.registration.overlap import Overlap


def overlap_of(points, distances2, indices):
    """The associations of an overlap, of which closed forms need no more."""
    return Overlap(points, np.empty(0), np.empty(0), distances2, indices)


def predictors(reading, reference, T, config):
    moved = transform(T, reading.points)
    found = overlap_of(reading.points, *nearest(reference.tree, moved, config.n_neighbors))
    return closed_form(reading, reference, T, found, config)


def normal_matrix(points, normals):
    """Return H for points that are associated with themselves."""
    n = len(points)
    zeros, own = np.zeros((n, 1)), np.arange(n)[:, None]
    H, G, _, _, _ = _normal_matrices(
        points, points, points, normals, np.ones(n), np.zeros(n), np.eye(3), zeros, own, 1.0
    )
    np.testing.assert_array_equal(G, 0.0)  # no residuals
    return H


def null_space(points, normals):
    """Return the names of the free directions, which must be along the axes."""
    values, vectors = np.linalg.eigh(normal_matrix(points, normals))
    free = vectors[:, values < 1e-9 * values[-1]]
    names = np.array(["tx", "ty", "tz", "rx", "ry", "rz"])
    share = (free**2).sum(axis=1)
    np.testing.assert_allclose(share[share > 0.5].sum(), free.shape[1], atol=1e-6)
    return set(names[share > 0.5])


def plane(rng, axis, at=0.0, n=400):
    points = rng.uniform(-2, 2, (n, 3))
    points[:, axis] = at
    return points, np.tile(np.eye(3)[axis], (n, 1))


def join(*parts):
    return np.vstack([p for p, _ in parts]), np.vstack([n for _, n in parts])


def cylinder(rng, n=800):
    angle, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(-2, 2, n)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    return radial + z[:, None] * [0, 0, 1], radial


def disc(rng, z):
    points, normals = plane(rng, 2, z)
    inside = np.linalg.norm(points[:, :2], axis=1) < 1
    return points[inside], normals[inside]


def sphere(rng):
    radial = rng.normal(size=(800, 3))
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    return radial, radial


def cube(rng, n):
    return join(*(plane_of_cube(rng, axis, sign, n) for axis in range(3) for sign in (-1, 1)))


def plane_of_cube(rng, axis, sign, n):
    points = rng.uniform(-0.5, 0.5, (n, 3))
    points[:, axis] = 0.5 * sign
    return points, np.tile(sign * np.eye(3)[axis], (n, 1))


SCENES = {
    "plane": (lambda r: plane(r, 2), {"tx", "ty", "rz"}),
    "two parallel walls": (lambda r: join(plane(r, 1, -1), plane(r, 1, 1)), {"tx", "tz", "ry"}),
    "ground and wall": (lambda r: join(plane(r, 2, -2), plane(r, 0, 2)), {"ty"}),
    "hallway": (
        lambda r: join(*(plane(r, a, s) for a in (1, 2) for s in (-2, 2))),
        {"tx"},
    ),
    "cylinder": (cylinder, {"tz", "rz"}),
    "capped cylinder": (lambda r: join(cylinder(r), disc(r, 2.0), disc(r, -2.0)), {"rz"}),
    "sphere": (sphere, {"rx", "ry", "rz"}),
    "cube": (lambda r: cube(r, 200), set()),
}


@pytest.mark.parametrize("scene", SCENES)
def test_the_normal_matrix_is_free_where_the_scene_is(scene):
    build, expected = SCENES[scene]
    assert null_space(*build(np.random.default_rng(31))) == expected


def test_a_unit_cube_has_the_eigenvalues_of_its_symmetry():
    points, normals = cube(np.random.default_rng(32), 40000)
    values = np.linalg.eigvalsh(normal_matrix(points, normals)) / len(points)
    np.testing.assert_allclose(values, [1 / 18] * 3 + [1 / 3] * 3, rtol=0.01)


@pytest.fixture
def pair(room):
    T = exp([0.4, -0.3, 0.05, 0.02, 0.05, 0.6])
    rng = np.random.default_rng(33)
    reading = prepare(transform(inverse(T), room[0]), CloudConfig(), rng)
    return reading, prepare(room[1], CloudConfig(), rng), T


def test_both_are_covariances_on_the_reading_side(pair):
    """H^-1 against finite differences of the residuals under T exp(xi)."""
    reading, reference, T = pair
    every = IcpConfig(n_neighbors=1, trim_ratio=1.0, n_reading_points=10**6)
    found = predictors(reading, reference, T, every)
    nearest = np.linalg.norm(
        transform(T, reading.points)[:, None] - reference.points[None], axis=2
    ).argmin(axis=1)

    def residuals(xi):
        moved = transform(T @ exp(xi), reading.points)
        return np.einsum("ij,ij->i", moved - reference.points[nearest], reference.normals[nearest])

    step = 1e-6
    J = np.stack(
        [(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(6)], axis=1
    )
    H = J.T @ J
    g = J * residuals(np.zeros(6))[:, None]
    np.testing.assert_allclose(found.inverse_H, np.linalg.inv(H), rtol=1e-4, atol=1e-12)
    expected = np.linalg.inv(H) @ (g.T @ g) @ np.linalg.inv(H)
    np.testing.assert_allclose(found.sandwich, expected, rtol=1e-4, atol=1e-12)


def test_the_sandwich_has_the_size_of_what_redrawing_the_reading_does(pair):
    reading, reference, T = pair
    config = IcpConfig(n_neighbors=1, n_reading_points=800)
    rng = np.random.default_rng(34)
    results = [
        icp(
            reading.points[rng.choice(len(reading.points), 800, replace=False)],
            reference.points,
            reference.normals,
            T,
            config,
        ).T_ref_read
        for _ in range(150)
    ]
    xi = log(inverse(T) @ np.array(results))
    sampled = np.cov(xi.T)
    predicted = predictors(reading, reference, T, config).sandwich
    ratio = np.trace(np.linalg.solve(predicted, sampled)) / 6
    assert 0.3 < ratio < 6  # first order, without reassociation


def test_a_free_direction_is_an_error():
    rng = np.random.default_rng(35)
    ground = prepare(plane(rng, 2, -1.0, 3000)[0], CloudConfig(), rng)
    with pytest.raises(RegistrationError, match="holds x, y, yaw of the sensor: free here"):
        predictors(ground, ground, np.eye(4), IcpConfig())


def test_points_without_a_plane_count_for_nothing():
    """The closed forms of a cloud with normals of 0 are those of the cloud without them."""
    P, Q, normals, indices, distances2, T = corners()
    half = np.arange(len(Q)) % 2 == 0
    bare = np.where(half[:, None], normals, 0.0)
    alone = np.where(half[indices], distances2, np.inf)
    order = np.argsort(alone, axis=1, kind="stable")
    alone, swapped = (np.take_along_axis(a, order, axis=1) for a in (alone, indices))
    every = IcpConfig(trim_ratio=1.0)
    reading = cloud(P, normals)
    found = closed_form(reading, cloud(Q, bare), T, overlap_of(P, distances2, indices), every)
    config = IcpConfig(trim_ratio=float(np.isfinite(alone).mean()) - 1e-6)
    expected = closed_form(reading, cloud(Q, normals), T, overlap_of(P, alone, swapped), config)
    np.testing.assert_allclose(found.inverse_H, expected.inverse_H, rtol=1e-9)
    np.testing.assert_allclose(found.sandwich, expected.sandwich, rtol=1e-9)
    assert found.n_associations == expected.n_associations == half[indices].sum()
    assert found.residual_rms_m == pytest.approx(expected.residual_rms_m)


def test_what_errors_of_normals_alone_make_of_h_is_their_mean():
    """Tilted normals of planes without a hold along x: H there is N, on average."""
    rng = np.random.default_rng(37)
    Q, normals = join(*(plane(rng, axis, 2.0, 200) for axis in (1, 2)))
    sigma = 0.02
    homogeneous = np.column_stack([Q, np.ones(len(Q))])
    N = _tilted(sigma**2 * homogeneous.T @ homogeneous)
    found = [
        normal_matrix(Q, normals + sigma * rng.normal(size=normals.shape)) for _ in range(300)
    ]
    np.testing.assert_allclose(np.mean(found, axis=0)[0, 0], N[0, 0], rtol=0.05)
    np.testing.assert_allclose(N[3:, 3:], normal_matrix_of_every_direction(Q, sigma), rtol=1e-12)


def normal_matrix_of_every_direction(points, sigma):
    """Sum of hat(p) hat(p)^T, times the variance."""
    return sigma**2 * sum(hat(p) @ hat(p).T for p in points)


def corners(n=12):
    """Return points and normals of three walls with noise of 5 cm, and associations with it."""
    rng = np.random.default_rng(36)
    Q, normals = join(*(plane(rng, axis, 2.0, n) for axis in range(3)))
    tilt = normals + rng.normal(scale=0.2, size=normals.shape)
    normals = tilt / np.linalg.norm(tilt, axis=1, keepdims=True)
    T = exp([0.4, -0.3, 0.05, 0.02, 0.05, 0.6])
    indices = np.stack([np.arange(3 * n), rng.permutation(3 * n)], axis=1)  # of two neighbours
    P = transform(inverse(T), Q) + rng.normal(scale=0.05, size=Q.shape)
    distances2 = np.tile([0.0, 1.0], (3 * n, 1))
    distances2[::3] = [0.0, 0.0]  # a third keep both, so that points share associations
    return P, Q, normals, indices, distances2, T


def minimum(P, Q, normals, kept, start):
    """Return xi of the least point-to-plane error with fixed associations, by Gauss-Newton."""
    i, q = kept
    T = start
    for _ in range(40):
        m = normals[q] @ T[:3, :3]
        J = np.hstack([m, np.cross(P[i], m)])
        r = np.einsum("ij,ij->i", transform(T, P)[i] - Q[q], normals[q])
        step = np.linalg.solve(J.T @ J, J.T @ r)
        T = T @ exp(-step)
        if np.abs(step).max() < 1e-14:
            break
    assert np.abs(step).max() < 1e-12
    return log(inverse(start) @ T)


def cloud(points, normals):
    zeros, ones = np.zeros(len(points)), np.ones(len(points))
    tree = build_tree(points)
    return Cloud(points, normals, ones, zeros, tree)  # planes without noise


def test_censi_is_the_derivative_of_the_minimum_by_every_coordinate():
    """Each coordinate of both clouds is moved, and the minimum found again."""
    P, Q, normals, indices, distances2, T = corners()
    near = distances2 == 0.0
    kept = np.nonzero(near)[0], indices[near]
    T = T @ exp(minimum(P, Q, normals, kept, T))
    step, D = 1e-4, []
    for points in (P, Q):
        for index in np.ndindex(points.shape):
            ends = []
            for sign in (1, -1):
                points[index] += sign * step
                ends.append(minimum(P, Q, normals, kept, T))
                points[index] -= sign * step
            D.append((ends[0] - ends[1]) / (2 * step))
    expected = 0.02**2 * np.array(D).T @ np.array(D)
    share = near.sum() / near.size
    config = IcpConfig(n_neighbors=2, trim_ratio=float(share) - 1e-9, n_reading_points=18)
    overlap = overlap_of(P, distances2, indices)
    found = censi(cloud(P, normals), cloud(Q, normals), T, overlap, config, 0.02)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), 2.0 * expected / np.outer(scale, scale), atol=1e-6
    )  # 18 of 36 points are drawn: twice the covariance


def test_the_second_derivative_holds_away_from_the_minimum_too():
    P, Q, normals, indices, distances2, T = corners()
    T = T @ exp([0.1, -0.2, 0.15, 0.05, -0.03, 0.02])
    near = distances2 == 0.0
    i, q = np.nonzero(near)[0], indices[near]

    def J(xi):
        moved = transform(T @ exp(xi), P)[i] - Q[q]
        return 0.5 * np.sum(np.einsum("ij,ij->i", moved, normals[q]) ** 2)

    step, E = 1e-3, np.eye(6)
    expected = [
        [
            sum(s * t * J(step * (s * a + t * b)) for s in (1, -1) for t in (1, -1))
            / (4 * step**2)
            for a in E
        ]
        for b in E
    ]
    found, _ = _implicit_derivative(P, cloud(Q, normals), T, indices, near)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)


def test_censi_grows_with_the_noise_and_refuses_free_directions(pair):
    reading, reference, T = pair
    config = IcpConfig()
    moved = transform(T, reading.points)
    found = overlap_of(reading.points, *nearest(reference.tree, moved, config.n_neighbors))
    small = censi(reading, reference, T, found, config, 0.01)
    large = censi(reading, reference, T, found, config, 0.03)
    np.testing.assert_allclose(large, 9.0 * small, rtol=1e-12)
    assert (np.linalg.eigvalsh(small) > 0).all()
    ground = prepare(
        plane(np.random.default_rng(37), 2, -1.0, 3000)[0], CloudConfig(), np.random.default_rng(0)
    )
    itself = overlap_of(ground.points, *nearest(ground.tree, ground.points, config.n_neighbors))
    with pytest.raises(RegistrationError, match="holds x, y, yaw of the sensor"):
        censi(ground, ground, np.eye(4), itself, config, 0.01)


def test_the_common_bias_is_the_answer_to_equal_residuals(pair):
    reading, reference, T = pair
    every = IcpConfig(n_neighbors=1, trim_ratio=1.0)
    distances2, indices = nearest(reference.tree, transform(T, reading.points), 1)
    b = common_bias(reference, T, overlap_of(reading.points, distances2, indices), every)
    n = reference.normals[indices[:, 0]]
    n = np.where(np.einsum("ij,ij->i", n, reference.points[indices[:, 0]])[:, None] < 0, n, -n)
    m = n @ T[:3, :3]
    J = np.hstack([m, np.cross(reading.points, m)])
    expected = np.linalg.lstsq(J, np.ones(len(J)), rcond=None)[0]
    np.testing.assert_allclose(b, expected, rtol=1e-6, atol=1e-9)
