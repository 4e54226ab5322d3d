"""KITTI odometry folders: poses in the lidar frame, times, what is wrong with a row."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, open_recording
from cello3d_ros.recordings.kitti import KittiRecording

TR = se3.exp([0.1, -0.2, 0.3, 1.2, -1.1, 1.3])  # lidar -> camera, far from the identity


def text(T) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(T)[:3].ravel())


def lidar_poses(n: int):
    return se3.exp(np.random.default_rng(3).normal(size=(n, 6)))


def folder(tmp_path: Path, n: int = 3, Tr=None, times: str | None = None, poses=None) -> Path:
    """Write a KITTI folder whose lidar poses are ``lidar_poses(n)``."""
    (tmp_path / "velodyne").mkdir()
    rng = np.random.default_rng(1)
    for k in range(n):
        cloud = rng.normal(size=(50 + k, 4)).astype("<f4")
        cloud.tofile(tmp_path / "velodyne" / f"{k:06d}.bin")
    exact = np.eye(4) if Tr is None else Tr
    if poses is None:
        poses = exact @ lidar_poses(n) @ se3.inverse(exact)
    (tmp_path / "poses.txt").write_text("".join(text(T) + "\n" for T in poses))
    if Tr is not None:
        (tmp_path / "calib.txt").write_text(f"P0: {text(np.eye(4))}\nTr: {text(Tr)}\n")
    if times is not None:
        (tmp_path / "times.txt").write_text(times)
    return tmp_path


@pytest.mark.parametrize("Tr", [None, np.eye(4), TR])
def test_poses_are_those_of_the_lidar(tmp_path: Path, Tr) -> None:
    recording = open_recording(folder(tmp_path, Tr=Tr))
    assert len(recording) == 3
    assert recording.name == tmp_path.name
    for scan, T in zip(recording, lidar_poses(3), strict=True):
        assert np.abs(scan.T_world_sensor - T).max() < 1e-12
        assert scan.T_odom_sensor is None


def test_points_are_exact_and_nan_rows_dropped(tmp_path: Path) -> None:
    path = folder(tmp_path)
    rows = np.arange(20, dtype="<f4").reshape(5, 4)
    rows[1, 0], rows[3, 2], rows[4, 3] = np.nan, np.inf, np.nan  # the last: only intensity
    rows.tofile(path / "velodyne" / "000001.bin")
    points = [scan.points for scan in open_recording(path)]
    assert np.array_equal(points[1], [[0, 1, 2], [8, 9, 10], [16, 17, 18]])
    assert points[0].dtype == np.float64
    assert points[0].shape == (50, 3)


def test_iterating_again_gives_the_same_scans(tmp_path: Path) -> None:
    recording = open_recording(folder(tmp_path))
    for a, b in zip(recording, recording, strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert np.array_equal(a.points, b.points)
        a.T_world_sensor[:] = 0  # a scan is its reader's own
    assert all(se3.is_rigid(s.T_world_sensor) for s in recording)


def test_without_times_scans_are_a_tenth_of_a_second_apart(tmp_path: Path) -> None:
    stamps = [s.stamp_ns for s in open_recording(folder(tmp_path))]
    assert stamps == [0, 100_000_000, 200_000_000]


def test_times_are_seconds(tmp_path: Path) -> None:
    path = folder(tmp_path, times="0.000000e+00\n1.036224e-01\n2.070847e-01\n")
    assert [s.stamp_ns for s in open_recording(path)] == [0, 103_622_400, 207_084_700]


def test_without_poses_there_is_no_ground_truth(tmp_path: Path) -> None:
    path = folder(tmp_path)
    (path / "poses.txt").unlink()
    assert all(s.T_world_sensor is None for s in open_recording(path))


def test_a_part_of_a_sequence_keeps_its_rows(tmp_path: Path) -> None:
    path = folder(tmp_path)
    (path / "velodyne" / "000001.bin").unlink()
    first, last = open_recording(path)
    assert np.abs(first.T_world_sensor - lidar_poses(3)[0]).max() < 1e-12
    assert np.abs(last.T_world_sensor - lidar_poses(3)[2]).max() < 1e-12
    assert last.stamp_ns == 200_000_000


def test_a_rotation_off_by_less_than_a_thousandth_is_made_exact(tmp_path: Path) -> None:
    poses = lidar_poses(3)
    poses[1, 0, 0] += 4e-4
    scans = list(open_recording(folder(tmp_path, poses=poses)))
    assert se3.is_rigid(scans[1].T_world_sensor, 1e-12)
    assert np.abs(scans[1].T_world_sensor - lidar_poses(3)[1]).max() < 1e-3


@pytest.mark.parametrize("change", [(0, 0, 0.01), (1, 2, np.nan), (0, 3, np.inf)])
def test_a_row_that_is_no_pose_is_named(tmp_path: Path, change) -> None:
    poses = lidar_poses(3)
    i, j, value = change
    poses[1, i, j] += value
    with pytest.raises(RecordingError, match=r"poses\.txt: row 2 is not a rotation"):
        open_recording(folder(tmp_path, poses=poses))


def test_a_mirrored_row_is_refused(tmp_path: Path) -> None:
    poses = lidar_poses(3)
    poses[2, :3, 0] *= -1
    with pytest.raises(RecordingError, match="row 3"):
        open_recording(folder(tmp_path, poses=poses))


def test_fewer_poses_than_scans_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"has 2 rows, but 000002\.bin needs row 3"):
        open_recording(folder(tmp_path, poses=lidar_poses(2)))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("poses.txt", "1 0 0\n", "has 3 columns, expected 12"),
        ("poses.txt", "a b c\n", r"poses\.txt: cannot be read"),
        ("poses.txt", "", "has 0 rows"),
        ("times.txt", "0\n1\n1\n", r"times\.txt: row 3 does not follow in time"),
        ("times.txt", "0\nnan\n1\n", "row 2: 'nan' is not a time"),
        ("times.txt", "0\n1\n", "has 2 rows"),
        ("calib.txt", "Tr: 1 0 0\n", "Tr is not a rotation"),
        ("calib.txt", "Tr: 2 0 0 0 0 1 0 0 0 0 1 0\n", "Tr is not a rotation"),
        ("calib.txt", "Tr: x 0 0 0 0 1 0 0 0 0 1 0\n", r"calib\.txt: cannot be read"),
    ],
)
def test_a_broken_file_is_one_sentence(tmp_path: Path, file, content, message) -> None:
    path = folder(tmp_path)
    (path / file).write_text(content)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(path)
    assert str(path / file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "rectified"),
    [("Tr_velo_to_cam: {Tr}", False), ("R0_rect: {R}\nTr_velo_to_cam: {Tr}", True),
     ("R_rect {R}\nTr_velo_cam {Tr}", True)],
)  # fmt: skip
def test_other_names_of_the_calibration_are_read(tmp_path, text: str, rectified: bool) -> None:
    Tr, R = se3.exp([0.1, 0.2, -0.3, 0.5, -0.4, 1.2]), se3.exp([0, 0, 0, 0.01, 0.02, -0.01])
    path = folder(tmp_path, Tr=R @ Tr if rectified else Tr)
    expected = [scan.T_world_sensor for scan in open_recording(path)]

    def numbers(rows) -> str:
        return " ".join(repr(float(v)) for v in np.ravel(rows))

    told = text.format(Tr=numbers(Tr[:3]), R=numbers(R[:3, :3]))
    (path / "calib.txt").write_text(f"P0: {numbers(np.eye(4)[:3])}\n{told}\n")
    for scan, T in zip(open_recording(path), expected, strict=True):
        assert np.allclose(scan.T_world_sensor, T, atol=1e-9)


def test_poses_of_the_camera_without_the_lidars_place_are_refused(tmp_path: Path) -> None:
    path = folder(tmp_path)
    (path / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(RecordingError, match=r"calib\.txt: has no Tr, so the poses of the camera"):
        open_recording(path)
    (path / "poses.txt").unlink()
    assert all(scan.T_world_sensor is None for scan in open_recording(path))


def test_a_cut_scan_is_named_when_it_is_reached(tmp_path: Path) -> None:
    path = folder(tmp_path)
    cut = path / "velodyne" / "000001.bin"
    cut.write_bytes(cut.read_bytes()[:-3])
    recording = open_recording(path)
    found = [scan.stamp_ns for scan in recording]
    assert len(found) == len(recording) == recording.n_declared - 1
    assert recording.skipped == {"malformed": 1}
    scans = iter(open_recording(path, ReadOptions(strict=True)))
    next(scans)
    with pytest.raises(RecordingError, match=r"000001\.bin: 813 bytes are no whole number"):
        next(scans)


def test_scans_that_are_missing_or_not_numbered_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"has no velodyne/\*\.bin"):
        KittiRecording(tmp_path)
    path = folder(tmp_path)
    (path / "velodyne" / "last.bin").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"velodyne/last\.bin is not named by a number"):
        open_recording(path)


def test_topics_of_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="has no topics"):
        open_recording(folder(tmp_path), ReadOptions(points="/points"))


@pytest.mark.parametrize("name", ["street", "hall", "tree_road", "rooms_narrow_fov"])
def test_real_recordings_are_read(evaluation: Path, name: str) -> None:
    recording = open_recording(evaluation / "data" / name)
    truth = np.stack([s.T_world_sensor for s in recording])
    assert len(truth) == len(recording) > 20
    assert all(se3.is_rigid(T, 1e-9) for T in truth)
