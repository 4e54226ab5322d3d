"""Check 18 of the design and the two figures of the paper: the cylinder and the hallway."""

from __future__ import annotations

import numpy as np
import pytest

from cello3d_ros.config import SamplingConfig
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.clustering import far_from_truth, nearest_cluster, offset

CONFIG = SamplingConfig()
NOISE = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005])


def kept(xi: Array) -> np.ndarray:
    return nearest_cluster(
        xi, CONFIG.cluster_scale_m, CONFIG.cluster_scale_rad, CONFIG.cluster_min_share
    )


def noise(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).normal(size=(n, 6)) * NOISE


def test_far_is_more_than_three_scales_in_translation_or_rotation() -> None:
    xi = np.array(
        [
            [0.2, 0.2, 0.0, 0.0, 0.0, 0.149],
            [0.2, 0.2, 0.2, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.11, 0.0, 0.11],
        ]
    )
    assert far_from_truth(xi, 0.1, 0.05).tolist() == [False, True, True]
    assert not far_from_truth(xi[1], 0.2, 0.05)


@pytest.mark.parametrize("n", [65, 500, 5000])
def test_of_two_clusters_the_one_nearest_ground_truth_is_kept(n: int) -> None:
    near, far = noise(n), noise(n // 2, 1) + np.array([0.6, 0, 0, 0, 0, 0.3])
    mask = kept(np.concatenate([far, near]))
    assert not mask[: n // 2].any()
    assert mask[n // 2 :].mean() > 0.98
    xi = np.concatenate([far, near])[mask]
    ratio = np.linalg.solve(np.diag(NOISE**2), xi.T @ xi / (len(xi) - 1))
    divergence = 0.5 * (np.trace(ratio) - 6 - np.linalg.slogdet(ratio)[1])
    assert divergence < {65: 0.168, 500: 0.021, 5000: 0.01}[n] * 1.6


def test_a_constant_offset_stays_in_the_covariance() -> None:
    b = np.array([0.1, -0.05, 0.02, 0.01, 0.0, 0.03])
    xi = np.tile(b, (400, 1))
    assert kept(xi).all()
    np.testing.assert_allclose(xi.T @ xi / 399, np.outer(b, b) * 400 / 399, rtol=1e-12)


def test_cylinder_loses_the_upside_down_ring_and_keeps_the_free_axis() -> None:
    rng = np.random.default_rng(2)
    line = noise(4000)
    line[:, 5] += rng.normal(size=4000) * np.sqrt(CONFIG.variance)
    ring = noise(1000, 3)
    axis = rng.uniform(0, 2 * np.pi, 1000)
    ring[:, 3] += np.pi * np.cos(axis)
    ring[:, 4] += np.pi * np.sin(axis)
    mask = kept(np.concatenate([line, ring]))
    assert not mask[4000:].any()
    assert mask[:4000].mean() > 0.97
    assert line[mask[:4000], 5].std() > 0.9 * np.sqrt(CONFIG.variance)


def test_the_ring_goes_although_its_mean_is_nearest_to_ground_truth() -> None:
    axis = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    ring = noise(1000, 4)
    ring[:, 3:5] += np.pi * np.stack([np.cos(axis), np.sin(axis)], axis=1)
    biased = noise(1000, 5) + np.array([0.2, 0, 0, 0, 0, 0.1])
    assert np.linalg.norm(ring.mean(axis=0)) < np.linalg.norm(biased.mean(axis=0))
    mask = kept(np.concatenate([ring, biased]))
    assert not mask[:1000].any()
    assert mask[1000:].mean() > 0.98


def test_hallway_with_regular_pillars_keeps_the_middle_of_three_clusters() -> None:
    xi = noise(3000)
    xi[:1000, 0] -= 1.0
    xi[2000:, 0] += 1.0
    mask = kept(xi)
    assert not mask[:1000].any()
    assert not mask[2000:].any()
    assert mask[1000:2000].mean() > 0.98


def test_featureless_hallway_keeps_its_free_axis() -> None:
    xi = noise(2000)
    xi[:, 0] += np.random.default_rng(6).normal(size=2000) * np.sqrt(CONFIG.variance)
    assert xi[kept(xi), 0].std() > 0.9 * np.sqrt(CONFIG.variance)


def test_scales_are_separate_for_translation_and_rotation() -> None:
    xi = np.zeros((40, 6))
    xi[20:, 0] = 0.09
    assert nearest_cluster(xi, 0.1, 0.05, 0.01).all()
    assert nearest_cluster(xi, 0.05, 0.1, 0.01).sum() == 20
    xi[20:, 0], xi[20:, 3] = 0.0, 0.09
    assert nearest_cluster(xi, 0.1, 0.05, 0.01).sum() == 20


def test_scattered_samples_make_no_cluster() -> None:
    xi = np.random.default_rng(7).uniform(-3, 3, size=(50, 6))
    assert not kept(xi).any()
    assert kept(np.zeros((0, 6))).shape == (0,)
    assert not kept(np.zeros((1, 6))).any()


def test_a_handful_of_samples_near_the_truth_is_no_cluster_of_many() -> None:
    xi = np.concatenate([noise(5), noise(995, 1) + 0.3])
    assert nearest_cluster(xi, 0.1, 0.05, 0.0)[:5].all()
    assert not nearest_cluster(xi, 0.1, 0.05, 0.01)[:5].any()
    assert nearest_cluster(xi, 0.1, 0.05, 0.01)[5:].mean() > 0.98


def test_the_order_of_the_samples_does_not_matter() -> None:
    xi = np.concatenate([noise(200), noise(200, 1) + 0.5])
    order = np.random.default_rng(8).permutation(400)
    np.testing.assert_array_equal(kept(xi[order]), kept(xi)[order])


def test_offset_is_the_mean_over_all_samples() -> None:
    xi = np.tile([3.0, 4.0, 0, 0, 0, 0.5], (10, 1))
    xi[::2, 3] += 1.0
    xi[1::2, 3] -= 1.0
    assert offset(xi) == pytest.approx((5.0, 0.5))


def dbscan(xi: Array, scale_m: float, scale_rad: float, min_share: float) -> np.ndarray:
    """Return the same with scikit-learn's DBSCAN, which holds all pairs of neighbours."""
    from sklearn.cluster import DBSCAN

    scaled = xi / np.repeat([scale_m, scale_rad], 3)
    least = max(2, int(np.ceil(min_share * len(xi))))
    found = DBSCAN(eps=1.0, min_samples=least).fit(scaled)
    core = found.core_sample_indices_
    if len(core) == 0:
        return np.zeros(len(xi), bool)
    nearest = core[np.argmin(np.linalg.norm(scaled[core], axis=1))]
    return found.labels_ == found.labels_[nearest]


@pytest.mark.parametrize("share", [0.0, 0.004, 0.03])
@pytest.mark.parametrize("spread", [0.02, 0.15, 0.4, 1.0])
def test_the_cluster_is_that_of_scikit_learn(spread: float, share: float) -> None:
    rng = np.random.default_rng(9)
    centres = rng.normal(size=(6, 6)) * spread
    xi = centres[rng.integers(6, size=900)] + rng.standard_t(3, (900, 6)) * NOISE
    np.testing.assert_array_equal(
        nearest_cluster(xi, 0.1, 0.05, share), dbscan(xi, 0.1, 0.05, share)
    )


def test_memory_is_linear_in_samples_that_are_all_neighbours() -> None:
    import tracemalloc

    nearest_cluster(noise(100), 0.1, 0.05, 0.002)  # compiles
    xi = noise(20_000) * 0.1
    tracemalloc.start()
    assert nearest_cluster(xi, 0.1, 0.05, 0.002).all()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * xi.nbytes
