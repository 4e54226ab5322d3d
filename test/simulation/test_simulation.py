"""Simulated recordings: reproducible, true to their mesh, noisy as asked, clear of objects."""

from importlib.util import find_spec

import numpy as np
import pytest
from surface_distance import surface_distances

from cello3d_ros.errors import ConfigError, RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.simulation.casting import Surroundings, cast
from cello3d_ros.simulation.meshes import block, join, moved
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.scanner import Scanner, measure
from cello3d_ros.simulation.simulation import Simulation, simulate
from cello3d_ros.simulation.worlds import WORLDS, build_world

COARSE = Scanner(n_beams=8, azimuth_step_deg=3.0)
pytestmark = pytest.mark.skipif(find_spec("embreex") is None, reason="embreex is not installed")


def scan(scene, scanner, T_world_sensor, rng):
    return measure(cast(scene, scanner, T_world_sensor), rng)


@pytest.mark.parametrize("world", WORLDS)
def test_the_same_seed_gives_the_same_bits(world: str) -> None:
    first, second = (list(simulate(world, 3, 4, COARSE)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert a.points.tobytes() == b.points.tobytes()
        assert a.T_world_sensor.tobytes() == b.T_world_sensor.tobytes()
        assert a.T_odom_sensor.tobytes() == b.T_odom_sensor.tobytes()


def test_a_longer_simulation_starts_with_the_shorter_one() -> None:
    short, long = list(simulate("rooms", 1, 3, COARSE)), list(simulate("rooms", 1, 6, COARSE))
    for a, b in zip(short, long[:3], strict=True):
        assert a.points.tobytes() == b.points.tobytes()
        assert np.array_equal(a.T_odom_sensor, b.T_odom_sensor)


def test_another_seed_changes_scans_path_and_odometry() -> None:
    first, second = (list(simulate("hall", seed, 3, COARSE)) for seed in (0, 1))
    for a, b in zip(first, second, strict=True):
        assert a.points.shape != b.points.shape or not np.allclose(a.points, b.points)
        assert np.abs(a.T_world_sensor - b.T_world_sensor).max() > 1e-3
    assert np.abs(first[2].T_odom_sensor - second[2].T_odom_sensor).max() > 1e-3


@pytest.mark.parametrize("world", ["garden", "wood"])
def test_no_foliage_hangs_into_the_way(world: str) -> None:
    built = build_world(world, np.random.default_rng(3))
    corners = built.mesh.vertices[built.mesh.triangles]
    middles = corners[np.ptp(corners, axis=1).max(axis=1) < 0.3].mean(axis=1)
    distance, nearest = built.route.nearest(middles[:, :2])
    above = middles[:, 2] - built.route.points[nearest, 2]
    assert not ((distance < 0.55) & (above > 0.4) & (above < 2.3)).any()
    assert ((distance < 3.0) & (above > 0.4)).sum() > 50  # but there is some beside it


@pytest.mark.parametrize(
    ("summer", "other", "least", "most"),
    [("garden", "garden_winter", 0.05, 0.12), ("wood", "wood_autumn", 0.3, 0.4)],
)
def test_another_season_is_the_same_place_with_fewer_leaves(
    summer: str, other: str, least: float, most: float
) -> None:
    full, thin = (build_world(name, np.random.default_rng(4)) for name in (summer, other))
    assert np.array_equal(full.route.points, thin.route.points)
    assert np.array_equal(full.mesh.vertices, thin.mesh.vertices)
    kept = {tuple(t) for t in thin.mesh.triangles}
    everything = {tuple(t) for t in full.mesh.triangles}
    assert kept < everything
    uses = np.bincount(full.mesh.triangles.ravel())  # a leaf shares no corner
    assert (uses[sorted(everything - kept)] == 1).all()  # nothing but leaves fell
    n_leaves = (uses[full.mesh.triangles] == 1).all(axis=1).sum()
    assert least < 1.0 - len(everything - kept) / n_leaves < most


@pytest.mark.parametrize("world", WORLDS)
def test_another_seed_builds_another_layout_of_another_size(world: str) -> None:
    meshes = [build_world(world, np.random.default_rng(seed)).mesh for seed in (0, 1)]
    sizes = [np.ptp(mesh.vertices, axis=0) for mesh in meshes]
    assert np.abs(sizes[0] - sizes[1]).max() > 0.05
    assert meshes[0].vertices.shape != meshes[1].vertices.shape or not np.allclose(
        meshes[0].vertices, meshes[1].vertices, atol=0.1
    )


@pytest.mark.parametrize("world", WORLDS)
def test_triangles_index_finite_vertices(world: str) -> None:
    mesh = build_world(world, np.random.default_rng(5)).mesh
    assert np.isfinite(mesh.vertices).all()
    assert mesh.triangles.min() >= 0
    assert mesh.triangles.max() < len(mesh.vertices)


@pytest.mark.parametrize("world", WORLDS)
def test_points_moved_by_ground_truth_lie_on_the_mesh_within_noise(world: str) -> None:
    simulation = Simulation(world, 2, 2, Scanner(azimuth_step_deg=2.0, range_noise_m=0.01))
    built = simulation.build()[0]
    for k, s in enumerate(simulation):
        parts = [built.mesh, *([built.glass] if built.glass else [])]
        for mover in built.movers:
            T = mover.poses(0.5 * k)
            parts.append(moved(mover.mesh, T[:3, 3], np.arctan2(T[1, 0], T[0, 0])))
        chosen = np.random.default_rng(k).choice(len(s.points), 200, replace=False)
        places = se3.transform(s.T_world_sensor, s.points[chosen])
        distance = surface_distances(join(parts), places)
        if built.glass:  # some of what a pane mirrors is seen where nothing is
            assert (distance > 0.06).mean() < 0.06
            distance = distance[distance < 0.06]
        assert distance.max() < 0.06  # six deviations of the range
        assert np.sqrt(np.mean(distance**2)) < 0.0115  # by no more than the range is off


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("seed", [0, 11, 12])
def test_the_path_keeps_clear_of_every_object(world: str, seed: int) -> None:
    built, truth, _ = Simulation(world, seed, 80).build()
    places = truth[:, :3, 3]
    parts = [built.mesh, *([built.glass] if built.glass else [])]
    assert surface_distances(join(parts), places, 0.3).min() > 0.25
    steps = np.diff(places, axis=0)
    length = np.linalg.norm(steps, axis=1)
    met = Surroundings(join(parts)).meet(places[:-1], steps / length[:, None])
    assert (met.distances > length).all()  # no wall is walked through


@pytest.mark.parametrize("world", WORLDS)
def test_steps_and_turns_are_those_of_a_walk(world: str) -> None:
    _, truth, _ = Simulation(world, 4, 120).build()
    motion = se3.log(se3.inverse(truth[:-1]) @ truth[1:])
    step, turn = np.linalg.norm(motion[:, :3], axis=1), np.linalg.norm(motion[:, 3:], axis=1)
    assert step.min() > 0.2
    assert step.max() < 1.1
    assert np.degrees(turn.max()) < 18.0
    assert all(se3.is_rigid(T, 1e-9) for T in truth)
    up = truth[:, 2, 2]
    assert 0.0 < np.degrees(np.arccos(up)).max() < 10.0  # it sways, but stays upright
    assert np.ptp(truth[:, 2, 3]) > 0.03


def test_scans_are_half_a_second_apart_and_finite() -> None:
    scans = list(simulate("hall", 0, 3, COARSE))
    stamps = [s.stamp_ns for s in scans]
    assert stamps[0] > 0
    assert np.diff(stamps).tolist() == [500_000_000, 500_000_000]
    for s in scans:
        assert s.points.dtype == np.float64
        assert len(s.points) > 100
        assert np.isfinite(s.points).all()
        assert np.array_equal(s.points, s.points.astype(np.float32))


def cube_scan(scanner: Scanner, seed: int = 0):
    """Scan the inside of a cube of 8 m from its middle."""
    scene = Surroundings(block([-4, -4, -4], [4, 4, 4]))
    return scan(scene, scanner, np.eye(4), np.random.default_rng(seed))


def true_ranges(points):
    """Return the distance of the cube's walls along each point's direction."""
    return 4.0 / np.abs(points / np.linalg.norm(points, axis=1, keepdims=True)).max(axis=1)


def test_range_noise_has_the_stated_deviation_and_no_bias() -> None:
    points = cube_scan(Scanner(range_noise_m=0.02, azimuth_step_deg=0.3))
    error = np.linalg.norm(points, axis=1) - true_ranges(points)
    assert len(error) > 30_000
    assert abs(error.mean()) < 4 * 0.02 / np.sqrt(len(error))
    assert abs(error.std() / 0.02 - 1) < 0.02
    assert abs(np.mean(error**4) / error.var() ** 2 - 3) < 0.15  # Gaussian kurtosis


def test_without_noise_ranges_are_exact() -> None:
    points = cube_scan(Scanner(range_noise_m=0.0, missing_share=0.0, grazing_deg=0.0))
    assert np.abs(np.linalg.norm(points, axis=1) - true_ranges(points)).max() < 1e-5


def test_the_stated_share_of_returns_is_missing() -> None:
    full = cube_scan(Scanner(missing_share=0.0, grazing_deg=89.0))
    assert len(full) == 32 * 600
    part = cube_scan(Scanner(missing_share=0.25, grazing_deg=89.0))
    assert abs(len(part) / len(full) - 0.75) < 4 * np.sqrt(0.25 * 0.75 / len(full))


def test_grazing_returns_are_lost_in_proportion_to_the_cosine() -> None:
    # seen from 0.5 m above a large floor, cos(incidence) = 0.5 / range
    scene = Surroundings(block([-60, -60, -1], [60, 60, -0.5]))
    scanner = Scanner(
        n_beams=1, min_elevation_deg=-5, max_elevation_deg=-5, azimuth_step_deg=0.02,
        range_noise_m=0, missing_share=0, grazing_deg=80,
    )  # fmt: skip
    n = len(scan(scene, scanner, np.eye(4), np.random.default_rng(0)))
    expected = np.sin(np.radians(5)) / np.cos(np.radians(80))
    assert abs(n / 18_000 - expected) < 4 * np.sqrt(expected * (1 - expected) / 18_000)


def test_ranges_outside_the_limits_give_no_point() -> None:
    far = cube_scan(Scanner(max_range_m=4.5))
    assert np.linalg.norm(far, axis=1).max() <= 4.5
    near = cube_scan(Scanner(min_range_m=4.5))
    assert np.linalg.norm(near, axis=1).min() >= 4.5
    assert len(cube_scan(Scanner(max_range_m=3.0))) == 0


def test_points_are_in_the_sensor_frame() -> None:
    scene = Surroundings(block([-4, -4, -4], [4, 4, 4]))
    T = se3.exp([0.5, -0.3, 0.2, 0.1, 0.2, 1.0])
    exact = Scanner(range_noise_m=0, missing_share=0)
    points = scan(scene, exact, T, np.random.default_rng(0))
    moved = se3.transform(T, points)
    assert np.abs(np.abs(moved).max(axis=1) - 4.0).max() < 1e-5


@pytest.mark.parametrize("preset", SCANNERS)
def test_beams_of_a_preset_are_unit_vectors_within_its_field_of_view(preset: str) -> None:
    scanner = SCANNERS[preset]
    beams = scanner.directions(5)
    assert len(beams) == scanner.shape[0] * scanner.shape[1] == len(scanner.times())
    assert np.allclose(np.linalg.norm(beams, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(beams[:, 2]))
    low, high = scanner.elevations().min(), scanner.elevations().max()
    assert elevation.min() == pytest.approx(low, abs=0.3 if "rosette" in scanner.pattern else 1e-2)
    assert elevation.max() == pytest.approx(
        high, abs=0.3 if "rosette" in scanner.pattern else 1e-2
    )
    azimuth = np.degrees(np.arctan2(beams[:, 1], beams[:, 0]))
    assert np.ptp(azimuth) == pytest.approx(scanner.azimuth_span_deg, rel=0.03)
    assert len(np.unique(beams.round(9), axis=0)) == len(beams)


def test_a_narrow_scanner_looks_forward_only() -> None:
    beams = Scanner(azimuth_span_deg=70).directions()
    assert np.degrees(np.abs(np.arctan2(beams[:, 1], beams[:, 0]))).max() <= 35.0


def test_the_default_scan_of_rooms_has_15_to_20_thousand_points() -> None:
    (only,) = simulate("rooms", 0, 1)
    assert 15_000 < len(only.points) < 20_000


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_beams", 0), ("min_elevation_deg", 20.0), ("azimuth_step_deg", 0.0),
     ("min_range_m", 30.0), ("range_noise_m", -1.0), ("missing_share", 1.5),
     ("grazing_deg", 90.0), ("max_range_m", float("nan"))],
)  # fmt: skip
def test_a_scanner_out_of_range_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=r"Scanner\.\w+ is out of range"):
        Scanner(**{name: value})


def test_an_unknown_world_is_refused_with_those_known() -> None:
    with pytest.raises(RecordingError, match=r"moon.*rooms, hall, corridor"):
        next(simulate("moon", 0, 1, COARSE))


@pytest.mark.parametrize(("seed", "n_scans"), [(-1, 3), (0, 0)])
def test_a_negative_seed_and_no_scans_are_refused(seed: int, n_scans: int) -> None:
    with pytest.raises(RecordingError):
        simulate("rooms", seed, n_scans, COARSE)
