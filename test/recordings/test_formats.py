"""Formats as the field writes them: five columns, lists in PLY, COUNT 0, MCAP, logs of SQLite."""

import io
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from test_bag import START, cloud, make_scans, write

from cello3d_ros.cli.main import main
from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.files import read_cloud, read_columns


def room(n: int) -> np.ndarray:
    """Return points (n, 3) on the walls and the floor of a room."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-9, -6, -1.5], [9, 6, 2.5], (n, 3))
    axis = rng.integers(3, size=n)
    points[np.arange(n), axis] = np.where(rng.random(n) < 0.5, 1, -1) * np.array([9, 6, 1.5])[axis]
    return points.astype(np.float32)


FIFTH = {
    "ring": lambda n: np.arange(n) % 32,
    "time": lambda n: np.linspace(0.0, 0.1, n),
    "column of azimuth": lambda n: np.linspace(-np.pi, np.pi, n),
}


@pytest.mark.parametrize("n", [20_000, 19_999, 400])
@pytest.mark.parametrize("ending", [".pcd.bin", ".bin"])
@pytest.mark.parametrize("fifth", FIFTH)
def test_five_columns_are_read_as_five(tmp_path: Path, n: int, ending: str, fifth: str) -> None:
    points = room(n)
    rows = np.c_[points, np.full(n, 20.0), FIFTH[fifth](n)].astype("<f4")
    (tmp_path / f"a{ending}").write_bytes(rows.tobytes())
    assert np.array_equal(read_cloud(tmp_path / f"a{ending}"), points)


@pytest.mark.parametrize("n", [20_000, 400, 5])
@pytest.mark.parametrize("intensity", [0.0, 1.0])
def test_four_columns_are_read_as_four(tmp_path: Path, n: int, intensity: float) -> None:
    points = room(n)
    values = intensity * np.random.default_rng(1).random(n)
    rows = np.c_[points, values].astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    found = read_columns(tmp_path / "a.bin")
    assert np.array_equal(np.stack([found[a] for a in "xyz"], axis=1), points)


@pytest.mark.parametrize("n_columns", [3, 6])
def test_other_columns_are_refused(tmp_path: Path, n_columns: int) -> None:
    rows = np.c_[room(2000), np.full((2000, 3), [20.0, 0.5, 7.0])].astype("<f4")[:, :n_columns]
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(RecordingError, match=r"looks like [36] numbers a point"):
        read_cloud(tmp_path / "a.bin")


def test_a_cut_file_of_four_columns_is_not_taken_for_five(tmp_path: Path) -> None:
    rows = np.c_[room(2000), np.random.default_rng(0).random(2000)].astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes()[: 20 * 1501])
    with pytest.raises(RecordingError, match="no whole number of 16-byte points"):
        read_cloud(tmp_path / "a.bin")


@pytest.mark.parametrize("name", ["street", "hall", "tree_road", "rooms_narrow_fov"])
def test_real_clouds_have_four_columns(evaluation: Path, name: str) -> None:
    for file in sorted((evaluation / "data" / name / "velodyne").glob("*.bin"))[:5]:
        assert len(read_columns(file)["x"]) == file.stat().st_size // 16


def test_a_folder_of_nuscenes_has_stamps_by_name(tmp_path: Path) -> None:
    rows = np.c_[room(500), np.full(500, 3.0), np.arange(500) % 32].astype("<f4")
    for k in range(3):
        name = f"n015-2018-07-18-11-07-57+0800__LIDAR_TOP__{1531883530449377 + 50_000 * k}.pcd.bin"
        (tmp_path / name).write_bytes(rows.tobytes())
    stamps = [scan.stamp_ns for scan in open_recording(tmp_path)]
    assert stamps == [(1531883530449377 + 50_000 * k) * 1000 for k in range(3)]


POINTS = np.round(room(7), 3)


def ascii_ply(lists: bool, faces_first: bool) -> bytes:
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    vertex = "element vertex 7\n" + "".join(f"property float {a}\n" for a in "xyz")
    vertex += "property list uchar float echoes\n" if lists else ""
    rows = "".join(
        f"{x} {y} {z}" + (f" {k % 3}" + " 0.5" * (k % 3) if lists else "") + "\n"
        for k, (x, y, z) in enumerate(POINTS)
    )
    told, face_rows = (faces + vertex, "3 0 1 2\n4 0 1 2 3\n") if faces_first else (vertex, "")
    return f"ply\nformat ascii 1.0\n{told}end_header\n{face_rows}{rows}".encode()


def binary_ply(lists: bool, faces_first: bool) -> bytes:
    head = ascii_ply(lists, faces_first).split(b"end_header\n")[0]
    head = head.replace(b"format ascii", b"format binary_big_endian")
    out = io.BytesIO()
    out.write(head + b"end_header\n")
    if faces_first:
        for face in ([0, 1, 2], [0, 1, 2, 3]):
            out.write(bytes([len(face)]) + np.array(face, ">i4").tobytes())
    for k, point in enumerate(POINTS):
        out.write(point.astype(">f4").tobytes())
        if lists:
            out.write(bytes([k % 3]) + np.full(k % 3, 0.5, ">f4").tobytes())
    return out.getvalue()


@pytest.mark.parametrize("make", [ascii_ply, binary_ply])
@pytest.mark.parametrize("lists", [False, True])
@pytest.mark.parametrize("faces_first", [False, True])
def test_lists_and_other_elements_of_a_ply_are_skipped(tmp_path, make, lists, faces_first) -> None:
    whole = make(lists, faces_first)
    (tmp_path / "a.ply").write_bytes(whole)
    assert np.array_equal(read_cloud(tmp_path / "a.ply"), POINTS)
    (tmp_path / "a.ply").write_bytes(whole[:-30])
    with pytest.raises(RecordingError, match=r"a\.ply: declares"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_pcd_field_of_count_0_has_no_bytes(tmp_path: Path, encoding: str) -> None:
    head = "VERSION 0.7\nFIELDS x y empty z\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 0 1\n"
    head += f"WIDTH 7\nHEIGHT 1\nPOINTS 7\nDATA {encoding}\n"
    text = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS)
    body = text.encode() if encoding == "ascii" else POINTS.astype("<f4").tobytes()
    (tmp_path / "a.pcd").write_bytes(head.encode() + body)
    assert np.array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)
    assert set(read_columns(tmp_path / "a.pcd")) == {"x", "y", "z"}


def rewritten(source: Path, path: Path, shuffled: bool = False, **settings) -> Path:
    """Write an MCAP again with the official writer and some of its records left out."""
    make_reader = pytest.importorskip("mcap.reader").make_reader
    writer_class = pytest.importorskip("mcap.writer").Writer
    with path.open("wb") as out, source.open("rb") as stream:
        writer = writer_class(out, **settings)
        writer.start("ros2", "test")
        schemas, channels, messages = {}, {}, list(make_reader(stream).iter_messages())
        for schema, channel, message in messages[::-1] if shuffled else messages:
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return path


def mcap_cases() -> list[dict]:
    index = pytest.importorskip("mcap.writer").IndexType
    return [
        {},
        {"index_types": index.CHUNK},
        {"index_types": index.MESSAGE},
        {"index_types": index.NONE},
        {"use_statistics": False},
        {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
        {"use_summary_offsets": False, "repeat_channels": False},
        {"index_types": index.NONE, "use_statistics": False, "repeat_channels": False},
        {"use_chunking": False},
    ]


@pytest.mark.parametrize("case", range(9))
def test_an_mcap_without_some_optional_records_is_read(tmp_path: Path, case: int) -> None:
    settings = mcap_cases()[case]
    scans = make_scans(6)
    write_bag(tmp_path / "a", scans)
    path = rewritten(tmp_path / "a" / "a.mcap", tmp_path / "b.mcap", chunk_size=4000, **settings)
    found = list(open_recording(path))
    assert [s.stamp_ns for s in found] == [s.stamp_ns for s in scans]
    for a, b in zip(scans, found, strict=True):
        assert np.abs(a.T_odom_sensor - b.T_odom_sensor).max() < 1e-9


def test_an_mcap_without_chunk_index_may_hold_messages_in_any_order(tmp_path: Path) -> None:
    index = pytest.importorskip("mcap.writer").IndexType
    scans = make_scans(6)
    write_bag(tmp_path / "a", scans)
    source = tmp_path / "a" / "a.mcap"
    path = rewritten(source, tmp_path / "b.mcap", True, chunk_size=4000, index_types=index.NONE)
    assert [s.stamp_ns for s in open_recording(path)] == [s.stamp_ns for s in scans]


def test_a_cut_mcap_and_a_packed_one_say_what_helps(tmp_path: Path, capsys) -> None:
    write_bag(tmp_path / "a", make_scans(3))
    data = (tmp_path / "a" / "a.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-100])
    with pytest.raises(RecordingError, match=r"its end is missing.*`mcap recover` mends it"):
        open_recording(tmp_path / "cut.mcap")
    (tmp_path / "x_0.mcap.zstd").write_bytes(b"(\xb5/\xfd")
    assert main(["info", str(tmp_path / "x_0.mcap.zstd")]) == 1
    assert "unpack it (zstd -d x_0.mcap.zstd) first" in capsys.readouterr().err


def test_a_log_beside_an_sqlite_bag_is_named(tmp_path: Path) -> None:
    """The recorder was killed: the messages are in the log, which SQLite would merge."""
    write_bag(tmp_path / "a", make_scans(3), storage="sqlite3")
    file = tmp_path / "a" / "a.db3"
    database = sqlite3.connect(file)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("UPDATE messages SET timestamp = timestamp + 1")
    database.commit()
    shutil.copytree(tmp_path / "a", tmp_path / "killed")
    database.close()
    for path in (tmp_path / "killed", tmp_path / "killed" / "a.db3"):
        with pytest.raises(RecordingError, match=r"a\.db3-wal holds messages that are not"):
            open_recording(path)
    killed = sqlite3.connect(tmp_path / "killed" / "a.db3")
    killed.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # as the sentence says
    killed.close()
    assert len(list(open_recording(tmp_path / "killed"))) == 3


def test_scans_of_a_2d_lidar_are_called_2d(tmp_path: Path, capsys) -> None:
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY).types
    flat = room(500) * [1, 1, 0]
    clouds = [("/points", START + k, cloud("mcap", START + k * 10**8, flat)) for k in range(3)]
    path = write(tmp_path / "b", "mcap", clouds)
    assert main(["info", str(path)]) == 0
    assert "n_scans_2d                 3" in capsys.readouterr().out
    assert main(["replay", str(path), "--out", str(tmp_path / "r")]) == 1
    assert "the cloud is a 2-D scan" in capsys.readouterr().err
    head = clouds[0][2].header
    empty = np.zeros(1, np.float32)
    scan = types["sensor_msgs/msg/LaserScan"](
        head, 0.0, 1.0, 0.1, 0.0, 0.1, 0.1, 9.0, ranges=empty, intensities=empty
    )
    path = write(tmp_path / "c", "mcap", [("/scan", START, scan)])
    with pytest.raises(RecordingError, match="no PointCloud2 topic; the scans on /scan are 2-D"):
        open_recording(path)


@pytest.mark.parametrize("package", ["livox_ros_driver2", "livox_ros_driver"])
@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "bag"])
def test_livox_custom_messages_are_read(tmp_path: Path, package: str, kind: str) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from test_bag import header

    from cello3d_ros.clouds.livox import DEFINITION

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_JAZZY)
    name = f"{package}/msg/CustomMsg"
    store.register(get_types_from_msg(DEFINITION.format(package=package), name))
    point = store.types[f"{package}/msg/CustomPoint"]
    xyz = room(40)
    xyz[3] = 0.0  # no return
    points = [
        point(offset_time=k * 2_000_000, x=x, y=y, z=z, reflectivity=k, tag=0, line=k % 4)
        for k, (x, y, z) in enumerate(map(tuple, xyz.tolist()))
    ]
    if kind == "bag":
        writer, path, serialize = Writer1(tmp_path / "b.bag"), tmp_path / "b.bag", "serialize_ros1"
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer, path = Writer(tmp_path / "b", version=9, storage_plugin=plugin), tmp_path / "b"
        serialize = "serialize_cdr"
    with writer:
        connection = writer.add_connection("/livox/lidar", name, typestore=store)
        for k in range(3):
            stamp_ns = START + k * 10**8
            message = store.types[name](
                header=header(store.types, stamp_ns, kind),
                timebase=stamp_ns,
                point_num=len(points),
                lidar_id=0,
                rsvd=np.zeros(3, np.uint8),
                points=points,
            )
            writer.write(connection, stamp_ns, getattr(store, serialize)(message, name))
    scans = list(open_recording(path))
    assert [s.stamp_ns for s in scans] == [START + k * 10**8 for k in range(3)]
    keep = np.arange(40) != 3
    for scan in scans:
        assert np.array_equal(scan.points, xyz[keep])
        assert np.array_equal(scan.intensity, np.arange(40.0)[keep])
        assert np.allclose(scan.time_s, 0.002 * np.arange(40)[keep], atol=1e-12)
