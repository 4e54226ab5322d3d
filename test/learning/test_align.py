"""Alignment: its poses against exact truth, its laws, and recordings with something wrong."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.clouds.filters import cell_means
from cello3d_ros.clouds.neighbors import build_tree
from cello3d_ros.clouds.shape import local_shape, prepare
from cello3d_ros.config import CloudConfig, IcpConfig, Pipeline
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, transform
from cello3d_ros.learning.align import Alignment, _split, align
from cello3d_ros.learning.align_carried import carried_of
from cello3d_ros.learning.align_chain import share_on_surfaces
from cello3d_ros.learning.align_report import sentences
from cello3d_ros.learning.align_scans import ScanStore, ShapedScan
from cello3d_ros.learning.align_smear import smear_of
from cello3d_ros.learning.align_sweeps import (
    AlignSettings,
    cloud_of,
    common_normals,
    neighbors_of,
)
from cello3d_ros.recordings.poses import tum_line
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.simulation import Simulation

N_SCANS = 7
SETTINGS = AlignSettings(Pipeline(icp=IcpConfig(n_reading_points=1000)))


class Clouds:
    """A recording of given scans."""

    n_projected = 0

    def __init__(self, scans: Sequence[Scan], name: str = "clouds") -> None:
        self.scans, self.name = scans, name

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans)

    def track(self) -> None: ...


def box_points(rng: np.random.Generator, n: int, size: Array) -> Array:
    """Return points (n, 3) on the surface of a box centred on the origin."""
    points = rng.uniform(-0.5, 0.5, (n, 3))
    rows, axis = np.arange(n), rng.choice(3, n, p=(1 / size) / (1 / size).sum())
    points[rows, axis] = np.where(rng.uniform(size=n) < 0.5, -0.5, 0.5)
    return points * size


def surfaces(seed: int, n: int = 6000) -> Array:
    """Return points of a furnished room; another seed is another room."""
    rng = np.random.default_rng(seed)
    size = np.array([8.0 + 3.0 * seed, 6.0 + seed, 3.0])
    boxes = [box_points(rng, n // 2, size)]
    for _ in range(5):
        box = box_points(rng, n // 10, rng.uniform(0.4, 2.0, 3))
        boxes.append(box + rng.uniform(-0.4, 0.4, 3) * size)
    return np.concatenate(boxes)


def true_poses(n: int = N_SCANS, step_m: float = 0.3) -> Array:
    """Return poses (n, 4, 4) of a slight curve."""
    step = exp(np.array([step_m, 0.02, 0.01, 0.005, 0.01, 0.04]))
    T = [np.eye(4)]
    for _ in range(n - 1):
        T.append(T[-1] @ step)
    return np.array(T)


def scans_of(room: int, truth: Array, first_ns: int = 0, noise_m: float = 0.01) -> list[Scan]:
    """Return scans of a room, each of points of its own, 0.1 s apart."""
    found = []
    for k, T in enumerate(truth):
        rng = np.random.default_rng([room, k])
        points = transform(inverse(T), surfaces(room, 12000))
        points = points[rng.choice(len(points), 4000, replace=False)]
        points += rng.normal(scale=noise_m, size=points.shape)
        found.append(Scan(stamp_ns=first_ns + (k + 1) * 100_000_000, points=points))
    return found


def step_errors(found: Alignment, truth: Array) -> Array:
    """Return the errors (n - 1, 6) of the steps."""
    steps, exact = (inverse(T[:-1]) @ T[1:] for T in (found.poses, truth))
    return np.asarray(log(inverse(exact) @ steps))


@pytest.fixture(scope="module")
def room() -> tuple[list[Scan], Array, Alignment]:
    """A room, its true poses and its alignment from nothing but the clouds."""
    truth = true_poses()
    scans = scans_of(1, truth)
    return scans, truth, align(Clouds(scans), SETTINGS)


def test_joint_poses_are_nearer_the_truth_than_pairwise_ones(
    room: tuple[list[Scan], Array, Alignment],
) -> None:
    _, truth, found = room
    errors = step_errors(found, truth)
    joint_m = np.sqrt((errors[:, :3] ** 2).sum(axis=1).mean())
    assert found.n_parts == 1
    assert not found.reasons
    assert not found.part.any()
    assert joint_m < 0.5 * found.pairwise_rms()[0]
    assert joint_m < 0.002


def test_alignments_say_how_near_the_truth_they_are(
    room: tuple[list[Scan], Array, Alignment],
) -> None:
    _, truth, found = room
    other = align(Clouds(scans_of(2, truth)), SETTINGS)
    expected = np.mean([alignment.sigmas()[0] ** 2 for alignment in (found, other)])
    errors = np.concatenate([step_errors(alignment, truth) for alignment in (found, other)])
    ratio = np.sqrt(expected / (errors[:, :3] ** 2).sum(axis=1).mean())
    assert 0.5 < ratio < 1.5


def test_the_same_recording_gives_the_same_bits_with_any_threads_and_after_an_interrupt(
    room: tuple[list[Scan], Array, Alignment], tmp_path: Path
) -> None:
    scans, _, found = room
    calls = 0

    def interrupt(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls == 2 * N_SCANS + 3:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cello3d_ros.learning.align._SAVE_S", 0.0)
        with pytest.raises(KeyboardInterrupt):
            align(Clouds(scans), SETTINGS, folder=tmp_path, progress=interrupt)
        again = align(Clouds(scans), SETTINGS._replace(n_threads=2), folder=tmp_path)
    np.testing.assert_array_equal(again.poses, found.poses)
    np.testing.assert_array_equal(again.covariances, found.covariances)
    other = Clouds(scans_of(2, true_poses()))
    with pytest.raises(RecordingError, match="another recording or start; remove it"):
        align(other, SETTINGS, folder=tmp_path)


def test_the_frame_of_the_start_is_kept_and_its_errors_are_not(
    room: tuple[list[Scan], Array, Alignment],
) -> None:
    scans, truth, _ = room
    M = exp(np.array([100.0, -20.0, 3.0, 0.0, 0.0, 2.0]))
    rng = np.random.default_rng(3)
    rough = M @ truth @ exp(rng.normal(size=(N_SCANS, 6)) * np.repeat([0.05, 0.01], 3))
    start = PoseTrack.of_poses([scan.stamp_ns for scan in scans], rough)
    found = align(Clouds(scans), SETTINGS, start)
    np.testing.assert_allclose(found.poses[0], rough[0], atol=1e-9)
    assert np.abs(step_errors(found, truth)[:, :3]).max() < 0.005
    assert found.n_contradicted == 0


def test_poses_that_contradict_the_clouds_are_counted_and_the_clouds_followed(
    room: tuple[list[Scan], Array, Alignment],
) -> None:
    scans, truth, _ = room
    wrong = truth.copy()
    wrong[4:] = truth[4:] @ exp(np.array([0.8, 0.5, 0.0, 0.0, 0.0, 0.4]))
    start = PoseTrack.of_poses([scan.stamp_ns for scan in scans], wrong)
    found = align(Clouds(scans), SETTINGS, start)
    assert found.n_contradicted == 1
    assert np.abs(step_errors(found, truth)[:, :3]).max() < 0.005


def test_two_places_make_two_parts_and_a_stray_scan_is_left_out() -> None:
    first, second = scans_of(1, true_poses(4)), scans_of(4, true_poses(5), first_ns=10**9)
    stray = replace(scans_of(9, true_poses(1))[0], stamp_ns=950_000_000)
    found = align(Clouds([*first, stray, *second]), SETTINGS)
    assert found.part.tolist() == [1] * 4 + [-1] + [0] * 5
    assert found.reasons == {4: "holds to none of the scans around it"}


def test_empty_and_repeated_scans_are_left_out_by_name(
    room: tuple[list[Scan], Array, Alignment],
) -> None:
    scans, truth, _ = room
    bad = list(scans)
    bad[2] = replace(scans[2], points=np.zeros((0, 3)))
    bad[5] = replace(scans[5], points=scans[4].points)
    found = align(Clouds(bad), SETTINGS)
    kept = [0, 1, 3, 4, 6]
    assert found.members().tolist() == kept
    assert found.reasons[2].startswith("0 of 0 points are left")
    assert found.reasons[5] == "repeats the scan before"
    steps = inverse(found.poses[kept[:-1]]) @ found.poses[kept[1:]]
    exact = inverse(truth[kept[:-1]]) @ truth[kept[1:]]
    assert np.abs(log(inverse(exact) @ steps)[:, :3]).max() < 0.005


@pytest.mark.parametrize(
    ("rooms", "sentence"),
    [
        ([1, 1], "has 2 scans; aligning needs at least 3"),
        ([1, 1, 1], "no 3 of the 3 scans of clouds hold to one another"),
        ([1, 4, 9], "no 3 of the 3 scans of clouds hold to one another"),
    ],
)
def test_nothing_is_made_of_too_few_scans(rooms: list[int], sentence: str) -> None:
    scans = [
        replace(scans_of(room, true_poses(1))[0], stamp_ns=(k + 1) * 10**8)
        for k, room in enumerate(rooms)
    ]
    with pytest.raises(RecordingError, match=sentence):
        align(Clouds(scans), SETTINGS)


def test_the_motion_within_scans_is_undone() -> None:
    truth = true_poses(N_SCANS, step_m=0.5)
    step = log(inverse(truth[0]) @ truth[1])
    swept = []
    for scan in scans_of(1, truth):
        time_s = np.linspace(0.0, 0.1, len(scan.points))[
            np.argsort(np.argsort(np.arctan2(scan.points[:, 1], scan.points[:, 0])))
        ]
        T = inverse(exp(time_s[:, None] / 0.1 * step))
        points = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3]
        swept.append(replace(scan, points=points, time_s=time_s))
    found = align(Clouds(swept), SETTINGS)
    smeared = align(Clouds([replace(scan, time_s=None) for scan in swept]), SETTINGS)
    assert found.compensated
    assert not smeared.compensated

    def worst(alignment: Alignment) -> float:
        return float(np.abs(step_errors(alignment, truth)[1:-1, :3]).max())

    assert worst(found) < 0.005
    assert worst(found) < 0.5 * worst(smeared)
    assert found.smear is None


@pytest.mark.parametrize("sweeps", [True, False])
def test_scans_without_times_are_said_to_be_smeared_where_they_are(
    sweeps: bool, room: tuple[list[Scan], Array, Alignment]
) -> None:
    drive = Drive(speed_m_s=5.0, turn_rad_s=0.5, sweeps=sweeps)
    scans = list(Simulation("street", 1, 7, SCANNERS["vlp16"], drive=drive))
    poses = np.array([scan.T_world_sensor for scan in scans])

    def shaped(k: int) -> ShapedScan:
        return ShapedScan(*prepare(scans[k].points, CloudConfig(), np.random.default_rng(k))[:2])

    smear = smear_of(poses, np.arange(len(scans)), shaped, 0)
    assert smear is not None
    assert smear.is_smeared == sweeps
    assert abs(smear.share - sweeps) < 0.1
    assert smear.moved_m > 0.15
    assert smear.undone_m < 0.8 * smear.as_is_m or not sweeps
    said = list(sentences(replace(room[2], smear=smear)))
    assert any(s.startswith("warning: the sensor's motion smears") for s in said) == sweeps


@pytest.mark.parametrize("carried", [True, False])
def test_a_vehicle_that_moves_with_the_sensor_is_found(
    carried: bool, room: tuple[list[Scan], Array, Alignment]
) -> None:
    rng = np.random.default_rng(6)
    bow = box_points(rng, 600, np.array([1.0, 0.8, 0.3])) + [1.2, 0.0, -0.6]
    clouds = [np.concatenate([s.points, bow]) if carried else s.points for s in room[0]]

    def shaped(k: int) -> ShapedScan:
        noisy = clouds[k] + np.random.default_rng(k).normal(scale=0.005, size=clouds[k].shape)
        return ShapedScan(*prepare(noisy, CloudConfig(), np.random.default_rng(k))[:2])

    found = carried_of(room[1], np.arange(N_SCANS), shaped)
    assert found is not None
    assert found.is_many == carried
    said = list(sentences(replace(room[2], carried=found)))
    assert any("% of the points move with the sensor" in s for s in said) == carried
    assert 1.0 < found.reach_m < 2.5 or not carried


def test_poses_that_do_not_come_to_rest_are_named(
    room: tuple[list[Scan], Array, Alignment],
) -> None:
    assert room[2].rests
    moving = replace(room[2], moves_m=(0.2, 0.05, 0.034))
    assert any("changed the median step by 34.0 mm" in s for s in sentences(moving))
    assert not any("come to rest" in s for s in sentences(room[2]))


def test_scans_that_stand_still_are_asked_neither() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    scan = ShapedScan(surfaces(1), np.ones((1, 3)))
    assert smear_of(poses, np.arange(5), lambda k: scan, 0) is None
    assert carried_of(poses, np.arange(5), lambda k: scan) is None


def test_a_part_is_cut_where_a_pair_disagrees_and_short_pieces_are_dropped() -> None:
    part = np.array([0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1, 1, 1])
    cut = np.zeros(len(part), bool)
    cut[[3, 5, 12]] = True
    assert _split(part, cut).tolist() == [1, 1, 1, -1, -1, 0, 0, 0, 0, 0, -1, -1, -1]
    assert _split(part, ~cut & False).tolist() == [0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1, 1, 1]


def test_neighbors_are_the_eight_keyframes_on_either_side_without_the_scan_itself() -> None:
    keyframes = np.arange(0, 60, 3)
    assert neighbors_of(30, keyframes).tolist() == [*range(6, 30, 3), *range(33, 57, 3)]
    assert neighbors_of(31, keyframes).tolist() == [*range(9, 33, 3), *range(33, 57, 3)]
    assert neighbors_of(0, keyframes).tolist() == [*range(3, 27, 3)]


def test_rings_of_sixteen_beams_do_not_pull_scans_together(tmp_path: Path) -> None:
    first = next(iter(Simulation("hall", 13, 1))).T_world_sensor
    assert first is not None
    truth, path = first @ true_poses(8, step_m=0.1), tmp_path / "truth.tum"
    path.write_text("".join(tum_line((k + 1) * 10**8, T) for k, T in enumerate(truth)))
    seen = Simulation("hall", 13, len(truth), SCANNERS["vlp16"], path)
    scans = [Scan(stamp_ns=scan.stamp_ns, points=scan.points) for scan in seen]
    found = align(Clouds(scans))
    errors_m = step_errors(found, truth)[:, :3]
    assert not found.reasons
    assert np.sqrt((errors_m**2).sum(axis=1).mean()) < min(0.004, 2.0 * found.sigmas()[0])


def angles_deg(normals: Array, axis: int) -> Array:
    """Return the angles between normals and an axis."""
    return np.degrees(np.arccos(np.minimum(np.abs(normals[:, axis]), 1.0)))


def test_common_normals_see_the_wall_where_rings_of_all_scans_lie_together() -> None:
    """Rings 0.35 m apart, of 17 scans 5 mm apart, 1.5 cm of noise across the wall."""
    rng = np.random.default_rng(0)
    y, ring, scan = np.meshgrid(np.arange(0, 3, 0.03), 0.35 * np.arange(6), 0.005 * np.arange(17))
    points = np.stack([np.zeros(y.size), y.ravel(), (ring + scan).ravel()], axis=1)
    points[:, 0] = rng.normal(scale=0.015, size=y.size)
    points[:, 1] += rng.uniform(-0.015, 0.015, y.size)
    own = points[rng.choice(len(points), 500, replace=False)]
    wall = common_normals(build_tree(cell_means(points, 0.1)), own, CloudConfig())
    assert np.median(angles_deg(wall, 0)) < 2.0
    nearest_of_all = local_shape(build_tree(points), CloudConfig().n_neighbors)[0]
    assert np.median(angles_deg(nearest_of_all, 0)) > 8.0


def test_points_on_a_line_have_no_common_normal() -> None:
    rng = np.random.default_rng(1)
    line = np.column_stack([np.linspace(0.0, 9.0, 300), np.zeros((300, 2))])
    line += rng.normal(scale=1e-3, size=line.shape)
    assert not common_normals(build_tree(line), line, CloudConfig()).any()


def test_the_share_on_surfaces_leaves_out_points_without_a_plane() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(0.0, 5.0, (1000, 2)), np.zeros(1000)])
    normals = np.tile([0.0, 0.0, 1.0], (1000, 1))
    normals[points[:, 0] > 2.0] = 0.0
    reference, reading = cloud_of(points, normals), cloud_of(points + [0.0, 0.0, 0.2])
    assert share_on_surfaces(reading, reference, np.eye(4), rng) == 0.0
    assert share_on_surfaces(cloud_of(points), reference, np.eye(4), rng) == 1.0


def test_memory_holds_a_window_of_scans_however_many_there_are(tmp_path: Path) -> None:
    store, most = ScanStore(tmp_path, 34), 0
    rng = np.random.default_rng(4)
    for k in range(400):
        store.add_shaped(k, 0, ShapedScan(rng.normal(size=(50, 3)), rng.normal(size=(50, 3))))
        most = max(most, len(store._cache))
    assert most == 34
    for k in range(400):  # any scan is read again, and the oldest in memory goes
        assert store.shaped(k, 0).points.shape == (50, 3)
        assert len(store._cache) == 34


def test_a_long_recording_is_aligned_in_the_memory_of_a_short_one() -> None:
    rng = np.random.default_rng(5)
    cloud = rng.normal(size=(300, 3)) * [4.0, 3.0, 0.05] + [0.0, 0.0, 1.0]

    class Long(Clouds):
        """Scans that are made when they are read, and forgotten."""

        def __iter__(self) -> Iterator[Scan]:
            for k in range(len(self)):
                noise = np.random.default_rng(k).normal(scale=0.005, size=cloud.shape)
                yield Scan(stamp_ns=(k + 1) * 10**8, points=cloud + noise)

    def most_bytes(n: int) -> int:
        tracemalloc.start()
        align(Long([None] * n), SETTINGS)  # type: ignore[list-item]
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    most_bytes(5)
    assert most_bytes(100) < 1.3 * most_bytes(36)


def test_a_sensor_that_stands_still_is_found_to_stand_still() -> None:
    truth = np.tile(np.eye(4), (4, 1, 1))
    found = align(Clouds(scans_of(1, truth)), SETTINGS)
    assert found.members().tolist() == [0, 1, 2, 3]
    assert np.abs(step_errors(found, truth)[:, :3]).max() < 0.002
