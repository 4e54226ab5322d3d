"""Single clouds: the same points from every format, and what is wrong with a file."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings.files import read_cloud

POINTS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32).astype(np.float64)
WIDE = np.column_stack([POINTS, np.arange(40)])


def test_kitti_bin(tmp_path: Path) -> None:
    WIDE.astype("<f4").tofile(tmp_path / "a.bin")
    assert np.array_equal(read_cloud(tmp_path / "a.bin"), POINTS)


@pytest.mark.parametrize("array", [POINTS, WIDE, POINTS.astype(np.float32), WIDE.astype(">f8")])
def test_npy(tmp_path: Path, array) -> None:
    np.save(tmp_path / "a.npy", array)
    points = read_cloud(str(tmp_path / "a.npy"))
    assert np.array_equal(points, POINTS)
    assert points.dtype == np.float64


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("separator", [",", ", ", ";", " ", "\t"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_csv_with_columns_anywhere(tmp_path: Path, separator: str, end: str, mark: str) -> None:
    pytest.importorskip("pyarrow")
    header = ["stamp", "Z", "y", "intensity", '"x"']
    rows = [[7, z, y, 0.5, x] for x, y, z in POINTS.tolist()]
    lines = [separator.join(str(v) for v in row) + end for row in [header, *rows]]
    (tmp_path / "a.csv").write_text(mark + "".join(lines), encoding="utf-8", newline="")
    assert np.array_equal(read_cloud(tmp_path / "a.csv"), POINTS)


@pytest.mark.parametrize("ending", [".ply", ".pcd", ".PLY"])
def test_ply_and_pcd(tmp_path: Path, ending: str) -> None:
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    path = tmp_path / f"a{ending.lower()}"
    assert o3d.io.write_point_cloud(str(path), cloud)
    path = path.rename(tmp_path / f"a{ending}")
    assert np.allclose(read_cloud(path), POINTS, atol=1e-6)


def test_points_that_are_not_finite_are_dropped(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    bad = POINTS.copy()
    bad[3, 1], bad[7, 2] = np.nan, -np.inf
    np.save(tmp_path / "a.npy", bad)
    kept = np.delete(POINTS, [3, 7], axis=0)
    assert np.array_equal(read_cloud(tmp_path / "a.npy"), kept)
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\nnan,2,3\n4,5,inf\n")
    assert np.array_equal(read_cloud(tmp_path / "a.csv"), [[1, 2, 3]])


@pytest.mark.parametrize("ending", [".bin", ".npy", ".csv", ".ply", ".pcd"])
def test_a_missing_file_is_an_error(tmp_path: Path, ending: str) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        read_cloud(tmp_path / f"gone{ending}")


@pytest.mark.parametrize("ending", [".bin", ".npy", ".csv", ".ply", ".pcd"])
def test_an_empty_file_is_an_error(tmp_path: Path, ending: str) -> None:
    if ending in (".ply", ".pcd"):
        pytest.importorskip("open3d")
    path = tmp_path / f"empty{ending}"
    path.write_bytes(b"")
    with pytest.raises(RecordingError) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,w\n1,2,3\n", "no column 'z' in the header"),
        ("1,2,3\n4,5,6\n", "no column 'x' in the header"),
        ("x,y,z\n", "holds no finite point"),
        ("x,y,z\n1,2\n", "cannot be read"),
        ("x,y,z\n1,2,three\n", "cannot be read"),
        ("x,y,z\n,,\n", "cannot be read"),
    ],
)
def test_a_csv_with_wrong_columns_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        read_cloud(tmp_path / "a.csv")
    assert "\n" not in str(caught.value)


def test_a_csv_that_is_not_text_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(bytes(range(256)))
    with pytest.raises(RecordingError, match=r"a\.csv: "):
        read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(12), r"expected an array \(N, 3\) or wider, found shape \(12,\)"),
        (np.zeros((3, 2)), r"found shape \(3, 2\)"),
        (np.zeros((2, 3, 4)), r"found shape \(2, 3, 4\)"),
        (np.zeros((0, 3)), "holds no finite point"),
        (np.full((5, 3), np.nan), "holds no finite point"),
        (np.array([["a", "b", "c"]]), "expected numbers"),
        (np.array([[None, 1, 2]], dtype=object), "cannot be read"),
    ],
)
def test_a_wrong_array_is_an_error(tmp_path: Path, array, message: str) -> None:
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(RecordingError, match=message):
        read_cloud(tmp_path / "a.npy")


def test_a_cut_npy_or_an_archive_is_an_error(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    whole = (tmp_path / "a.npy").read_bytes()
    for length in (5, 40, len(whole) - 8):
        (tmp_path / "a.npy").write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"a\.npy: "):
            read_cloud(tmp_path / "a.npy")
    with (tmp_path / "a.npy").open("wb") as stream:
        np.savez(stream, a=POINTS)
    with pytest.raises(RecordingError, match=r"a\.npy: "):
        read_cloud(tmp_path / "a.npy")


def test_a_bin_of_half_a_point_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(24))
    with pytest.raises(RecordingError, match="24 bytes are no whole number of 16-byte points"):
        read_cloud(tmp_path / "a.bin")


@pytest.mark.parametrize("name", ["a.las", "a", "a.npz"])
def test_an_unknown_ending_is_an_error_with_those_known(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    with pytest.raises(RecordingError, match=r"unknown ending, expected one of \.bin, \.npy"):
        read_cloud(tmp_path / name)


def test_a_broken_ply_is_an_error(tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\n")
    with pytest.raises(RecordingError, match=r"a\.ply: "):
        read_cloud(tmp_path / "a.ply")
