"""The ASL/ETH sequences: every layout and archive gives the same scans; what may be wrong."""

import shutil
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import archives, open_recording
from cello3d_ros.recordings.challenging import SEQUENCES, ChallengingRecording, sequence_of

pytestmark = pytest.mark.skipif(find_spec("pyarrow") is None, reason="PyArrow is not installed")

N = 12  # more than 10, so that text order is not integer order
T = se3.exp(np.random.default_rng(0).normal(size=(N, 6)) * 0.7)
CLOUDS = [np.random.default_rng(k).normal(scale=4.0, size=(30 + k, 3)) for k in range(N)]
START_S = 1314117928.25
HEADER = "Time_in_sec,x,y,z,Intensities,2DscanId,PointId"
LAYOUTS = {  # clouds, poses
    "beside": ("csv_local", "csv_local"),
    "csv": ("csv_local", "csv_global"),
    "frames": ("local_frame", "global_frame"),
    "leica": ("csv_local", "leica"),
    "flat": ("", ""),
    "root": ("csv_local", ""),
}


def pose_text(poses=T, separator=", ", end="\n", first_id=0) -> str:
    names = ["poseId", "timestamp", *(f"T{i}{j}" for i in range(4) for j in range(4))]
    rows = [
        [str(k + first_id), f"{START_S + 20 * k:.6f}", *(f"{v:.12f}" for v in pose.ravel())]
        for k, pose in enumerate(poses)
    ]
    return "".join(separator.join(row) + end for row in [names, *rows])


def cloud_text(points, k: int, header=HEADER, end="\n") -> str:
    rows = [
        f"{START_S + 20 * k + 1e-3 * i:.6f},{x!r},{y!r},{z!r},{100.5 + i},{i // 10},{i % 10}"
        for i, (x, y, z) in enumerate(points.tolist())
    ]
    return "".join(line + end for line in [header, *rows])


def sequence(path: Path, layout: str = "csv", world: bool = False, **text) -> Path:
    clouds, poses = (path / part for part in LAYOUTS[layout])
    for folder in (clouds, poses):
        folder.mkdir(parents=True, exist_ok=True)
    (poses / "pose_scanner_leica.csv").write_text(pose_text(**text), newline="")
    for k, points in enumerate(CLOUDS):
        name = f"PointCloud{k}.csv" if world else f"Hokuyo_{k}.csv"
        moved = se3.transform(T[k], points) if world else points
        (clouds / name).write_text(cloud_text(moved, k), newline="")
    return path


def check(recording, tolerance: float = 0.0) -> None:
    scans = list(recording)
    assert len(scans) == len(recording) == N
    for k, scan in enumerate(scans):
        assert scan.stamp_ns == round((START_S + 20 * k) * 1e6) * 1000
        assert np.abs(scan.points - CLOUDS[k]).max() <= tolerance
        assert np.abs(scan.T_world_sensor - T[k]).max() < 1e-11
        assert np.array_equal(scan.intensity, 100.5 + np.arange(30 + k))
        assert np.allclose(scan.time_s, 1e-3 * np.arange(30 + k), atol=3e-7)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_in_integer_order(tmp_path: Path, layout: str) -> None:
    path = sequence(tmp_path / "apartment_03-Aug-2011", layout)
    recording = open_recording(path)
    assert recording.name == "apartment_03-Aug-2011"
    check(recording)
    check(recording)  # iterating again starts over


@pytest.mark.parametrize("layout", ["beside", "csv", "frames", "leica"])
def test_clouds_in_the_world_are_moved_back_to_the_sensor(tmp_path: Path, layout: str) -> None:
    check(open_recording(sequence(tmp_path / "stairs", layout, world=True)), tolerance=1e-10)


@pytest.mark.parametrize("separator", [",", ", ", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_separators_and_line_ends_of_the_poses(tmp_path: Path, separator, end) -> None:
    check(open_recording(sequence(tmp_path / "plain", separator=separator, end=end)))


def test_local_clouds_are_preferred_to_those_in_the_world(tmp_path: Path) -> None:
    path = sequence(tmp_path / "eth")
    (path / "csv_global" / "PointCloud0.csv").write_text(cloud_text(CLOUDS[0] + 9.0, 0))
    check(open_recording(path))


@pytest.mark.parametrize("inside", [True, False])
def test_an_archive_as_downloaded_is_read_where_it_is(tmp_path: Path, inside: bool) -> None:
    folder = sequence(tmp_path / "gazebo_summer_04-Aug-2011", "leica")
    archive = tmp_path / "z" / "gazebo_summer.zip"
    archive.parent.mkdir()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as z:
        for file in folder.rglob("*.csv"):
            z.write(file, file.relative_to(tmp_path if inside else folder))
    shutil.rmtree(folder)
    recording = open_recording(archive)
    assert recording.name == "gazebo_summer"
    check(recording)
    assert [p.name for p in archive.parent.iterdir()] == ["gazebo_summer.zip"]


def test_archives_in_a_folder_count_as_unpacked(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "wood_autumn")
    for part in ("csv_local", "csv_global"):
        shutil.make_archive(str(folder / part), "zip", folder, part)
        shutil.rmtree(folder / part)
    check(open_recording(folder))


@pytest.mark.parametrize("inside", [True, False])
def test_archives_of_one_frame_each_give_the_poses_of_the_other(
    tmp_path: Path, inside: bool
) -> None:
    folder = sequence(tmp_path / "stairs_26-Aug-2011-14_26_14")
    for part, frame in (("csv_local", "local_frame"), ("csv_global", "global_frame")):
        (folder / part).rename(tmp_path / frame)
        (folder / part).mkdir()
        root = (tmp_path, frame) if inside else (tmp_path / frame,)
        shutil.make_archive(str(folder / part / frame), "zip", *root)
    check(open_recording(folder))


def test_the_nearest_poses_count(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "apartment", "leica")
    other = folder / "csv_local" / "pose_scanner_leica.csv"
    shutil.move(folder / "leica" / "pose_scanner_leica.csv", other)
    (folder / "leica" / "pose_scanner_leica.csv").write_text(pose_text(T @ T[0]))
    check(open_recording(folder))


def test_only_what_is_read_of_an_archive_may_not_be_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = sequence(tmp_path / "plain_01-Sep-2011-16_39_18", "leica")
    monkeypatch.setattr(archives, "_MAX_BYTES", 20_000)
    (folder / "raw.bag").write_bytes(bytes(30_000))
    archive = shutil.make_archive(str(tmp_path / "plain"), "zip", tmp_path, folder.name)
    check(open_recording(Path(archive)))
    monkeypatch.setattr(archives, "_MAX_BYTES", 1000)
    with pytest.raises(RecordingError, match=r"leica\.csv declares \d+ bytes"):
        open_recording(Path(archive))


def test_all_eight_sequences_are_known_by_name() -> None:
    names = {
        "apartment_03-Aug-2011-18_13_33": "Apartment",
        "stairs_26-Aug-2011-14_26_14": "Stairs",
        "hauptgebaude_23-Aug-2011-18_43_49": "ETH Hauptgebaude",
        "ETH": "ETH Hauptgebaude",
        "gazebo_summer_04-Aug-2011-16_13_22.zip": "Gazebo in summer",
        "Gazebo Winter": "Gazebo in winter",
        "Wood_in_summer": "Wood in summer",
        "Gazebo in winter.zip": "Gazebo in winter",
        "ETH_Hauptgebaude": "ETH Hauptgebaude",
        "Mountain_plain": "Mountain plain",
        "plain_01-Sep-2011-16_39_18": "Mountain plain",
        "wood-summer": "Wood in summer",
        "wood_autumn_09-Dec-2011-15_44_05": "Wood in autumn",
    }
    assert {name: sequence_of(name) for name in names} == names
    assert len(set(SEQUENCES.values())) == 8
    assert sequence_of("my_room") is None
    assert sequence_of("method") is None  # a word, not letters within one


def test_poses_may_be_numbered_from_one(tmp_path: Path) -> None:
    check(open_recording(sequence(tmp_path / "a", first_id=1)))


def test_a_part_of_a_sequence_keeps_its_poses(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a")
    for k in (0, 1, 2, 5):
        (path / "csv_local" / f"Hokuyo_{k}.csv").unlink()
    found = np.array([scan.T_world_sensor for scan in open_recording(path)])
    assert np.allclose(found, T[[3, 4, 6, 7, 8, 9, 10, 11]], atol=1e-11)


def test_without_poses_there_are_stamps_but_no_ground_truth(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a")
    (path / "csv_global" / "pose_scanner_leica.csv").unlink()
    scans = list(open_recording(path))
    assert [s.T_world_sensor for s in scans] == [None] * N
    assert scans[1].stamp_ns == round((START_S + 20) * 1e6) * 1000


def test_small_deviations_are_projected_and_counted(tmp_path: Path) -> None:
    poses = T.copy()
    poses[[2, 5], 0, 0] += 3e-4
    recording = open_recording(sequence(tmp_path / "a", poses=poses))
    assert recording.n_projected == 2
    assert all(se3.is_rigid(s.T_world_sensor, 1e-12) for s in recording)


def test_rows_that_are_not_finite_are_dropped_with_their_companions(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a")
    points = CLOUDS[0].copy()
    points[[3, 7], [0, 2]] = np.nan, np.inf
    (path / "csv_local" / "Hokuyo_0.csv").write_text(cloud_text(points, 0))
    scan = next(iter(open_recording(path)))
    keep = np.delete(np.arange(30), [3, 7])
    assert np.array_equal(scan.points, CLOUDS[0][keep])
    assert np.array_equal(scan.intensity, 100.5 + keep)
    assert np.allclose(scan.time_s, 1e-3 * keep, atol=3e-7)


def off(k, i, j, by):
    poses = T.copy()
    poses[k, i, j] += by
    return pose_text(poses)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("csv_global/pose_scanner_leica.csv", off(4, 0, 0, 0.01), r"leica\.csv: row 5 is not"),
        ("csv_global/pose_scanner_leica.csv", off(4, 1, 3, np.nan), r"leica\.csv: row 5 is not"),
        ("csv_global/pose_scanner_leica.csv", off(4, 3, 3, 1.0), r"leica\.csv: row 5 is not"),
        ("csv_global/pose_scanner_leica.csv", pose_text(T[:9]), "has 9 poses, but none for scan"),
        ("csv_global/pose_scanner_leica.csv", "", "no column 't00'"),
        ("csv_global/pose_scanner_leica.csv", "poseId,x\n0,1\n", "no column 't00'"),
        (
            "csv_global/pose_scanner_leica.csv",
            pose_text().replace("1314117948.250000", "1314117928.250000"),
            "row 2 does not follow in time",
        ),
        ("csv_local/Hokuyo_0.csv", "", "no column 'x'"),
        ("csv_local/Hokuyo_0.csv", HEADER + "\n", "holds no finite point"),
        ("csv_local/Hokuyo_0.csv", "a,b,c\n1,2,3\n", "no column 'x' in the header, which has"),
        ("csv_local/Hokuyo_0.csv", "t,x,y\n1,2,3\n", "no column 'z'"),
        ("csv_local/Hokuyo_0.csv", "x,y,z\n1,2\n", "cannot be read"),
        ("csv_local/Hokuyo_0.csv", "x,y,z\n1,2,3,4\n", "cannot be read"),
        ("csv_local/Hokuyo_0.csv", "x,y,z\n1,two,3\n", "cannot be read"),
        ("csv_local/Hokuyo_0.csv", "x,y,x\n1,2,3\n", "a column comes twice"),
        ("csv_local/Hokuyo_0.csv", cloud_text(CLOUDS[0], 0)[:-40], "cannot be read"),
    ],
)
def test_a_broken_file_is_one_sentence(tmp_path: Path, file, text, message) -> None:
    path = sequence(tmp_path / "a")
    (path / file).write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        list(open_recording(path))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_csv_with_crlf_gives_the_same_points(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a")
    text = "\ufeff" + cloud_text(CLOUDS[0], 0, end="\r\n")
    (path / "csv_local" / "Hokuyo_0.csv").write_text(text, newline="", encoding="utf-8")
    check(open_recording(path))


def test_world_clouds_without_poses_are_refused(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a", world=True)
    (path / "csv_global" / "pose_scanner_leica.csv").unlink()
    with pytest.raises(RecordingError, match=r"need pose_scanner_leica\.csv, which is missing"):
        open_recording(path)


def test_two_sequences_in_one_folder_are_named(tmp_path: Path) -> None:
    sequence(tmp_path / "a")
    sequence(tmp_path / "b")
    with pytest.raises(RecordingError, match="several folders, name one: a/csv_local, b/csv"):
        ChallengingRecording(tmp_path)


@pytest.mark.parametrize("name", ["../evil.csv", "/tmp/evil.csv", "a/../../evil.csv", "C:\\e.csv"])
def test_an_archive_that_escapes_is_refused_and_writes_nothing(tmp_path: Path, name: str) -> None:
    archive = tmp_path / "in" / "a.zip"
    archive.parent.mkdir()
    with zipfile.ZipFile(archive, "w") as z:
        z.writestr("csv_local/Hokuyo_0.csv", cloud_text(CLOUDS[0], 0))
        z.writestr(name, "evil")
    with pytest.raises(RecordingError, match="a path out of the archive"):
        open_recording(archive)
    assert [p.name for p in tmp_path.rglob("*")] == ["in", "a.zip"]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_cut_archive_is_one_sentence(tmp_path: Path, share: float) -> None:
    folder = sequence(tmp_path / "a")
    archive = Path(shutil.make_archive(str(tmp_path / "b"), "zip", folder))
    archive.write_bytes(archive.read_bytes()[: int(share * archive.stat().st_size)])
    with pytest.raises(RecordingError, match=r"b\.zip: cannot be read"):
        list(open_recording(archive))


def test_a_damaged_member_is_named(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "a")
    archive = Path(shutil.make_archive(str(tmp_path / "b"), "zip", folder))
    with zipfile.ZipFile(archive) as z:
        start = z.getinfo("csv_local/Hokuyo_3.csv").header_offset
    data = bytearray(archive.read_bytes())
    data[start + 120] ^= 0xFF
    archive.write_bytes(data)
    with pytest.raises(RecordingError, match=r"Hokuyo_3\.csv: cannot be read"):
        list(open_recording(archive))
