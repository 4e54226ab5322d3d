"""Per-point times in every usual form; undistortion undoes a known motion."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.clouds.point_times import (
    EPOCH,
    FIRST,
    UNITS,
    Clock,
    PointTimesError,
    TimesOfClouds,
    law_of,
    recognise,
    relative_s,
)
from cello3d_ros.clouds.point_times import STAMP as STAMP_CLOCK
from cello3d_ros.errors import ConfigError, RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.recordings import ReadOptions, Scan, open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.deskew import deskew, deskewed

STAMP = 1_700_000_000_123_456_789
TIMES = np.linspace(0.0, 0.099, 100)
PERIOD_S = 0.1
NS = np.round(TIMES * 1e9).astype(np.int64)


@pytest.mark.parametrize(
    ("values", "tolerance"),
    [
        (TIMES, 0.0),  # Velodyne "time"
        (TIMES.astype(np.float32), 4e-9),
        (TIMES - 0.1, 0.0),  # the stamp is the end of the scan
        (NS.astype(np.uint32), 1e-9),  # Ouster "t", Livox "offset_time"
        ((NS // 1000).astype(np.uint32), 1e-6),  # microseconds
        (1e-9 * STAMP + TIMES, 3e-7),  # Hesai "timestamp", float64 seconds
        ((STAMP + NS).astype(np.float64), 3e-7),  # Livox "timestamp", float64 nanoseconds
        ((STAMP + NS).astype(np.uint64), 1e-9),
        (((STAMP + NS) // 1000).astype(np.int64), 1e-6),
    ],
)
def test_units_and_origins_are_recognised(values, tolerance: float) -> None:
    law = recognise(values, STAMP, PERIOD_S)
    shift = 0.1 if values.dtype.kind == "f" and values.min() < -0.05 else 0.0
    assert np.abs(relative_s(values, law, STAMP) + shift - TIMES).max() <= tolerance + 1e-16


def test_times_since_start_of_a_simulation_are_relative() -> None:
    for stamp_ns in (0, 5 * 10**7, 20 * 10**9):
        for values, ns in ((TIMES, 10**9), (NS.astype(np.uint32), 1)):
            law = recognise(values, stamp_ns, PERIOD_S)
            assert (law.ns_per_unit, law.origin) == (ns, STAMP_CLOCK)


def test_absolute_times_of_a_simulated_clock_are_told_from_relative_ones() -> None:
    """The first clouds of a clock that begins at 0 do not decide."""
    stamps = [k * 10**8 for k in range(10)]
    law = law_of([(0.1 * k + TIMES, stamp_ns) for k, stamp_ns in enumerate(stamps)])
    assert law is not None
    assert law.origin == EPOCH
    assert np.abs(relative_s(0.1 + TIMES, law, stamps[1]) - TIMES).max() < 1e-12


@pytest.mark.parametrize(
    "values",
    [
        50.0 + TIMES,  # the lidar has run for 50 s,
        7200.0 + TIMES,  # or two hours
        1e-9 * STAMP - 6e7 + TIMES,  # two years behind
        1e-9 * STAMP + 37.0 + TIMES,  # TAI, not UTC
        (5e12 + 1e9 * TIMES),  # float nanoseconds since boot
        (NS + 3_000_000_000).astype(np.uint32),
        (NS.astype(np.uint64) + 7_200_000_000_000),
        ((NS // 1000) + 1_800_000_000).astype(np.uint32),  # us since the hour
        np.mod(NS + 2**32 - 50_000_000, 2**32).astype(np.uint32),  # a counter that starts anew
    ],
)
def test_times_of_another_clock_are_taken_from_the_first_point(values) -> None:
    law = recognise(values, STAMP, PERIOD_S)
    assert law.origin in (FIRST, STAMP_CLOCK)
    found = relative_s(values, law, STAMP)
    assert np.abs(found - found[0] - TIMES).max() < 2e-6
    assert law.origin == STAMP_CLOCK or found[0] == 0.0


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (1e3 * TIMES.astype(np.float32), "ms"),
        (1e6 * TIMES.astype(np.float32), "us"),
        (1e9 * TIMES, "ns"),
        (np.round(1e3 * TIMES).astype(np.uint8), "ms"),
        (np.round(1e6 * TIMES).astype(np.int32), "us"),
    ],
)
def test_the_unit_is_that_in_which_the_scan_fits_between_clouds(values, unit: str) -> None:
    law = recognise(values, STAMP, PERIOD_S)
    assert law.ns_per_unit == UNITS[unit]
    assert np.abs(relative_s(values, law, STAMP) - TIMES).max() < 5.1e-4


def test_one_counter_that_wraps_below_zero_is_continued() -> None:
    for scale in (10**6, 10**9):
        values = np.round(TIMES * scale).astype(np.uint32)
        values[17] = 2**32 - 6
        found = relative_s(values, recognise(values, STAMP, PERIOD_S), STAMP)
        assert found[17] == pytest.approx(-6 / scale)
        assert np.abs(np.delete(found - TIMES, 17)).max() < 1e-6


@pytest.mark.parametrize("damage", [0.0, 1e18, -5.0])
def test_a_time_far_from_its_scan_is_damaged_and_no_other(damage: float) -> None:
    values = 1e-9 * STAMP + np.linspace(0.0, 0.099, 1000)
    values[3] = damage
    found = relative_s(values, recognise(values, STAMP, PERIOD_S), STAMP)
    assert np.isnan(found[3])
    assert np.isfinite(np.delete(found, 3)).all()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (10.0 * TIMES, "span 0.98.*clouds are 0.1 s apart.*--time-unit"),  # a share of the scan
        (np.array([0, 5, 9], dtype=np.uint32), "no scan in any unit"),
        (np.array([np.nan]), "no point has a finite time"),
        (np.zeros(50), "all points of a cloud have the same time"),
        (np.arange(1024, dtype=np.uint16), "no scan in any unit"),  # columns
    ],
)
def test_what_cannot_be_told_is_refused_in_one_sentence(values, words: str) -> None:
    with pytest.raises(PointTimesError, match=words):
        recognise(values, STAMP, PERIOD_S)


def test_a_unit_that_is_named_counts_unless_it_is_impossible() -> None:
    law = recognise(np.arange(1024, dtype=np.uint16), STAMP, 2.0, unit="ms")
    assert law.ns_per_unit == 10**6
    with pytest.raises(PointTimesError, match="no scan in any unit"):
        recognise(10.0 * TIMES, STAMP, PERIOD_S, unit="s")
    with pytest.raises(ConfigError, match="a unit of time is one of s, ms, us, ns"):
        Clock(unit="h")


def turning(stamp_ns: int, n: int = 11) -> tuple[PoseTrack, np.ndarray]:
    """Return a track of constant twist, and the twist a second."""
    xi = np.array([3.0, -1.0, 0.5, 0.2, 0.4, 2.0])
    at_s = np.linspace(-0.2, 0.3, n)
    stamps = stamp_ns + np.round(at_s * 1e9).astype(np.int64)
    return PoseTrack.of_poses(stamps, se3.exp(at_s[:, None] * xi)), xi


def distorted(stamp_ns: int = STAMP) -> tuple[Scan, np.ndarray]:
    """Return a scan taken while moving with ``turning``, and the points seen from its stamp."""
    _, xi = turning(stamp_ns)
    straight = np.random.default_rng(0).normal(scale=5.0, size=(100, 3))
    T = se3.exp(TIMES[:, None] * xi)  # pose at each point's time, seen from the stamp
    seen = np.einsum("nij,nj->ni", se3.inverse(T)[:, :3, :3], straight - T[:, :3, 3])
    return Scan(stamp_ns=stamp_ns, points=seen, time_s=TIMES, intensity=TIMES), straight


@pytest.mark.parametrize("n_poses", [2, 3, 11, 101])
def test_a_constant_twist_is_undone_exactly_however_sparse_the_poses(n_poses: int) -> None:
    scan, straight = distorted()
    found = deskew(scan, turning(STAMP, n_poses)[0])
    assert np.abs(found.points - straight).max() < 1e-6  # 1 ns of rounding in the knots
    assert np.array_equal(found.intensity, scan.intensity)
    assert found.time_s is None


def test_a_scan_that_the_poses_do_not_cover_is_not_undone() -> None:
    scan, _ = distorted()
    track, _ = turning(STAMP - 250_000_000)
    assert deskew(scan, track) is None
    with pytest.raises(RecordingError, match="no times"):
        deskew(Scan(stamp_ns=STAMP, points=scan.points), track)


def test_deskew_of_a_bag_leaves_out_what_is_not_covered(tmp_path: Path, capsys) -> None:
    scans = []
    _, xi = turning(STAMP)
    for k in range(4):
        scan, _ = distorted(STAMP + k * 100_000_000)
        scans.append(
            Scan(**{**vars(scan), "T_odom_sensor": se3.exp(0.1 * k * xi)}),
        )
    write_bag(tmp_path / "a", scans, double=True, odometry=1)
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--deskew"]) == 0
    assert "3 scans; 1 left out" in capsys.readouterr().out
    straight = distorted()[1]
    for scan in open_recording(tmp_path / "b"):
        assert np.abs(scan.points - straight).max() < 1e-5


def test_deskew_without_poses_or_times_is_an_error(tmp_path: Path) -> None:
    scan, _ = distorted()
    write_bag(tmp_path / "a", [scan])
    with pytest.raises(RecordingError, match="no poses over time"):
        list(deskewed(open_recording(tmp_path / "a")))


def test_bags_keep_companions_aligned_when_rows_are_dropped(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    points[::7, 1] = np.nan
    scan = Scan(stamp_ns=STAMP, points=points, time_s=TIMES, intensity=np.arange(100.0))
    write_bag(tmp_path / "a", [scan])
    (found,) = open_recording(tmp_path / "a")
    keep = np.isfinite(points).all(axis=1)
    assert np.array_equal(found.intensity, np.arange(100.0)[keep])
    assert np.array_equal(found.time_s, TIMES[keep])


def test_companions_of_another_length_are_refused() -> None:
    with pytest.raises(RecordingError, match=r"time_s of shape \(3,\) does not fit 100 points"):
        Scan(stamp_ns=0, points=np.zeros((100, 3)), time_s=np.zeros(3))
    scan, _ = distorted()
    part = scan.only(np.array([3, 5]))
    assert np.array_equal(part.time_s, TIMES[[3, 5]])
    assert np.array_equal(part.points, scan.points[[3, 5]])


def skewed_bag(path: Path, times) -> Path:
    """Write four clouds taken while turning, with times as ``times(k)`` makes them."""
    _, xi = turning(STAMP)
    straight = np.random.default_rng(0).normal(scale=5.0, size=(100, 3))
    T = se3.exp(TIMES[:, None] * xi)
    seen = np.einsum("nij,nj->ni", se3.inverse(T)[:, :3, :3], straight - T[:, :3, 3])
    scans = [
        Scan(
            stamp_ns=STAMP + k * 10**8,
            points=seen,
            time_s=times(k),
            T_odom_sensor=se3.exp(0.1 * k * xi),
        )
        for k in range(4)
    ]
    write_bag(path, scans, double=True, odometry=1)
    return path


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (lambda k: 50.0 + 0.1 * k + TIMES, "after the first point of the cloud"),
        (lambda k: 1e3 * TIMES, "in ms after the stamp"),
        (lambda k: TIMES, "in s after the stamp"),
    ],
)
def test_convert_undoes_the_motion_whatever_the_clock(tmp_path, capsys, times, told) -> None:
    bag = skewed_bag(tmp_path / "a", times)
    assert main(["convert", str(bag), str(tmp_path / "b"), "--deskew"]) == 0
    assert told in capsys.readouterr().out
    straight = distorted()[1]
    scans = list(open_recording(tmp_path / "b"))
    assert len(scans) == 3
    for scan in scans:
        assert np.abs(scan.points - straight).max() < 1e-5


def test_convert_refuses_times_that_fit_no_scan_and_a_unit_mends_it(tmp_path, capsys) -> None:
    bag = skewed_bag(tmp_path / "a", lambda k: 10.0 * TIMES)
    words = ["convert", str(bag), str(tmp_path / "b"), "--deskew"]
    assert main(words) == 1
    error = capsys.readouterr().err
    assert "a: times of points are not read: the times of the points span" in error
    assert error.count("\n") == 1
    assert main([*words, "--time-field", "nothing"]) == 1
    assert "no field 'nothing'; they have x, y, z, time" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


def test_the_stamps_of_clouds_can_be_moved_to_the_clock_of_the_poses(tmp_path: Path) -> None:
    bag = skewed_bag(tmp_path / "a", lambda k: TIMES)
    moved = open_recording(bag, ReadOptions(clock=Clock(cloud_offset_s=0.05)))
    recorded = list(open_recording(bag))
    _, xi = turning(STAMP)
    for k, (scan, before) in enumerate(zip(moved, recorded, strict=True)):
        assert scan.stamp_ns == before.stamp_ns + 50_000_000
        assert np.allclose(scan.time_s, before.time_s, atol=1e-12)
        if k < 3:
            assert np.allclose(scan.T_odom_sensor[:3, :3], se3.exp((0.1 * k + 0.05) * xi)[:3, :3])
    assert scan.T_odom_sensor is None


@pytest.mark.parametrize(("factor", "kind"), [(1.0, "f8"), (1e6, "u4"), (1e9, "u4")])
def test_times_of_clouds_that_come_one_by_one_are_read_from_the_first_on(factor, kind) -> None:
    reader = TimesOfClouds()
    for k in range(15):
        values = (factor * TIMES).astype(kind)
        np.testing.assert_allclose(
            reader.read(values, STAMP + k * 10**8), np.asarray(TIMES), atol=1e-6
        )


def test_milliseconds_are_told_from_seconds_once_two_clouds_have_come() -> None:
    reader, values = TimesOfClouds(), (1e3 * TIMES).astype("f4")
    with pytest.raises(PointTimesError):
        reader.read(values, STAMP)
    np.testing.assert_allclose(reader.read(values, STAMP + 10**8), TIMES, atol=1e-6)


def test_times_that_cannot_be_right_are_refused_each_time_and_another_type_begins_anew() -> None:
    reader = TimesOfClouds()
    for k in range(12):
        with pytest.raises(PointTimesError, match="no scan in any unit"):
            reader.read(1e8 * TIMES, STAMP + k * 10**8)
    found = reader.read((1e9 * TIMES).astype("u4"), STAMP + 12 * 10**8)
    np.testing.assert_allclose(found, TIMES, atol=1e-6)
