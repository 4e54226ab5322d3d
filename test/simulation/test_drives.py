"""Drives: sweeps and their undoing, motions, mounts, what moves meanwhile."""

from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import pytest
from surface_distance import surface_distances

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import Pipeline
from cello3d_ros.geometry import se3
from cello3d_ros.recordings.deskew import deskew
from cello3d_ros.registration.backends import register
from cello3d_ros.simulation.casting import Surroundings, cast
from cello3d_ros.simulation.drives import MOTIONS, Drive
from cello3d_ros.simulation.meshes import Mesh, block, box
from cello3d_ros.simulation.movers import Mover
from cello3d_ros.simulation.paths import Route
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.scanner import Scanner, measure
from cello3d_ros.simulation.simulation import Simulation

pytestmark = pytest.mark.skipif(find_spec("embreex") is None, reason="embreex is not installed")

EXACT = Scanner(n_beams=16, azimuth_step_deg=1.0, range_noise_m=0, missing_share=0, max_range_m=60)
FAST = Drive(speed_m_s=10.0, turn_rad_s=1.0, yaw_deg=40.0, pitch_deg=8.0, roll_deg=-5.0)


@pytest.mark.parametrize("scanner", [EXACT, replace(EXACT, pattern="tilting"),
                                     replace(EXACT, pattern="ring_rosette", n_columns=300),
                                     replace(EXACT, pattern="rosette", n_columns=300)],
                         ids=lambda s: s.pattern)  # fmt: skip
def test_undoing_the_motion_with_the_exact_track_puts_points_on_the_surfaces(scanner) -> None:
    simulation = Simulation("parking", 3, 3, scanner, drive=FAST)
    built, track = simulation.build()[0], simulation.true_track()
    for scan in simulation:
        assert -0.1 <= scan.time_s.min() < -0.099
        assert scan.time_s.max() < 0.0
        straight = deskew(scan, track)
        rows = np.random.default_rng(0).choice(len(scan.points), 300, replace=False)
        on, off = (
            surface_distances(built.mesh, se3.transform(scan.T_world_sensor, s.points[rows]))
            for s in (straight, scan)
        )
        assert (on < 1e-4).mean() > 0.97  # the others are on people
        assert (off < 1e-4).mean() < 0.6  # but along a plane motion is not seen


def test_odometry_undoes_the_motion_of_a_scan_but_for_its_drift() -> None:
    drive = replace(FAST, odometry_share=0.02)
    simulation = Simulation("parking", 3, 6, EXACT, drive=drive)
    off, moved = [], []
    for scan in list(simulation)[1:]:
        truth, odometry = (deskew(scan, t) for t in (simulation.true_track(), simulation.track()))
        ranges = np.linalg.norm(scan.points, axis=1)
        off.append(np.linalg.norm(truth.points - odometry.points, axis=1) / (1 + 0.5 * ranges))
        moved.append(np.linalg.norm(truth.points - scan.points, axis=1))
        assert off[-1][scan.time_s > -0.002].max() < 0.01  # nothing is to be undone at the stamp
    assert np.concatenate(moved).max() > 0.8
    assert 1e-4 < np.median(np.concatenate(off)) < 0.03  # 2 percent of a metre
    track = simulation.track()
    for scan in simulation:
        np.testing.assert_allclose(track.at(scan.stamp_ns), scan.T_odom_sensor, atol=1e-9)


@pytest.mark.parametrize("motion", ["still", "forward"])
def test_a_sweep_without_motion_is_the_frozen_scan(motion: str) -> None:
    drive = Drive(motion=motion, speed_m_s=1e-9, sway_deg=0.0)
    swept = Simulation("tunnel", 1, 2, EXACT, drive=drive)
    frozen = Simulation("tunnel", 1, 2, EXACT, drive=replace(drive, sweeps=False))
    for a, b in zip(swept, frozen, strict=True):
        assert b.time_s is None
        assert np.array_equal(a.T_world_sensor, b.T_world_sensor)
        still = np.linalg.norm(a.points, axis=1)
        assert len(a.points) == pytest.approx(len(b.points), rel=0.01)  # cars go on meanwhile
        assert abs(np.median(still) - np.median(np.linalg.norm(b.points, axis=1))) < 1e-3
    quiet = Mesh(block([-9, -9, -9], [9, 9, 9]).vertices, block([0, 0, 0], [1, 1, 1]).triangles)
    around = Surroundings(quiet)
    poses = np.tile(swept.build()[1][0], (len(EXACT.directions()), 1, 1))
    poses[:, :3, 3] = 0.0
    one, many = cast(around, EXACT, poses[0]), cast(around, EXACT, poses)
    np.testing.assert_allclose(one.distances, many.distances, rtol=1e-14)


def motions(drive: Drive, n: int = 40, world: str = "street", seed: int = 1):
    """Return poses of the robot's base (n, 4, 4) and the twists between them."""
    truth = Simulation(world, seed, n, EXACT, drive=drive).build()[1]
    T = truth @ se3.inverse(drive.T_base_sensor)
    return T, se3.log(se3.inverse(T[:-1]) @ T[1:])


@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 20.0])
@pytest.mark.parametrize(
    ("motion", "ahead"), [("forward", [1, 0]), ("reverse", [-1, 0]), ("sideways", [0, -1])]
)
def test_the_robot_moves_the_stated_way_at_the_stated_speed(motion, ahead, rate_hz) -> None:
    drive = Drive(motion=motion, speed_m_s=3.0, rate_hz=rate_hz, sway_deg=0.0)
    _, xi = motions(drive, 30)
    step = np.linalg.norm(xi[:, :3], axis=1)
    straight = np.abs(xi[:, 5]) < 0.02
    assert straight.sum() > 5
    assert (xi[straight, :2] @ ahead / step[straight] > 0.97).all()
    assert np.median(step) == pytest.approx(3.0 / rate_hz, rel=0.16)
    assert step.max() < 1.2 * 3.0 / rate_hz
    assert np.abs(xi[:, 5]).max() * rate_hz < 1.3 * drive.turn_rad_s


def test_a_spin_turns_on_the_spot_and_a_still_robot_is_still() -> None:
    T, xi = motions(Drive(motion="spin", turn_rad_s=1.0, sway_deg=0.0))
    assert np.abs(T[:, :3, 3] - T[0, :3, 3]).max() < 1e-12
    assert np.linalg.norm(xi[:, 3:], axis=1) == pytest.approx(0.1, rel=0.16)
    T, _ = motions(Drive(motion="still", sway_deg=2.0))
    assert np.array_equal(T, np.broadcast_to(T[0], T.shape))


def test_stop_and_go_stops_and_goes() -> None:
    _, xi = motions(Drive(motion="stop_and_go", speed_m_s=2.0, sway_deg=1.0), 170)
    step = np.linalg.norm(xi[:, :3], axis=1)
    assert step.min() < 0.01
    assert step.max() > 0.35
    assert np.linalg.norm(xi[step < 0.01, 3:], axis=1).max() < 0.01  # no sway at rest


def test_the_mount_stands_at_its_height_turned_by_its_angles() -> None:
    drive = Drive(height_m=2.1, yaw_deg=90.0, pitch_deg=10.0, sway_deg=0.0)
    truth = Simulation("parking", 0, 3, EXACT, drive=drive).build()[1]
    level = Simulation("parking", 0, 3, EXACT, drive=Drive(height_m=0.3, sway_deg=0.0)).build()[1]
    np.testing.assert_allclose(truth[:, :2, 3], level[:, :2, 3], atol=1e-12)
    np.testing.assert_allclose(truth[:, 2, 3] - level[:, 2, 3], 1.8, atol=1e-12)
    left = truth[:, :3, 0] * [1, 1, 0]  # looks to the left, and down
    cosine = np.einsum("ij,ij->i", left, level[:, :3, 1])
    assert cosine == pytest.approx(np.cos(np.radians(10)), abs=1e-9)
    assert truth[:, 2, 0] == pytest.approx(-np.sin(np.radians(10)), abs=1e-9)


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_longer_drive_starts_with_the_shorter_one(motion: str) -> None:
    short, long = (Simulation("square", 2, n, EXACT, drive=Drive(motion=motion)) for n in (2, 5))
    for a, b in zip(short, long, strict=False):
        assert a.stamp_ns == b.stamp_ns
        assert a.points.tobytes() == b.points.tobytes()
        assert a.T_world_sensor.tobytes() == b.T_world_sensor.tobytes()
        assert a.T_odom_sensor.tobytes() == b.T_odom_sensor.tobytes()


def test_a_robot_sees_its_own_body_at_the_same_place_in_every_scan() -> None:
    drive = Drive(body=True, yaw_deg=30.0, speed_m_s=5.0)
    scanner = replace(EXACT, min_elevation_deg=-40.0, min_range_m=0.1)
    bare = Simulation("square", 0, 3, scanner, drive=replace(drive, body=False))
    seen = [
        np.linalg.norm(s.points, axis=1) for s in Simulation("square", 0, 3, scanner, drive=drive)
    ]
    own = [np.sort(r[r < 0.6]) for r in seen]
    assert len(own[0]) > 50
    assert all(np.allclose(r, own[0], atol=1e-6) for r in own)
    assert all(np.linalg.norm(s.points, axis=1).min() > 0.6 for s in bare)


def test_what_moves_is_met_where_it_is_when_the_beam_is_sent() -> None:
    road = Route(np.array([[-50.0, 8.0, 0.0], [50.0, 8.0, 0.0]]), closed=False)
    cube = Mover(box([0, 0, 1], [4, 2, 2]), road, 50.0, 20.0)
    around = Surroundings(block([-99, -99, -3], [99, 99, -2]), movers=[cube])
    scanner = replace(EXACT, n_beams=1, min_elevation_deg=0, max_elevation_deg=0)
    T = np.eye(4)
    T[2, 3] = 1.0
    beams = scanner.directions()
    for time_s in (-0.5, 0.0, 0.5):
        echoes = cast(around, scanner, T, 0, time_s)
        hit = np.isfinite(echoes.distances)
        places = echoes.distances[hit, None] * beams[hit]
        front = places[np.abs(places[:, 1] - 7.0) < 1e-9]
        middle = 20.0 * time_s
        assert len(front) >= 10
        assert np.abs(front[:, 0] - middle).max() <= 2.0
        assert abs(front[:, 0].mean() - middle) < 0.2
    # in a sweep each beam has a time of its own: the front is met where it is by then
    times = np.linspace(-0.3, 0.0, len(beams))
    echoes = cast(around, scanner, T, 0, times)
    hit = np.isfinite(echoes.distances)
    places = echoes.distances[hit, None] * beams[hit] - np.outer(20.0 * times[hit], [1, 0, 0])
    np.testing.assert_allclose(np.abs(places - [0, 8, 0]).max(axis=1) <= 2.0 + 1e-9, True)
    assert len(places) > 10


def test_points_of_a_sweep_lie_on_what_moves_at_their_own_times() -> None:
    scanner = replace(EXACT, n_beams=32, azimuth_step_deg=0.5)
    simulation = Simulation("highway", 4, 3, scanner, drive=Drive(speed_m_s=25.0, height_m=1.8))
    world, track = simulation.build()[0], simulation.true_track()
    start_ns, n_on_movers = simulation.stamps_ns()[0], 0
    for scan in simulation:
        places = se3.transform(scan.T_world_sensor, deskew(scan, track).points)
        time_s = 1e-9 * (scan.stamp_ns - start_ns) + scan.time_s
        for mover in world.movers:
            T = se3.inverse(mover.poses(time_s))
            local = np.einsum("nij,nj->ni", T[:, :3, :3], places) + T[:, :3, 3]
            low, high = mover.mesh.vertices.min(axis=0), mover.mesh.vertices.max(axis=0)
            inside = np.all((local > low - 1e-3) & (local < high + 1e-3), axis=1)
            inside &= local[:, 2] > 0.3  # above the road
            if inside.any():
                assert surface_distances(mover.mesh, local[inside]).max() < 1e-3
                n_on_movers += int(inside.sum())
    assert n_on_movers > 100


def test_glass_is_seen_through_mirrors_and_returns_head_on() -> None:
    room, pane = block([-9, -9, -9], [9, 9, 9]), block([3.0, -8, -8], [3.01, 8, 8])
    clear, glazed = Surroundings(room), Surroundings(room, glass=pane)
    scanner = replace(EXACT, n_beams=64, max_range_m=100)
    a, b = (cast(s, scanner, np.eye(4)).distances for s in (clear, glazed))
    beams = scanner.directions()
    inside = beams[:, 0] > 0.6
    head_on = inside & (beams[:, 0] > 0.986)
    np.testing.assert_allclose(b[head_on] * beams[head_on, 0], 3.0, atol=1e-9)
    oblique = inside & (beams[:, 0] < 0.984)
    changed = np.abs(a - b) > 1e-9
    assert changed[oblique].mean() == pytest.approx(0.125, abs=0.02)
    assert not changed[~inside & (beams[:, 0] < 0)].any()
    ghost = (b[:, None] * beams)[oblique & changed]
    mirrored = ghost * [-1, 1, 1] + [6.0, 0, 0]  # behind the pane as far as the wall before it
    np.testing.assert_allclose(np.abs(mirrored).max(axis=1), 9.0, atol=0.01)


def test_the_points_of_a_still_scanner_change_by_noise_alone() -> None:
    scanner = replace(SCANNERS["vlp16"], azimuth_step_deg=1.0, divergence_deg=0.0)
    simulation = Simulation("warehouse", 5, 2, scanner, drive=Drive(motion="still", sweeps=False))
    first, second = (s.echoes for s in simulation)
    same = np.isclose(first.distances, second.distances, atol=1e-9)
    assert same.mean() > 0.95  # the others are on people
    points = measure(first, np.random.default_rng(0))
    assert len(points) > 0.7 * len(first.distances)


def rms_error(scans, clouds) -> float:
    """Return the error of registering neighbouring scans from the truth, metres."""
    icp = replace(Pipeline().icp, n_reference_points=0, n_reading_points=5000)
    prepared = [prepare(c, Pipeline().cloud, np.random.default_rng(0)) for c in clouds]
    errors = []
    for k, (before, after) in enumerate(pairwise(scans)):
        T = se3.inverse(before.T_world_sensor) @ after.T_world_sensor
        rng = np.random.default_rng(k)
        found = register(prepared[k + 1], prepared[k], T, icp, rng).T_ref_read
        errors.append(np.linalg.norm(se3.log(se3.inverse(T) @ found)[:3]))
    return float(np.sqrt(np.mean(np.square(errors))))


def test_scans_with_their_motion_undone_register_as_well_as_frozen_ones() -> None:
    drive, scanner = Drive(motion="spin", turn_rad_s=1.0), SCANNERS["os1_64"]
    errors = []
    for seed in (1, 2, 3):
        swept = list(simulation := Simulation("office", seed, 7, scanner, drive=drive))
        instants = replace(drive, sweeps=False)
        frozen = list(Simulation("office", seed, 7, scanner, drive=instants))
        track = simulation.true_track()
        errors.append(
            [
                rms_error(swept, [deskew(s, track).points for s in swept]),
                rms_error(frozen, [s.points for s in frozen]),
                rms_error(swept, [s.points for s in swept]),
            ]
        )
    undone, still, raw = np.sqrt(np.mean(np.square(errors), axis=0))
    assert undone < 1.3 * still
    assert raw > 2.5 * still
