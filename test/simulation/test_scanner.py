"""Scanners: the elevations of products, times of beams, and the laws of what comes back."""

from dataclasses import replace

import numpy as np
import pytest

from cello3d_ros.simulation.products import SCANNERS, calibrated
from cello3d_ros.simulation.scanner import Echoes, Scanner, measure, returns

PLAIN = Scanner(
    elevations_deg=(0.0,), azimuth_step_deg=0.02, max_range_m=300, range_noise_m=0, missing_share=0
)


def echoes(scanner: Scanner, distance, cosine=1.0, reflectance=None) -> Echoes:
    n = scanner.shape[0] * scanner.shape[1]
    full = None if reflectance is None else np.broadcast_to(float(reflectance), n)
    return Echoes(scanner, np.broadcast_to(distance, n).astype(float), np.full(n, cosine), 0, full)


@pytest.mark.parametrize(
    ("name", "n_beams", "least", "greatest", "finest"),
    [
        ("vlp16", 16, -15.0, 15.0, 2.0),
        ("vlp32c", 32, -25.0, 15.0, 0.333),
        ("hdl32e", 32, -30.67, 10.67, 1.333),
        ("hdl64e", 64, -24.33, 2.0, 0.333),
        ("vls128", 128, -25.0, 15.0, 0.11),
        ("os0_128", 128, -45.0, 45.0, 0.709),
        ("os1_64", 64, -22.5, 22.5, 0.714),
        ("xt32", 32, -16.0, 15.0, 1.0),
        ("pandar40p", 40, -25.0, 15.0, 0.333),
        ("bpearl", 32, 2.31, 89.5, 2.8125),
    ],
)
def test_beams_stand_at_the_elevations_of_the_manual(
    name: str, n_beams: int, least: float, greatest: float, finest: float
) -> None:
    scanner = SCANNERS[name]
    beams = scanner.directions().reshape(*scanner.shape, 3)
    elevation = np.degrees(np.arcsin(beams[:, 0, 2]))
    assert len(elevation) == n_beams
    assert elevation[0] == pytest.approx(least, abs=1e-3)
    assert elevation[-1] == pytest.approx(greatest, abs=1e-3)
    assert np.diff(elevation).min() == pytest.approx(finest, abs=2e-3)
    assert np.ptp(beams[..., 2], axis=1).max() < 1e-12  # a beam keeps its elevation
    assert 0.1 < 360 / scanner.shape[1] < 0.4


@pytest.mark.parametrize("name", ["mid360", "avia"])
def test_a_rosette_does_not_repeat_itself_and_fills_its_field(name: str) -> None:
    scanner = SCANNERS[name]
    first, second = scanner.directions(0), scanner.directions(1)
    assert np.array_equal(first, scanner.directions(0))
    assert np.median(np.linalg.norm(first - second, axis=1)) > 0.05

    def cells(beams):
        angles = np.degrees([np.arctan2(beams[:, 1], beams[:, 0]), np.arcsin(beams[:, 2])])
        return set(zip(*np.floor(angles).astype(int), strict=True))

    one = cells(first)
    ten = set().union(*(cells(scanner.directions(k)) for k in range(10)))
    assert len(ten) > 1.1 * len(one)  # longer looking sees more


@pytest.mark.parametrize("name", SCANNERS)
def test_a_sweep_takes_its_time_once(name: str) -> None:
    scanner = SCANNERS[name]
    times = scanner.times().reshape(scanner.shape)
    assert times.min() == 0.0
    assert scanner.sweep_s * 0.99 < times.max() < scanner.sweep_s
    assert (np.diff(times, axis=1) > 0).all()
    if scanner.pattern == "tilting":
        assert (np.diff(times.ravel()) > 0).all()


def test_noise_grows_with_range_in_quadrature() -> None:
    scanner = replace(PLAIN, range_noise_m=0.01, range_noise_per_m=0.0005)
    for distance in (1.0, 20.0, 100.0):
        ranges = np.linalg.norm(
            measure(echoes(scanner, distance), np.random.default_rng(0)), axis=1
        )
        expected = np.hypot(0.01, 0.0005 * distance)
        assert ranges.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * len(ranges)))
        assert ranges.mean() == pytest.approx(distance, abs=4 * expected / np.sqrt(len(ranges)))


def test_dark_grazing_and_far_surfaces_are_lost_by_the_light_that_comes_back() -> None:
    scanner = replace(PLAIN, reach_m=50.0, grazing_deg=89.9)
    rng = np.random.default_rng(0)

    def share(distance, cosine, reflectance):
        n = scanner.shape[1]
        return len(measure(echoes(scanner, distance, cosine, reflectance), rng)) / n

    assert share(49.9, 1.0, 0.1) == 1.0
    assert share(100.0, 1.0, 0.1) == pytest.approx(0.25**2, abs=0.01)
    assert share(100.0, 1.0, 0.4) == 1.0
    assert share(100.0, 0.5, 0.4) == pytest.approx(0.5**2, abs=0.015)
    assert share(50.0, 0.5, 0.1) == pytest.approx(0.5**2, abs=0.015)


def test_an_edge_gives_points_between_its_sides_as_often_as_the_beam_is_wide() -> None:
    scanner = replace(PLAIN, azimuth_step_deg=0.2, divergence_deg=0.1)
    near_far = np.where(np.arange(scanner.shape[1]) % 2, 5.0, 6.0)  # an edge at every beam
    ranges = np.linalg.norm(measure(echoes(scanner, near_far), np.random.default_rng(0)), axis=1)
    between = (ranges > 5.001) & (ranges < 5.999)
    assert between.mean() == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / len(ranges)))
    assert ranges.min() >= 4.999
    assert ranges.max() <= 6.001
    far_apart = np.where(np.arange(scanner.shape[1]) % 2, 5.0, 60.0)
    ranges = np.linalg.norm(measure(echoes(scanner, far_apart), np.random.default_rng(0)), axis=1)
    assert ((ranges < 5.001) | (ranges > 59.999)).all()  # two returns, not one between


def test_the_stated_share_of_beams_meets_particles_near_the_sensor() -> None:
    scanner = replace(PLAIN, particle_share=0.3, particle_range_m=2.0, min_range_m=0.5)
    points = measure(echoes(scanner, 50.0), np.random.default_rng(0))
    ranges = np.linalg.norm(points, axis=1)
    near = ranges < 49.0
    assert near.mean() == pytest.approx(0.3, abs=0.015)
    assert (ranges[near] - 0.5).mean() == pytest.approx(2.0, rel=0.06)
    sky = measure(echoes(scanner, np.inf), np.random.default_rng(0))
    assert len(sky) / scanner.shape[1] == pytest.approx(0.3, abs=0.015)


def test_a_scanner_without_new_errors_draws_what_it_always_drew() -> None:
    # the recipe of a scan: noise, then what gets lost, then grazing, and nothing else
    scanner = Scanner()
    n = scanner.shape[0] * scanner.shape[1]
    cosines = np.random.default_rng(1).uniform(size=n)
    points, beams = returns(Echoes(scanner, np.full(n, 5.0), cosines), np.random.default_rng(0))
    rng = np.random.default_rng(0)
    noise = 0.01 * rng.normal(size=n)
    luck, gloss = rng.uniform(size=(2, n))
    kept = (luck >= 0.03) & (gloss * np.cos(np.radians(80)) <= cosines)
    assert np.array_equal(beams, np.flatnonzero(kept))
    expected = (5.0 + noise)[kept, None] * scanner.directions()[kept]
    assert np.array_equal(points, expected.astype(np.float32).astype(float))


OFF = Scanner(
    n_beams=8, range_offset_m=0.02, elevation_error_deg=0.5, missing_share=0.0, grazing_deg=0.0
)


def seen(scanner: Scanner, seed: int = 0) -> np.ndarray:
    """Return the points (rows, columns, 3) of a sphere of 10 m, without noise."""
    points = measure(echoes(scanner, 10.0), np.random.default_rng(seed), 0.0)
    return points.reshape(*scanner.shape, 3)


def test_each_beam_has_a_range_and_an_elevation_of_its_own_in_all_scans() -> None:
    points = seen(OFF)
    np.testing.assert_array_equal(points, seen(OFF, seed=1))
    offset = np.linalg.norm(points, axis=2) - 10.0
    error = np.degrees(np.arcsin(points[..., 2] / (10.0 + offset))) - OFF.elevations()[:, None]
    for each, sigma in ((offset, 0.02), (error, 0.5)):
        np.testing.assert_allclose(each, each[:, :1] * np.ones_like(each), rtol=0, atol=1e-5)
        assert 0.3 * sigma < each[:, 0].std() < 2.0 * sigma


def test_errors_of_beams_have_the_stated_deviation_and_no_mean() -> None:
    many = replace(OFF, n_beams=2000, n_columns=1)
    offset = np.linalg.norm(seen(many)[:, 0], axis=1) - 10.0
    assert abs(offset.mean()) < 3 * 0.02 / np.sqrt(2000)
    assert offset.std() == pytest.approx(0.02, rel=0.05)


def test_another_individual_has_other_errors_and_a_nodding_fan_is_one_beam() -> None:
    assert np.abs(seen(OFF) - seen(replace(OFF, serial=1))).max() > 0.01
    fan = replace(OFF, pattern="tilting", azimuth_span_deg=270.0)
    ranges = np.linalg.norm(seen(fan), axis=2)
    assert np.ptp(ranges) < 1e-5
    assert abs(ranges[0, 0] - 10.0) > 1e-4


def test_individuals_have_errors_of_the_stated_size_and_are_else_what_they_are_called() -> None:
    """The geometric mean of many is 8 mm and 0.02 degrees, the factor between them exp(0.6)."""
    sold, rng = SCANNERS["vlp16"], np.random.default_rng(0)
    found = [calibrated(sold, rng) for _ in range(2000)]
    logs = np.log([scanner.range_offset_m for scanner in found])
    assert logs.mean() == pytest.approx(np.log(0.008), abs=3 * 0.6 / np.sqrt(2000))
    assert logs.std() == pytest.approx(0.6, rel=0.05)
    for scanner in found[:5]:
        assert scanner.elevation_error_deg == pytest.approx(2.5 * scanner.range_offset_m)
        plain = {"range_offset_m": 0.0, "elevation_error_deg": 0.0, "serial": 0}
        assert replace(scanner, **plain) == sold
    assert len({scanner.serial for scanner in found}) > 1990
