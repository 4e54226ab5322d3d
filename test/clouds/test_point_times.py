"""Per-point times in every usual form; undistortion undoes a known motion."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.clouds.point_times import TimeLaw, recognise, relative_s
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.recordings import Scan, open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.deskew import deskew, deskewed

STAMP = 1_700_000_000_123_456_789
TIMES = np.linspace(0.0, 0.099, 100)
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
    law = recognise(values, STAMP)
    assert law is not None
    shift = 0.1 if values.dtype.kind == "f" and values.min() < -0.05 else 0.0
    assert np.abs(relative_s(values, law, STAMP) + shift - TIMES).max() <= tolerance + 1e-16


def test_times_since_start_of_a_simulation_are_relative() -> None:
    for stamp_ns in (0, 5 * 10**7, 20 * 10**9):
        assert recognise(TIMES, stamp_ns) == TimeLaw(10**9, absolute=False)
        assert recognise(NS.astype(np.uint32), stamp_ns) == TimeLaw(1, absolute=False)


def test_what_cannot_be_told_is_not_guessed() -> None:
    assert recognise(np.array([0, 5, 9], dtype=np.uint32), STAMP) is None
    assert recognise(np.array([np.nan]), STAMP) is None
    assert recognise(np.array([5e12, 5e12 + 1e8]), STAMP) is None  # another clock


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
    assert not found.time_s.any()


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
    write_bag(tmp_path / "a", scans, double=True, odometry_per_scan=1)
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
