"""Global features: by their definitions, and under a change of frame."""

import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, IcpConfig, Pipeline
from cello3d_ros.covariance import description
from cello3d_ros.covariance.description import describe, turns
from cello3d_ros.covariance.features import FEATURES, model_inputs
from cello3d_ros.geometry.se3 import exp, hat, inverse, transform

T_HAT = exp([0.4, -0.3, 0.05, 0.02, 0.05, 0.6])


@pytest.fixture
def pair(room):
    rng = np.random.default_rng(33)
    reading = prepare(transform(inverse(T_HAT), room[0]), CloudConfig(), rng)
    return reading, prepare(room[1], CloudConfig(), rng)


def by_name(found):
    assert found.features.shape == (len(FEATURES),)
    return dict(zip(FEATURES, found.features, strict=True))


def rms(vectors):
    return np.sqrt(np.mean(np.sum(vectors**2, axis=1)))


def normal_variances(cloud):
    spread = 1.0 - cloud.cylindricality
    return (1.0 - cloud.planarity / spread) ** 2 / 20


def found_held(reading, reference, T, idx, kept):
    """Least eigenvalue of H against N, association by association."""
    H, N = np.zeros((6, 6)), np.zeros((6, 6))
    variances = normal_variances(reference)
    for i, j in zip(*np.nonzero(kept)):
        A = np.vstack([np.eye(3), hat(reading.points[i])])
        m = A @ T[:3, :3].T @ reference.normals[idx[i, j]]
        H, N = H + np.outer(m, m), N + variances[idx[i, j]] * A @ A.T
    return np.linalg.eigvals(np.linalg.solve(N, H)).real.min()


def test_each_feature_is_what_it_is_called(pair):
    reading, reference = pair
    icp = IcpConfig(n_reading_points=500, n_reference_points=10**6)
    found = describe(reading, reference, T_HAT, Pipeline(icp=icp))
    features = by_name(found)
    d2, idx = found.overlap.distances2, found.overlap.indices
    limit2 = np.sort(d2, axis=None)[int(d2.size * icp.trim_ratio)]
    kept = d2 <= limit2
    q, n = reference.points[idx], reference.normals[idx]
    r = (((transform(T_HAT, reading.points)[:, None] - q) * n).sum(axis=2))[kept]
    S, H_inverse = found.shapes["sandwich"], found.shapes["hessian"]
    diagonal = np.diag(H_inverse)
    unit = np.sqrt(np.repeat([diagonal[:3].mean(), diagonal[3:].mean()], 3))
    against = np.log(np.linalg.eigvals(np.linalg.solve(H_inverse, S)).real / np.mean(r**2))
    moved = transform(T_HAT, reading.points) - reading.points
    expected = {
        "overlap_ratio": found.overlap_ratio,
        "log_sandwich_m": 0.5 * np.log(np.trace(S[:3, :3])),
        "log_sandwich_rad": 0.5 * np.log(np.trace(S[3:, 3:])),
        "log_trim_m": 0.5 * np.log(limit2),
        "log_residual_m": 0.5 * np.log(np.mean(r**2)),
        "log_condition": np.log(np.linalg.cond(H_inverse / np.outer(unit, unit))),
        "log_least_sandwich_against_hessian": against.min(),
        "log_mean_sandwich_against_hessian": against.mean(),
        "log_largest_sandwich_against_hessian": against.max(),
        "log_associations": np.log(kept.sum()),
        "log_reading_points_per_draw": np.log(len(reading.points) / 500),
        "log_reference_points_per_draw": 0.0,
        "log_displacement_m": np.log(5e-4 + rms(moved)),
        "log_range_m": np.log(rms(reading.points)),
        "log_normal_variance": np.log(normal_variances(reference)[idx][kept].mean()),
        "log_held": np.log(found_held(reading, reference, T_HAT, idx, kept)),
    }
    assert set(expected) == set(FEATURES)
    for name, value in expected.items():
        assert features[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name


def test_features_stay_when_the_sensor_frame_is_turned(pair):
    reading, reference = pair
    R = np.eye(4)
    R[:3, :3] = turns(5)[1]

    def turned(cloud):
        return prepare(transform(R, cloud.points), whole, np.random.default_rng(0))

    # every point kept, so that both clouds have the same points before and after
    whole = CloudConfig(voxel_m=0.01, min_range_m=0.0)
    here = describe(
        *(prepare(cloud.points, whole, np.random.default_rng(0)) for cloud in pair),
        T_HAT,
        Pipeline(),
    )
    there = describe(turned(reading), turned(reference), R @ T_HAT @ inverse(R), Pipeline())
    np.testing.assert_allclose(here.features, there.features, atol=2e-3)


def test_identical_clouds_have_finite_features(pair):
    assert np.isfinite(describe(pair[0], pair[0], np.eye(4), Pipeline()).features).all()


def test_copies_that_leave_no_residual_have_finite_features_too(pair):
    """Each point meets itself: every spread is 0, and its logarithm has a bound."""
    found = describe(pair[0], pair[0], np.eye(4), Pipeline(icp=IcpConfig(n_neighbors=1)))
    assert not found.shapes["sandwich"].any()
    features = by_name(found)
    assert np.isfinite(found.features).all()
    for name in ("log_sandwich_m", "log_sandwich_rad", "log_residual_m"):
        assert features[name] == pytest.approx(np.log(1e-6))


def test_inputs_are_the_turned_descriptors_or_one_row():
    descriptors, features = np.arange(24.0).reshape(2, 3, 4), np.array([[7.0, 8.0], [9.0, 10.0]])
    np.testing.assert_array_equal(model_inputs("descriptor", descriptors, features), descriptors)
    np.testing.assert_array_equal(model_inputs("global", descriptors, features), features[:, None])
    both = model_inputs("both", descriptors, features)
    assert both.shape == (2, 1, 6)
    np.testing.assert_array_equal(both[1, 0], [9.0, 10.0, 12.0, 13.0, 14.0, 15.0])


def test_part_of_the_reading_tells_what_all_of_it_tells(room, monkeypatch):
    """Nothing but a descriptor needs every point: one in four changes no input by much."""
    rng = np.random.default_rng(0)
    config = Pipeline(cloud=CloudConfig(voxel_m=0.01))
    pair = [prepare(points, config.cloud, rng) for points in room]
    every = describe(*pair, T_HAT, config, n_rotations=0)
    monkeypatch.setattr(description, "_N_LOOKED_AT", len(pair[0].points) // 4)
    some = describe(*pair, T_HAT, config, n_rotations=0)
    whole = describe(*pair, T_HAT, config, n_rotations=1)
    assert len(some.overlap.points) == len(pair[0].points) // 4
    np.testing.assert_allclose(whole.features, every.features, atol=1e-9)
    np.testing.assert_allclose(some.features, every.features, atol=0.12)
    for name in every.shapes:
        ratio = np.diag(some.shapes[name]) / np.diag(every.shapes[name])
        np.testing.assert_allclose(ratio, 1.0, atol=0.15)
