"""Worlds from YAML files: what is described is what is scanned; paths, presets, many seeds."""

import argparse
from pathlib import Path

import numpy as np
import pytest
from surface_distance import surface_distances

from cello3d_ros.cli import simulate as verb
from cello3d_ros.errors import ConfigError, RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.poses import tum_line
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.scanner import Scanner
from cello3d_ros.simulation.simulation import Simulation
from cello3d_ros.simulation.world_files import load_world

ROUTE = "route: {closed: false, corners: [[-5, 0], [5, 0]]}\n"
YARD = (
    """
parts:
  - trees: {count: 5, side: 30, height: [4, 6]}
  - box: {center: [0, 4, 1], size: [2, 1, 2], yaw_deg: 30}
  - cylinder: {base: [3, -4, 0], height: 3, radius: 0.4}
  - stairs: {foot: [-4, 3, 0], steps: 6, rise: 0.2, tread: 0.3, width: 1.5}
  - terrain: {size: [40, 40], height_std: 0.1, roughness: 0.01}
"""
    + ROUTE
)
COARSE = Scanner(n_beams=8, azimuth_step_deg=3.0)


def world(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "yard.yaml"
    path.write_text(text)
    return path


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    return parser.parse_args(words)


def test_every_part_is_in_the_mesh(tmp_path: Path) -> None:
    mesh, route = load_world(world(tmp_path, YARD), np.random.default_rng(0))
    assert np.isfinite(mesh.vertices).all()
    for place in ([0, 4, 2], [3, -4, 3], [-4 + 1.8, 3 - 0.75, 1.2]):
        near = np.linalg.norm(mesh.vertices - place, axis=1).min()
        assert near < 1.2  # a corner of the box, the rim of the cylinder, the topmost step
    assert np.ptp(route.points[:, 2]) > 0.0  # the route lies on the terrain
    assert np.allclose(np.abs(mesh.vertices[:, :2]).max(axis=0) // 1, 20)


def test_the_seed_decides_what_the_file_leaves_open(tmp_path: Path) -> None:
    path = world(tmp_path, YARD)
    first, again, other = (load_world(path, np.random.default_rng(s))[0] for s in (1, 1, 2))
    assert np.array_equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape or not np.allclose(
        first.vertices, other.vertices
    )


def test_scans_of_a_box_lie_on_the_box(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    text = "parts:\n  - box: {center: [0, 0, 1], size: [14, 8, 6]}\n" + ROUTE
    simulation = Simulation(str(world(tmp_path, text)), 0, 3, COARSE)
    assert simulation.name == "yard-0"
    mesh = simulation.build()[0].mesh
    for scan in simulation:
        moved = se3.transform(scan.T_world_sensor, scan.points)
        assert surface_distances(mesh, moved).max() < 0.06
        assert len(scan.points) > 100


def test_a_mesh_file_is_read(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    o3d.io.write_triangle_mesh(
        str(tmp_path / "cube.obj"), o3d.geometry.TriangleMesh.create_box(2.0, 2.0, 2.0)
    )
    text = "parts:\n  - mesh: {file: cube.obj, scale: 2, at: [1, 1, 0]}\n" + ROUTE
    mesh, _ = load_world(world(tmp_path, text), np.random.default_rng(0))
    assert np.allclose(mesh.vertices.min(axis=0), [1, 1, 0])
    assert np.allclose(mesh.vertices.max(axis=0), [5, 5, 4])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected 'parts' and 'route'"),
        ("a: [", "cannot be read"),
        ("walls: []\n", "unknown key 'walls'"),
        ("parts: []\n" + ROUTE, "at least one part"),
        ("parts: [box]\n" + ROUTE, "part 1: expected one of box"),
        ("parts: [{sphere: {}}]\n" + ROUTE, "part 1: unknown kind 'sphere'; known are box"),
        ("parts: [{box: {center: [0, 0, 0]}}]\n" + ROUTE, "part 1: box: .*size"),
        ("parts: [{box: {center: [0, 0, 0], size: [1, 0, 1]}}]\n" + ROUTE, "above 0"),
        ("parts: [{box: {center: [0, .nan, 0], size: [1, 1, 1]}}]\n" + ROUTE, "3 numbers"),
        ("parts: [{box: {centre: [0, 0, 0]}}]\n" + ROUTE, "part 1: box: .*'centre'"),
        ("parts: [{box: 5}]\n" + ROUTE, "part 1: box"),
        ("parts: [{cylinder: {base: [0, 0, 0], height: x, radius: 1}}]\n" + ROUTE, "height must"),
        ("parts: [{stairs: {foot: [0, 0, 0], steps: 1.0e+9}}]\n" + ROUTE, "steps must"),
        ("parts: [{terrain: {size: [1.0e+6, 1.0e+6]}}]\n" + ROUTE, "1e7 steps"),
        ("parts: [{mesh: {file: gone.obj}}]\n" + ROUTE, r"gone\.obj: no such file"),
        ("parts: [{box: {center: [0, 0, 0], size: [1, 1, 1]}}]\n", "route: expected corners"),
        (
            "parts: [{box: {center: [0, 0, 0], size: [1, 1, 1]}}]\nroute: {corners: [[0, 0]]}\n",
            "too few corners",
        ),
    ],
)
def test_a_wrong_file_is_one_sentence_naming_the_part(tmp_path: Path, text, message) -> None:
    path = world(tmp_path, text)
    with pytest.raises(RecordingError, match=message) as caught:
        load_world(path, np.random.default_rng(0))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_sensor_is_carried_along_a_path_file(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    poses = se3.exp([[0.1 * k, 0, 0.5, 0, 0, 0.05 * k] for k in range(5)])
    path = tmp_path / "path.tum"
    path.write_text("".join(tum_line(10**18 + 7 * k, T) for k, T in enumerate(poses)))
    words = ["rooms", "--scans", "3", "--path", str(path), "--scanner", "narrow"]
    verb.run(parsed(*words, "--out", str(tmp_path / "bag")))
    for k, scan in enumerate(open_recording(tmp_path / "bag")):
        assert scan.stamp_ns == 10**18 + 7 * k
        assert np.allclose(scan.T_world_sensor, poses[k], atol=1e-12)
    with pytest.raises(RecordingError, match="has 5 poses for 6 scans"):
        Simulation("rooms", 0, 6, COARSE, path).build()


def test_many_seeds_at_once_are_bags_of_their_own(tmp_path: Path, capsys) -> None:
    pytest.importorskip("embreex")
    out = tmp_path / "many"
    words = ["corridor", "--seed", "3", "--seeds", "2", "--scans", "2"]
    verb.run(parsed(*words, "--set", "azimuth_step_deg=3", "--out", str(out)))
    assert sorted(p.name for p in out.iterdir()) == ["corridor-3", "corridor-4"]
    alone = Simulation("corridor", 4, 2, Scanner(azimuth_step_deg=3.0))
    for made, kept in zip(alone, open_recording(out / "corridor-4"), strict=True):
        assert np.array_equal(made.points, kept.points)
    assert "4: 2 scans of corridor-4" in capsys.readouterr().out


def test_properties_of_the_scanner_can_be_set() -> None:
    changed = verb.changed(Scanner(), ["range_noise_m=0.05", "n_beams=4"])
    assert changed == Scanner(range_noise_m=0.05, n_beams=4)
    with pytest.raises(RecordingError, match="known are pattern, n_beams"):
        verb.changed(Scanner(), ["noise=1"])
    with pytest.raises(RecordingError, match="'a few' is no number"):
        verb.changed(Scanner(), ["n_beams=a few"])
    with pytest.raises(ConfigError, match="range_noise_m is out of range"):
        verb.changed(Scanner(), ["range_noise_m=-1"])


def test_the_tilting_scanner_is_a_fan_that_nods() -> None:
    scanner = SCANNERS["tilting_hokuyo"]
    beams = scanner.directions().reshape(scanner.n_beams, -1, 3)
    for fan in beams[::20]:
        assert np.linalg.matrix_rank(fan, tol=1e-9) == 2  # each fan lies in a plane
    behind = np.degrees(np.arctan2(beams[..., 1], beams[..., 0]))
    assert np.abs(behind).max() > 130  # 270 degrees: it sees backwards past its sides
    straight = Scanner(pattern="tilting", n_beams=1, min_elevation_deg=0, max_elevation_deg=0)
    level = Scanner(n_beams=1, min_elevation_deg=0, max_elevation_deg=0)
    assert np.allclose(straight.directions(), level.directions())
