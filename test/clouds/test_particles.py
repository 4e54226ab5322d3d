"""Snow, rain and dust before walls, by scans of rings."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from rings import scan, to_box

from cello3d_ros.clouds.filters import crop_range
from cello3d_ros.clouds.particles import without_particles
from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, IcpConfig
from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.model import find_model, load_model
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import open_recording

STEP = se3.exp([0.3, 0.1, 0.0, 0.0, 0.0, 0.05])


def in_snow(points, share, seed):
    """Return a scan in which some beams end near the sensor, and which those are."""
    rng = np.random.default_rng(seed)
    ranges = np.linalg.norm(points, axis=1)
    near = rng.exponential(2.0, len(points)) + 0.6
    hit = (rng.random(len(points)) < share) & (near < 0.8 * ranges)
    return points * np.where(hit, near / ranges, 1.0)[:, None], hit


def see(T, n_beams, seed):
    return scan(to_box(12.0, 9.0, 2.5), T, n_beams, (-25.0, 15.0), seed)


def rows(points):
    return {tuple(row) for row in points}


@pytest.mark.parametrize("n_beams", [16, 32, 64, 128])
@pytest.mark.parametrize("share", [0.15, 0.4])
def test_snow_is_dropped_and_walls_stay(n_beams, share):
    points, hit = in_snow(see(np.eye(4), n_beams, 3), share, 4)
    kept = rows(without_particles(points, 0.1))
    is_kept = np.array([tuple(row) in kept for row in points])
    assert is_kept[~hit].mean() > 0.95
    assert is_kept[hit].mean() < 0.05


@pytest.mark.parametrize("n_beams", [16, 32, 64, 128])
def test_a_scan_in_clear_weather_stays_as_it_is(n_beams):
    points, _ = in_snow(see(np.eye(4), n_beams, 3), 0.01, 4)
    assert without_particles(points, 0.1) is points


def test_real_scans_in_clear_weather_stay_as_they_are(evaluation):
    for name in ("street", "hall", "tree_road", "campus_vlp16", "city_hdl64", "harbour_os1_64"):
        for scan_ in itertools.islice(open_recording(evaluation / "data" / name), 2):
            points = crop_range(scan_.points, 0.5, 100.0)
            assert without_particles(points, 0.1) is points


def test_none_few_and_scattered_points_stay():
    scattered = np.random.default_rng(0).normal(size=(2000, 3), scale=5.0)
    for points in (np.zeros((0, 3)), np.eye(3), scattered):
        assert without_particles(points, 0.1) is points


def test_a_thin_pole_in_snow_stays():
    points = see(np.eye(4), 32, 5)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    on_pole = np.abs(azimuth) < 0.01  # 10 cm wide, 5 m away, before a wall at 12 m
    points[on_pole] *= (5.0 / np.hypot(points[on_pole, 0], points[on_pole, 1]))[:, None]
    points, hit = in_snow(points, 0.15, 6)
    kept = rows(without_particles(points, 0.1))
    assert len(kept) < 0.95 * len(points)
    assert np.mean([tuple(row) in kept for row in points[on_pole & ~hit]]) > 0.8


@pytest.mark.parametrize("share", [0.0, 0.15, 0.4])
def test_a_covariance_holds_in_snow(share):
    model = load_model(find_model("general"))
    pipeline = replace(
        model.pipeline,
        cloud=CloudConfig(),
        icp=IcpConfig(n_reference_points=0, n_reading_points=5000),
    )
    estimator, distances = Estimator(model, pipeline=pipeline), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        reading, reference = (
            prepare(
                in_snow(see(T, 64, 2 * seed + i), share, 50 + 2 * seed + i)[0], pipeline.cloud, rng
            )
            for i, T in enumerate((STEP, np.eye(4)))
        )
        found = estimator.register(reading, reference, STEP, rng)
        xi = se3.log(se3.inverse(STEP) @ found.T_ref_read)
        distances.append(xi @ np.linalg.solve(found.covariance, xi) / 6)
    assert np.mean(distances) < 2.0
