import dataclasses
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, IcpConfig, OverlapConfig, Pipeline, SamplingConfig
from cello3d_ros.errors import CloudError, RecordingError
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import exp, inverse, log, transform
from cello3d_ros.learning.noise import noisy, seen_from
from cello3d_ros.learning.sampling import (
    Pair,
    Prepared,
    describe_pair,
    eigenvalue_errors,
    finish_pair,
    is_precise,
    pair_of,
    prepare_scan,
    register_block,
    sample_pair,
    sample_recording,
    stops,
)
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.registration.backends import register
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.scanner import Echoes, measure
from cello3d_ros.simulation.simulation import Simulation

PIPELINE = Pipeline(
    cloud=CloudConfig(voxel_m=0.1),
    icp=IcpConfig(n_reading_points=600, n_reference_points=2500),
    overlap=OverlapConfig(radius_m=0.4),
)
SAMPLING = SamplingConfig(n_samples=50, variance=0.01, max_gap=2, seed=5, n_rotations=2)


class Recorded:
    """A recording in memory."""

    def __init__(self, name, scans):
        self.name, self.scans = name, scans

    def __len__(self):
        return len(self.scans)

    def __iter__(self):
        return iter(self.scans)


def cloud(points):
    return prepare(points, PIPELINE.cloud, np.random.default_rng(0))


def a_pair(name, reading, reference, T_mean=None):
    """A pair whose reference stands at the origin."""
    T_mean = np.eye(4) if T_mean is None else T_mean
    return Pair(name, 0, 1, Prepared(reading, T_mean), Prepared(reference, np.eye(4)), T_mean)


def hallway(seed):
    """Four walls along x without ends, rough on a scale that does not tell where along x."""
    rng = np.random.default_rng(seed)
    n = 6000
    points = rng.uniform([-15, -1.5, -1.2], [15, 1.5, 1.2], (n, 3))
    side = rng.integers(4, size=n)
    points[side == 0, 1], points[side == 1, 1] = -1.5, 1.5
    points[side == 2, 2], points[side == 3, 2] = -1.2, 1.2
    return points + rng.normal(scale=0.01, size=points.shape)


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_hallway_is_free_along_itself(turn):
    R = exp([0, 0, 0, 0, 0, turn])
    reading, reference = (cloud(transform(R, hallway(seed))) for seed in (1, 2))
    record = sample_pair(
        a_pair("hallway", reading, reference),
        PIPELINE,
        SamplingConfig(n_samples=150, variance=0.02, cluster_scale_m=0.5),
        n_threads=2,
    )
    assert record.accepted
    values, vectors = np.linalg.eigh(record.covariance[:3, :3])
    assert abs(vectors[:, -1] @ R[:3, 0]) > 0.99
    assert values[-1] > 20 * values[-2]


def test_the_covariance_is_on_the_reading_side_about_the_truth(room):
    """T_mean is off the true pose by b: the covariance holds b b^T, in the reading's frame."""
    T = exp([0.5, -0.2, 0.1, 0.0, 0.1, 1.2])
    b = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    reading, reference = cloud(transform(inverse(T), room[0])), cloud(room[1])
    record = sample_pair(
        a_pair("room", reading, reference, T @ exp(-b)), PIPELINE, SAMPLING, n_threads=2
    )
    assert record.accepted
    np.testing.assert_allclose(record.xi[record.kept].mean(axis=0), b, atol=0.01)
    np.testing.assert_array_equal(record.covariance, sampled_covariance(record.xi[record.kept]))
    assert record.covariance[0, 0] > 0.04**2


def recorded(name, n_scans=4):
    rng = np.random.default_rng(9)
    walls = rng.uniform([-4, -3, -1.5], [4, 3, 1.5], (5000, 3))
    face = rng.integers(3, size=len(walls))
    sign = rng.choice([-1, 1], len(walls))
    walls[np.arange(len(walls)), face] = sign * np.array([4, 3, 1.5])[face]
    scans = []
    for k in range(n_scans):
        T = exp([0.2 * k, 0.1 * k, 0, 0, 0, 0.1 * k])
        points = transform(inverse(T), walls + rng.normal(scale=0.01, size=walls.shape))
        scans.append(Scan(stamp_ns=k, points=points, T_world_sensor=T))
    return Recorded(name, scans)


def test_neither_threads_nor_what_is_done_change_a_record():
    todo = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    small = SamplingConfig(n_samples=50, variance=0.01, max_gap=2, seed=5, n_rotations=2)
    one = list(sample_recording(recorded("r"), todo, PIPELINE, small, n_threads=1))
    two = list(sample_recording(recorded("r"), todo, PIPELINE, small, n_threads=2))
    rest = list(sample_recording(recorded("r"), todo[2:4], PIPELINE, small))
    assert [r.key[1:] for r in one] == todo
    for a, b in [*zip(one, two), *zip(one[2:4], rest)]:
        assert a.accepted
        for name in ("xi", "kept", "covariance", "descriptors", "T_mean"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    other = list(sample_recording(recorded("other name"), todo[:1], PIPELINE, small))
    assert not np.array_equal(other[0].xi, one[0].xi)


def test_the_starts_have_the_stated_variance(monkeypatch):
    """With ICP stopped at once, the results are the starts."""
    pipeline = Pipeline(cloud=PIPELINE.cloud, icp=PIPELINE.icp, overlap=PIPELINE.overlap)
    seen = []

    def keep_starts(reading, reference, starts, seeds, config, n_threads):
        seen.append(starts)
        return []

    monkeypatch.setattr("cello3d_ros.learning.sampling.register_many", keep_starts)
    recording = recorded("r", 2)
    sampling = SamplingConfig(n_samples=4000, variance=0.05)
    list(sample_recording(recording, [(0, 1)], pipeline, sampling))
    T_mean = inverse(recording.scans[0].T_world_sensor) @ recording.scans[1].T_world_sensor
    xi = log(inverse(T_mean) @ seen[0])
    np.testing.assert_allclose(np.cov(xi.T), 0.05 * np.eye(6), atol=0.006)
    np.testing.assert_allclose(xi.mean(axis=0), 0.0, atol=0.015)


def test_pairs_that_cannot_be_learned_from_say_why(room):
    far = Recorded(
        "r",
        [
            Scan(stamp_ns=0, points=room[0], T_world_sensor=np.eye(4)),
            Scan(stamp_ns=1, points=room[1], T_world_sensor=exp([50, 0, 0, 0, 0, 0])),  # wrong
            Scan(stamp_ns=2, points=room[1][:3], T_world_sensor=np.eye(4)),
        ],
    )
    records = sample_recording(far, [(0, 1), (0, 2), (1, 2)], PIPELINE, SAMPLING)
    assert [r.reason for r in records] == ["offset", "too_few_points", "too_few_points"]


def test_pairs_that_fail_consistently_are_rejected(room):
    wrong = exp([0, 0, 0, 0, 0, 1.4])  # the "truth" is turned, ICP finds another pose
    record = sample_pair(
        a_pair("r", cloud(room[0]), cloud(room[1]), wrong),
        PIPELINE,
        SamplingConfig(n_samples=50, variance=1e-4, max_offset_rad=0.3, max_offset_m=0.3),
    )
    assert not record.accepted
    assert record.reason in ("offset", "no_overlap")


def test_a_pair_without_ground_truth_is_rejected_by_name(room):
    blind = Recorded("blind", [Scan(stamp_ns=k, points=room[0]) for k in range(2)])
    (record,) = sample_recording(blind, [(0, 1)], PIPELINE, SAMPLING)
    assert (record.accepted, record.reason) == (False, "no_ground_truth")


def assert_same(a, b):
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, dict):
            assert x.keys() == y.keys()
            assert all(np.array_equal(x[name], y[name]) for name in x)
        else:
            np.testing.assert_array_equal(x, y)


def with_samples(n, **settings):
    return SamplingConfig(n_samples=n, variance=0.01, seed=5, n_rotations=2, **settings)


def test_blocks_of_any_size_make_the_same_record(room):
    reading, reference = cloud(room[0]), cloud(room[1])
    sampling = with_samples(50)
    pair = a_pair("r", reading, reference)
    whole = sample_pair(pair, PIPELINE, sampling)
    record = describe_pair(pair, PIPELINE, sampling)
    for cuts in ([0, 7, 8, 50], [0, 49, 50]):
        blocks = [register_block(pair, PIPELINE, sampling, a, b) for a, b in pairwise(cuts)]
        assert_same(finish_pair(record, blocks, sampling), whole)


def test_adaptive_sampling_stops_early_and_is_the_shorter_run(room):
    reading, reference = cloud(room[0]), cloud(room[1])

    def run(sampling):
        counts = []
        record = sample_pair(a_pair("r", reading, reference), PIPELINE, sampling, 2, counts.append)
        assert sum(counts) == record.n_samples
        return record

    adaptive = run(with_samples(400, precision=0.15, min_samples=50))
    assert adaptive.accepted
    assert 50 < adaptive.n_samples < 400
    assert (eigenvalue_errors(adaptive.xi[adaptive.kept]) <= 0.15).all()
    assert_same(adaptive, run(with_samples(adaptive.n_samples)))
    assert run(with_samples(60, precision=1e-6, min_samples=50)).n_samples == 60
    assert run(with_samples(400, precision=1.0, min_samples=50)).n_samples == 50


def test_a_rejected_pair_is_never_precise(room):
    wrong = sample_pair(
        a_pair("r", cloud(room[0]), cloud(room[1]), exp([0, 0, 0, 0, 0, 1.4])), PIPELINE,
        with_samples(60, precision=1.0, min_samples=50, max_offset_m=0.1, max_offset_rad=0.1),
    )  # fmt: skip
    assert not wrong.accepted
    assert not is_precise(wrong, 1.0)
    assert wrong.n_samples in (0, 60)


@pytest.mark.parametrize("precision", [0.0, 0.1])
@pytest.mark.parametrize(("n", "least"), [(50, 200), (500, 200), (501, 57), (5000, 50)])
def test_the_looks_at_a_pair_end_with_the_last_registration(n, least, precision):
    looks = stops(with_samples(n, precision=precision, min_samples=least))
    assert looks[-1] == n
    assert all(a < b for a, b in pairwise(looks))
    assert precision == 0.0 or looks[0] == min(least, n)


def test_eigenvalue_errors_are_those_of_repeated_sampling():
    """Against the scatter of the eigenvalues of many samples, and sqrt(2 / n) for Gaussians."""
    rng = np.random.default_rng(3)
    scale = np.array([1.0, 0.1, 3.0, 0.01, 0.3, 0.03])
    n = 800
    values = [
        np.linalg.eigvalsh(sampled_covariance(rng.normal(size=(n, 6)) * scale)) for _ in range(400)
    ]
    scatter = np.std(values, axis=0) / np.mean(values, axis=0)
    errors = eigenvalue_errors(rng.normal(size=(n, 6)) * scale)
    np.testing.assert_allclose(errors, scatter, rtol=0.25)
    np.testing.assert_allclose(errors, np.sqrt(2 / n), rtol=0.2)
    heavy = rng.standard_t(4.5, size=(n, 6)) * scale
    assert eigenvalue_errors(heavy).mean() > 1.3 * np.sqrt(2 / n)


def test_noise_lies_along_the_rays_with_the_stated_deviation(room):
    before = cloud(room[0])
    kept = np.arange(0, len(before.points), 2)
    after = noisy(before, kept, 0.05, np.random.default_rng(0))
    order = np.array([np.argmin(np.linalg.norm(np.cross(before.points[kept], p), axis=1)
                                + np.linalg.norm(before.points[kept] - p, axis=1))
                      for p in after.points[:300]])  # fmt: skip
    rays = before.points[kept][order]
    ranges = np.linalg.norm(rays, axis=1)
    moved = np.linalg.norm(after.points[:300], axis=1) - ranges
    np.testing.assert_allclose(np.cross(rays, after.points[:300]) / ranges[:, None] ** 2, 0,
                               atol=1e-12)  # fmt: skip
    assert abs(moved.std() / 0.05 - 1) < 0.15
    np.testing.assert_array_equal(after.normals[:300], before.normals[kept][order])
    np.testing.assert_array_equal(after.points, after.tree.points)


def test_noise_widens_the_covariance_and_none_changes_nothing(room):
    reading, reference = cloud(room[0]), cloud(room[1])
    traces = []
    for sigma in (0.0, 1e-9, 0.05):
        sampling = with_samples(60, noise_m=sigma)
        one, two = (
            sample_pair(a_pair("r", reading, reference), PIPELINE, sampling, n) for n in (1, 2)
        )
        assert one.accepted
        assert_same(one, two)
        traces.append(np.trace(one.covariance))
    assert traces[1] == pytest.approx(traces[0], rel=1e-3)
    assert traces[2] > 1.5 * traces[0]


class Walls:
    """A recording of a closed room, with or without what its beams met."""

    name = "walls"

    def __init__(self, rescannable):
        self.rescannable = rescannable

    def __len__(self):
        return 2

    def __iter__(self):
        scanner = SCANNERS["spinning32"]
        beams = scanner.directions()
        for k, at in enumerate(([0.0, 0, 0], [0.2, 0.1, 0])):
            sides = np.array([4.0, 3, 1.5]) - np.sign(beams) * at
            distances = (sides / np.maximum(np.abs(beams), 1e-9)).min(axis=1)
            echoes = Echoes(scanner, distances, np.ones(len(beams)))
            points = measure(echoes, np.random.default_rng([9, k]))
            yield Scan(
                stamp_ns=k,
                points=points,
                T_world_sensor=exp([*at, 0, 0, 0]),
                echoes=echoes if self.rescannable else None,
            )


def test_new_scans_widen_the_covariance_with_their_noise_and_none_changes_nothing():
    def record(sigma, rescannable=True, n_threads=1, n=60):
        walls, sampling = Walls(rescannable), with_samples(n, noise_m=sigma)
        return next(sample_recording(walls, [(0, 1)], PIPELINE, sampling, n_threads))

    assert_same(record(0.0), record(0.0, False))
    found = [record(sigma) for sigma in (0.01, 0.03, 0.09)]
    assert all(one.accepted for one in found)
    assert_same(found[1], record(0.03, n_threads=2))
    traces = [np.trace(one.covariance) for one in found]
    assert 1.5 * traces[0] < traces[1] < traces[2] / 1.5
    added = record(0.03, rescannable=False)
    assert added.accepted
    assert not np.array_equal(added.xi, found[1].xi)
    for name, shape in added.shapes.items():  # what describes the pair is the recorded scan
        np.testing.assert_array_equal(shape, found[1].shapes[name])


def test_a_new_scan_that_leaves_no_cloud_is_counted(monkeypatch):
    from cello3d_ros.learning import noise

    clouds = iter(range(1000))

    def one_in_four(points, config, rng):
        if next(clouds) % 4 == 3:
            raise CloudError("nothing left")
        return prepare(points, config, rng)

    monkeypatch.setattr(noise, "prepare", one_in_four)
    sampling = with_samples(60, noise_m=0.01)
    record = next(sample_recording(Walls(True), [(0, 1)], PIPELINE, sampling))
    assert (record.n_failed, len(record.xi)) == (30, 30)


def test_a_recording_that_ends_early_says_so_after_the_pairs_that_it_has():
    short = recorded("r", 3)
    records = sample_recording(short, [(0, 1), (1, 2), (2, 3)], PIPELINE, with_samples(50))
    assert [next(records).key[1:] for _ in range(2)] == [(0, 1), (1, 2)]
    with pytest.raises(RecordingError, match="r: ends early, after 3 scans: scan 3 is missing"):
        next(records)


def test_scans_after_the_last_pair_are_not_read():
    class Guarded(Recorded):
        def __iter__(self):
            yield from self.scans[:2]
            raise AssertionError("read on")

    records = sample_recording(Guarded("r", recorded("r").scans), [(0, 1)], PIPELINE, SAMPLING)
    assert len(list(records)) == 1


def test_planes_are_singular_and_sampling_goes_on():
    rng = np.random.default_rng(8)

    def plane():
        return rng.uniform(-5, 5, (4000, 3)) * [1, 1, 0] - [0, 0, 1.5]

    scans = [Scan(stamp_ns=k, points=plane(), T_world_sensor=np.eye(4)) for k in range(2)]
    scans += recorded("r", 4).scans[2:]
    records = list(
        sample_recording(
            Recorded("r", scans), [(0, 1), (1, 2), (2, 3)], PIPELINE, with_samples(50)
        )
    )
    assert [r.reason for r in records][::2] == ["singular", ""]
    assert not records[1].accepted
    for record in records:
        assert np.isfinite(record.xi).all()


def test_registrations_without_an_answer_are_counted_and_left_out(room, monkeypatch):
    """Of four, one fails, one gives a pose that is not finite, one stops at its last step."""
    reading, reference = cloud(room[0]), cloud(room[1])
    sampling = with_samples(50)
    pair = a_pair("r", reading, reference)
    record = describe_pair(pair, PIPELINE, sampling)
    answer = register_block(pair, PIPELINE, sampling, 0, 1)

    def some(reading, reference, starts, seeds, config, n_threads):
        from cello3d_ros.registration.icp import Registration

        bad = np.full((4, 4), np.nan)
        return [
            Registration(exp(answer.xi[0]), 5, True, "", 0.01, 900),
            Registration(np.eye(4), 0, False, "singular", np.nan, 0),
            Registration(bad, 5, True, "", 0.01, 900),
            Registration(np.eye(4), 80, False, "max_iterations", 0.01, 900),
        ]

    monkeypatch.setattr("cello3d_ros.learning.sampling.register_many", some)
    block = register_block(pair, PIPELINE, sampling, 0, 4)
    assert (len(block.xi), block.n_converged, block.n_failed) == (2, 1, 2)
    np.testing.assert_allclose(block.xi, [answer.xi[0], np.zeros(6)], atol=1e-12)
    assert finish_pair(record, [block], sampling).reason == "singular"


def test_clouds_with_fewer_points_than_neighbors_are_no_clouds():
    with pytest.raises(CloudError, match="3 of 3 points are left"):
        cloud(np.ones((3, 3)) * np.arange(1, 4)[:, None])


def a_drive(world="rooms", **changes):
    drive = Drive(**({"speed_m_s": 3.0, "rate_hz": 10.0, "sweeps": False} | changes))
    return Simulation(world, 3, 2, SCANNERS["spinning16"], drive=drive)


def test_another_view_keeps_the_motion_and_sees_other_points():
    simulation = a_drive()
    reference, reading = simulation
    looks, T_world = (
        (reading.look, reference.look),
        (reading.T_world_sensor, reference.T_world_sensor),
    )
    views = [seen_from(looks, T_world, PIPELINE, np.random.default_rng(k)) for k in range(2)]
    T = inverse(T_world[1]) @ T_world[0]
    for P, Q in views:
        found = register(P, Q, T, PIPELINE.icp, np.random.default_rng(0))
        assert np.abs(log(inverse(T) @ found.T_ref_read)[:2]).max() < 0.02
    spread = np.linalg.norm(views[0][0].points.mean(axis=0) - views[1][0].points.mean(axis=0))
    assert spread > 0.01


def test_both_scans_of_a_view_are_of_one_scanner_and_another_view_of_another():
    """A wall that is the same from everywhere, without noise: only the beams' errors differ."""
    scanner = dataclasses.replace(SCANNERS["spinning16"], range_noise_m=0.0, range_offset_m=0.1)
    n = scanner.shape[0] * scanner.shape[1]
    look = partial(Echoes, scanner, np.full(n, 5.0), np.ones(n))
    pair, T_world = (lambda _: look(), lambda _: look()), (np.eye(4), np.eye(4))
    first, second = (
        [np.unique(np.linalg.norm(cloud.points, axis=1).round(4)) for cloud in view]
        for view in (
            seen_from(pair, T_world, PIPELINE, np.random.default_rng(k)) for k in range(2)
        )
    )
    assert np.intersect1d(*first).size > 8
    assert np.intersect1d(first[0], second[0]).size < 2


def test_views_of_plain_ground_have_no_answer_as_nothing_holds_it_sideways():
    scanner = dataclasses.replace(SCANNERS["spinning64"], range_noise_m=0.005)
    down = np.repeat(np.sin(np.radians(-scanner.elevations())), scanner.shape[1])
    far = np.divide(1.5, down, out=np.full(len(down), np.inf), where=down > 0.0)
    echoes = Echoes(scanner, far, np.ones(len(far)))
    points = measure(echoes, np.random.default_rng(0))
    scan = Scan(stamp_ns=0, points=points, T_world_sensor=np.eye(4), look=lambda _: echoes)
    sampling = dataclasses.replace(SAMPLING, n_samples=52, n_views=5, variance=1e-4)
    pair = pair_of("a", 0, 1, *(prepare_scan(scan, "a", k, PIPELINE, sampling) for k in (0, 1)))
    block = register_block(pair, PIPELINE, sampling, 0, 52)
    assert (len(block.xi), block.n_failed) == (0, 52)


def test_registrations_from_several_views_are_the_same_for_any_blocks_and_threads():
    sampling = dataclasses.replace(SAMPLING, n_samples=52, n_views=5)
    simulation = a_drive()
    scans = [prepare_scan(s, "a", k, PIPELINE, sampling) for k, s in enumerate(simulation)]
    pair = pair_of("a", 0, 1, *scans)
    whole = register_block(pair, PIPELINE, sampling, 0, 52, n_threads=2)
    parts = [register_block(pair, PIPELINE, sampling, a, b) for a, b in ((0, 7), (7, 52))]
    np.testing.assert_array_equal(whole.xi, np.concatenate([part.xi for part in parts]))


def test_views_hold_more_of_the_bias_than_one_place():
    """With all points the scatter within a view is small, the offset is each view's own."""
    whole = Pipeline(icp=IcpConfig(n_reading_points=5000, n_reference_points=0))
    settings = dataclasses.replace(SAMPLING, n_views=5)
    found = next(sample_recording(a_drive("office"), [(0, 1)], whole, settings))
    views = [found.xi[k::5, :2] for k in range(5)]
    within = np.sqrt(np.mean([view.var(axis=0, ddof=1) for view in views], axis=0))
    between = np.std([view.mean(axis=0) for view in views], axis=0, ddof=1)
    assert (between / (within / np.sqrt(10))).max() > 3.0


def test_a_recording_that_cannot_be_seen_from_elsewhere_is_sampled_from_where_it_was():
    sampling = dataclasses.replace(SAMPLING, n_views=5)
    swept = a_drive(sweeps=True)
    assert all(scan.look is None for scan in swept)
    scans = [dataclasses.replace(scan, look=None, time_s=None) for scan in a_drive()]
    recorded = Recorded("a", scans)
    found = [
        next(sample_recording(recorded, [(0, 1)], PIPELINE, settings))
        for settings in (SAMPLING, sampling)
    ]
    np.testing.assert_array_equal(found[0].xi, found[1].xi)
