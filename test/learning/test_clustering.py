"""Check 18 of the design and the two figures of the paper: the cylinder and the hallway."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cello3d_ros.config import SamplingConfig
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.clustering import far_from_truth, nearest_cluster, offset

CONFIG = SamplingConfig()
NOISE = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005])
NARROW = 0.3 * NOISE


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


def mixture(rng: np.random.Generator, n: int) -> Array:
    """95 % at 3 mm, 5 % uniform over 1 m to both sides."""
    xi = rng.normal(size=(n, 6)) * NARROW
    out = rng.uniform(size=n) < 0.05
    xi[out, 0] = rng.uniform(-1.0, 1.0, out.sum())
    return xi


def two_clusters(rng: np.random.Generator, n: int) -> Array:
    xi = rng.normal(size=(n, 6)) * NARROW
    xi[rng.uniform(size=n) < 0.5] += [0.3, 0.0, 0.0, 0.0, 0.0, 0.0]
    return xi


def ring_about_a_free_turn(rng: np.random.Generator, n: int) -> Array:
    xi = rng.normal(size=(n, 6)) * NARROW
    xi[:, 5] += rng.normal(size=n) * np.sqrt(CONFIG.variance)
    ring, angle = rng.uniform(size=n) < 0.3, rng.uniform(0.0, 2.0 * np.pi, n)
    xi[ring, 3:5] += np.pi * np.stack([np.cos(angle), np.sin(angle)], axis=1)[ring]
    return xi


def free_along_x(rng: np.random.Generator, n: int) -> Array:
    xi = rng.normal(size=(n, 6)) * NARROW
    xi[:, 0] += rng.normal(size=n) * np.sqrt(CONFIG.variance)
    return xi


def free_turn_of_a_radian(rng: np.random.Generator, n: int) -> Array:
    xi = rng.normal(size=(n, 6)) * NARROW
    xi[:, 5] += rng.normal(size=n) * 0.9
    return xi


def heavy_tails(rng: np.random.Generator, n: int) -> Array:
    """Student's t with 3 degrees of freedom, scales of 1 cm and 5 mrad."""
    return rng.normal(size=(n, 6)) * NOISE / np.sqrt(rng.chisquare(3, n) / 3)[:, None]


def gaussian_of_nine_centimetres(rng: np.random.Generator, n: int) -> Array:
    return rng.normal(size=(n, 6)) * np.repeat([0.09, 0.02], 3)


@pytest.mark.parametrize(
    "distribution",
    [
        mixture,
        two_clusters,
        ring_about_a_free_turn,
        free_along_x,
        free_turn_of_a_radian,
        heavy_tails,
        gaussian_of_nine_centimetres,
    ],
)
def test_the_covariance_does_not_depend_on_the_number_of_samples(
    distribution: Callable[[np.random.Generator, int], Array],
) -> None:
    """Its mean over many draws of n is that of 20 draws of 5000, to four standard errors."""

    def drawn(n: int, repeats: int) -> tuple[Array, Array]:
        diagonals = []
        for k in range(repeats):
            xi = distribution(np.random.default_rng([n, k]), n)
            xi = xi[kept(xi)]
            diagonals.append(np.diag(xi.T @ xi) / (len(xi) - 1))
        return np.mean(diagonals, axis=0), np.std(diagonals, axis=0) / np.sqrt(repeats)

    Y, error = drawn(5000, 20)
    for n, repeats in ((100, 200), (200, 200), (500, 100), (1000, 50)):
        Y_n, error_n = drawn(n, repeats)
        assert (np.abs(Y_n - Y) < 4.0 * np.hypot(error, error_n)).all(), n
        np.testing.assert_allclose(np.sqrt(Y_n), np.sqrt(Y), rtol=0.2, err_msg=str(n))


def test_stragglers_do_not_widen_a_tight_cluster_beyond_one_scale() -> None:
    xi = mixture(np.random.default_rng(9), 5000)
    expected = np.sqrt((0.95 * NARROW[0] ** 2 + 0.005 * 0.1**2 / 3.0) / 0.955)
    assert xi[kept(xi), 0].std() == pytest.approx(expected, rel=0.1)


def test_memory_is_linear_in_samples_that_are_all_neighbours() -> None:
    import tracemalloc

    xi = noise(20_000) * 0.1
    tracemalloc.start()
    assert nearest_cluster(xi, 0.1, 0.05, 0.05).all()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * xi.nbytes
