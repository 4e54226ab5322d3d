"""Folders of clouds: poses of evo's two formats by stamp or order, and files of every ending."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, open_recording
from cello3d_ros.recordings.files import read_columns
from cello3d_ros.recordings.poses import kitti_line, seconds_text, seconds_to_ns, tum_line

N = 12
T = se3.exp(np.random.default_rng(0).normal(scale=0.7, size=(N, 6)))
START = 1_305_031_102_175_304_000
STAMPS = [START + 100_000_000 * k for k in range(N)]


def clouds(folder: Path, names) -> Path:
    folder.mkdir(exist_ok=True)
    for k, name in enumerate(names):
        np.save(folder / f"{name}.npy", np.full((k + 1, 3), float(k)))
    return folder


def tum(stamps=STAMPS, poses=T) -> str:
    lines = [tum_line(s, pose) for s, pose in zip(stamps, poses, strict=True)]
    return "# timestamp tx ty tz qx qy qz qw\n" + "".join(lines)


def kitti(poses=T) -> str:
    return "".join(kitti_line(pose) for pose in poses)


def check(recording, stamps=STAMPS) -> None:
    scans = list(recording)
    assert [len(s.points) for s in scans] == list(range(1, N + 1))
    assert [s.stamp_ns for s in scans] == list(stamps)
    assert max(np.abs(s.T_world_sensor - T[k]).max() for k, s in enumerate(scans)) < 1e-12


@pytest.mark.parametrize("pattern", ["{}", "cloud_{}", "scan{}_"[:-1], "{:03d}"])
def test_tum_poses_by_order_give_the_stamps(tmp_path: Path, pattern: str) -> None:
    folder = clouds(tmp_path / "a", [pattern.format(k) for k in range(N)])
    (folder / "poses.txt").write_text(tum())
    check(open_recording(folder))


@pytest.mark.parametrize("text", [seconds_text, str, lambda s: f"lidar_{s // 1000}"])
def test_names_that_are_times_are_matched_by_stamp(tmp_path: Path, text) -> None:
    folder = clouds(tmp_path / "a", [text(s) for s in STAMPS])
    shuffled = np.random.default_rng(1).permutation(N)
    (folder / "traj.tum").write_text(tum([STAMPS[i] for i in shuffled], T[shuffled]))
    check(open_recording(folder, ReadOptions(poses=folder / "traj.tum")))


def test_poses_between_stamps_are_interpolated_and_outside_unknown(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "a", [seconds_text(s + 25_000_000) for s in STAMPS])
    (folder / "groundtruth.txt").write_text(tum())
    *inside, last = open_recording(folder)
    for k, scan in enumerate(inside):
        assert np.allclose(scan.T_world_sensor, se3.interpolate(T[k], T[k + 1], 0.25), atol=1e-9)
    assert last.T_world_sensor is None


def test_kitti_poses_by_order(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "a", range(N))
    (folder / "poses.txt").write_text(kitti())
    check(open_recording(folder), [100_000_000 * k for k in range(N)])
    (folder / "times.txt").write_text("".join(seconds_text(s) + "\n" for s in STAMPS))
    check(open_recording(folder))


def test_small_deviations_are_projected_and_counted(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "a", range(N))
    poses = T.copy()
    poses[3, 1, 1] += 2e-4
    (folder / "poses.txt").write_text(kitti(poses))
    assert open_recording(folder).n_projected == 1


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("poses.txt", kitti(T[:9]), "has 9 poses for 12 clouds"),
        ("poses.txt", tum(STAMPS[:9], T[:9]), "has 9 poses for 12 clouds"),
        ("poses.txt", tum([STAMPS[0]] * N), "row 2 does not follow in time"),
        ("poses.txt", "1 2 3\n" * N, "has 3 columns, expected 12"),
        ("poses.txt", "a b c\n" * N, "cannot be read"),
        ("poses.txt", kitti() .replace(repr(float(T[2, 0, 0])), "7.5"), "row 3 is not a rot"),
        ("poses.txt", tum(STAMPS, T)[:-200] + "1 2 3 4 0 0 0 0\n", r"cannot be read|poses for"),
        ("times.txt", "1\n2\n", "has 2 rows for 12 clouds"),
        ("times.txt", "1\n" * N, "row 2 does not follow"),
        ("times.txt", "x\n" * N, "'x' is not a time in seconds"),
    ],
)  # fmt: skip
def test_a_broken_file_is_one_sentence(tmp_path: Path, file, text, message) -> None:
    folder = clouds(tmp_path / "a", range(N))
    (folder / file).write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        list(open_recording(folder))
    assert str(folder / file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_poses_that_fit_no_cloud_are_an_error(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "a", [seconds_text(s) for s in STAMPS])
    (folder / "poses.tum").write_text(tum([s + 10**12 for s in STAMPS]))
    with pytest.raises(RecordingError, match="no pose has the time of any cloud"):
        open_recording(folder)


def test_a_quaternion_of_length_0_is_named(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "a", range(2))
    (folder / "poses.tum").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n")
    with pytest.raises(RecordingError, match=r"poses\.tum: row 2 has no unit quaternion"):
        open_recording(folder)


def test_a_folder_without_poses_has_none(tmp_path: Path) -> None:
    scans = list(open_recording(clouds(tmp_path / "a", range(3))))
    assert [s.T_world_sensor for s in scans] == [None] * 3
    assert [s.stamp_ns for s in scans] == [0, 100_000_000, 200_000_000]


@pytest.mark.parametrize("ns", [0, 1, -1, START + 1, 999_999_999, -1_500_000_000])
def test_seconds_as_text_lose_nothing(ns: int) -> None:
    assert seconds_to_ns(seconds_text(ns), "here") == ns


def test_evo_s_scientific_notation_is_read() -> None:
    assert seconds_to_ns("1.305031102175303936e+09", "here") == 1_305_031_102_175_303_936


XYZ = np.random.default_rng(3).normal(size=(50, 3)).astype(np.float32)
TIME = np.arange(50) * 1e-3


def write_pcd(path: Path, encoding: str) -> None:
    rows = np.empty(50, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("n", "<f4", 3), ("t", "<f8")])
    rows["x"], rows["y"], rows["z"], rows["n"], rows["t"] = *XYZ.T, 7.0, TIME
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z n t\nSIZE 4 4 4 4 8\nTYPE F F F F F\n"
        f"COUNT 1 1 1 3 1\nWIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA {encoding}\n"
    )
    if encoding == "ascii":
        body = "".join(
            " ".join(repr(float(v)) for v in [*p, 7, 7, 7, t]) + "\n"
            for p, t in zip(XYZ, TIME, strict=True)
        ).encode()
    else:
        body = rows.tobytes()
    path.write_bytes(head.encode() + body)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_pcd_fields_by_name(tmp_path: Path, encoding: str) -> None:
    write_pcd(tmp_path / "a.pcd", encoding)
    found = read_columns(tmp_path / "a.pcd")
    assert list(found) == ["x", "y", "z", "t"]
    assert np.array_equal(np.stack([found[a] for a in "xyz"], 1), XYZ)
    assert np.allclose(found["t"], TIME, atol=1e-15)


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("ending", [".pcd", ".ply"])
def test_files_of_open3d_are_read_alike(tmp_path: Path, ending: str, text, compressed) -> None:
    """Open3D writes with PCL's LZF and rply: other programs' idea of the formats."""
    o3d = pytest.importorskip("open3d")
    points = np.round(np.random.default_rng(0).normal(size=(5000, 3)), 2)  # repeats: compressible
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    path = tmp_path / f"a{ending}"
    assert o3d.io.write_point_cloud(str(path), cloud, write_ascii=text, compressed=compressed)
    found = read_columns(path)
    theirs = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    ours = np.stack([found[a] for a in "xyz"], axis=1).astype(np.float64)
    assert np.abs(ours - theirs).max() <= (1e-6 if text else 0.0)


def ply_text(order: str) -> bytes:
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "a": "ascii"}[order]
    head = (
        f"ply\nformat {kind} 1.0\ncomment by a test\nelement vertex 50\nproperty float x\n"
        "property float y\nproperty float z\nproperty uchar intensity\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    if order == "a":
        rows = "".join(f"{x!r} {y!r} {z!r} {k}\n" for k, (x, y, z) in enumerate(XYZ.tolist()))
        return (head + rows + "3 0 1 2\n").encode()
    rows = np.empty(50, [("p", order + "f4", 3), ("i", "u1")])
    rows["p"], rows["i"] = XYZ, np.arange(50)
    return head.encode() + rows.tobytes() + b"\3" + np.arange(3, dtype=order + "i4").tobytes()


@pytest.mark.parametrize("order", ["<", ">", "a"])
def test_ply_vertices_in_every_encoding(tmp_path: Path, order: str) -> None:
    (tmp_path / "a.ply").write_bytes(ply_text(order))
    found = read_columns(tmp_path / "a.ply")
    assert np.array_equal(np.stack([found[a] for a in "xyz"], 1), XYZ)
    assert np.array_equal(found["intensity"], np.arange(50))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("order", ["<", "a"])
def test_a_cut_ply_is_an_error(tmp_path: Path, order: str, share: float) -> None:
    data = ply_text(order)
    (tmp_path / "a.ply").write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=r"a\.ply: "):
        read_columns(tmp_path / "a.ply")
