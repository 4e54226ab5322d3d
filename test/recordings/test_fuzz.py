"""One damaged byte at 200 random places of each kind of file: an error, or the same, or counted.

``pytest -s`` prints the counts: errors; read as before; read otherwise (silent acceptances).
"""

import shutil
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, Scan, open_recording
from cello3d_ros.recordings.bag_messages import Messages
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.files import read_columns
from cello3d_ros.recordings.ply import write as write_ply
from cello3d_ros.recordings.writers import write_folder, write_kitti

N_PLACES = 200
START = 1_700_000_000_000_000_000
RNG = np.random.default_rng(0)
SCANS = [
    Scan(
        stamp_ns=START + k * 100_000_000,
        points=RNG.normal(scale=5.0, size=(20, 3)).astype(np.float32).astype(np.float64),
        T_world_sensor=se3.exp(RNG.normal(size=6) * 0.5),
        T_odom_sensor=se3.exp(RNG.normal(size=6) * 0.5),
        intensity=np.arange(20.0),
        time_s=np.arange(20) * 1e-3,
    )
    for k in range(3)
]


def mcap(folder: Path) -> tuple[Path, Path]:
    write_bag(folder / "a", SCANS)
    return folder / "a", folder / "a" / "a.mcap"


def foreign_mcap(folder: Path) -> tuple[Path, Path]:
    """As most recorders write it: compressed, without checksums."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "sensor_msgs/msg/PointCloud2"
    writer = Writer2(folder / "a", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer as bag:
        connection = bag.add_connection("/points", kind, typestore=store)
        for scan in SCANS:
            message = Messages(store).cloud(scan)
            bag.write(connection, scan.stamp_ns, store.serialize_cdr(message, kind))
    return folder / "a", folder / "a" / "a.mcap"


def metadata(folder: Path) -> tuple[Path, Path]:
    write_bag(folder / "a", SCANS)
    return folder / "a", folder / "a" / "metadata.yaml"


def db3(folder: Path) -> tuple[Path, Path]:
    write_bag(folder / "a", SCANS, storage="sqlite3")
    return folder / "a", folder / "a" / "a.db3"


def rosbag1(folder: Path) -> tuple[Path, Path]:
    store = get_typestore(Stores.ROS1_NOETIC)
    make = Messages(store)
    header = store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    make.header = lambda ns, frame: header(  # type: ignore[method-assign]
        seq=0, stamp=time(*divmod(ns, 10**9)), frame_id=frame
    )
    kind = "sensor_msgs/msg/PointCloud2"
    with Writer1(folder / "a.bag") as bag:
        connection = bag.add_connection("/points", kind, typestore=store)
        for scan in SCANS:
            message = make.cloud(scan)
            bag.write(connection, scan.stamp_ns, store.serialize_ros1(message, kind))
    return folder / "a.bag", folder / "a.bag"


def kitti(file: str) -> Callable[[Path], tuple[Path, Path]]:
    def build(folder: Path) -> tuple[Path, Path]:
        write_kitti(folder / "a", SCANS)
        return folder / "a", folder / "a" / file

    return build


def plain(ending: str, file: str) -> Callable[[Path], tuple[Path, Path]]:
    def build(folder: Path) -> tuple[Path, Path]:
        write_folder(folder / "a", SCANS, ending)
        return folder / "a", folder / "a" / file

    return build


def asl(file: str) -> Callable[[Path], tuple[Path, Path]]:
    def build(folder: Path) -> tuple[Path, Path]:
        pytest.importorskip("pyarrow")
        (folder / "a").mkdir()
        names = ", ".join(f"T{i}{j}" for i in range(4) for j in range(4))
        rows = [f"poseId, timestamp, {names}\n"]
        for k, scan in enumerate(SCANS):
            values = ", ".join(f"{v:.9f}" for v in scan.T_world_sensor.ravel())
            rows.append(f"{k}, {1.7e9 + k:.6f}, {values}\n")
            lines = ["Time_in_sec,x,y,z,Intensities\n"]
            lines += [f"{1.7e9 + k:.3f},{x:.6f},{y:.6f},{z:.6f},-1\n" for x, y, z in scan.points]
            (folder / "a" / f"Hokuyo_{k}.csv").write_text("".join(lines))
        (folder / "a" / "pose_scanner_leica.csv").write_text("".join(rows))
        return folder / "a", folder / "a" / file

    return build


def archive(folder: Path) -> tuple[Path, Path]:
    source, _ = asl("Hokuyo_0.csv")(folder)
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as z:
        for file in sorted(source.iterdir()):
            z.write(file, file.name)
    shutil.rmtree(source)
    return folder / "a.zip", folder / "a.zip"


def pcd(encoding: str) -> Callable[[Path], tuple[Path, Path]]:
    def build(folder: Path) -> tuple[Path, Path]:
        o3d = pytest.importorskip("open3d")
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.round(SCANS[0].points, 1)))
        options = {"write_ascii": encoding == "ascii", "compressed": encoding == "compressed"}
        assert o3d.io.write_point_cloud(str(folder / "a.pcd"), cloud, **options)
        return folder, folder / "a.pcd"

    return build


def ascii_ply(folder: Path) -> tuple[Path, Path]:
    rows = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in SCANS[0].points)
    head = "ply\nformat ascii 1.0\nelement vertex 20\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    (folder / "a.ply").write_text(f"{head}end_header\n{rows}")
    return folder, folder / "a.ply"


KINDS: dict[str, Callable[[Path], tuple[Path, Path]]] = {
    "mcap": mcap,
    "mcap zstd, no checksums": foreign_mcap,
    "metadata.yaml": metadata,
    "sqlite3": db3,
    "rosbag1": rosbag1,
    "KITTI bin": kitti("velodyne/000001.bin"),
    "KITTI poses": kitti("poses.txt"),
    "KITTI times": kitti("times.txt"),
    "KITTI calib": kitti("calib.txt"),
    "npy": plain(".npy", "000001.npy"),
    "ply binary": plain(".ply", "000001.ply"),
    "ply ascii": ascii_ply,
    "pcd binary": pcd("binary"),
    "pcd ascii": pcd("ascii"),
    "pcd compressed": pcd("compressed"),
    "TUM": plain(".npy", "ground_truth.tum"),
    "times of clouds": plain(".npy", "times.txt"),
    "ASL csv": asl("Hokuyo_1.csv"),
    "ASL poses": asl("pose_scanner_leica.csv"),
    "zip": archive,
}
CHECKSUMMED = ("mcap", "zip")


def contents(path: Path) -> list[tuple]:
    """Return all that is read, in a form that compares."""
    return [
        (
            s.stamp_ns,
            s.points.tobytes(),
            *(
                None if v is None else np.asarray(v).tobytes()
                for v in (s.T_world_sensor, s.T_odom_sensor, s.intensity, s.time_s)
            ),
        )
        for s in open_recording(path, ReadOptions(strict=True))
    ]


def fate(path: Path, before: list[tuple]) -> str:
    try:
        return "same" if contents(path) == before else "changed"
    except RecordingError as error:
        sentence = str(error)
    assert "\n" not in sentence
    assert str(path) in sentence
    return "error"


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_byte_is_an_error_or_counted(tmp_path: Path, kind: str) -> None:
    path, file = KINDS[kind](tmp_path)
    before = contents(path)
    whole, rng = file.read_bytes(), np.random.default_rng(1)
    counts: Counter[str] = Counter()
    for place in rng.integers(len(whole), size=N_PLACES):
        damaged = bytearray(whole)
        damaged[place] ^= int(rng.integers(1, 256))
        file.write_bytes(damaged)
        counts[fate(path, before)] += 1
    print(f"\n{kind}: {N_PLACES} places, {dict(counts)}")
    assert sum(counts.values()) == N_PLACES
    assert kind not in CHECKSUMMED or not counts["changed"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_or_empty_file_is_an_error_or_counted(tmp_path: Path, kind: str) -> None:
    path, file = KINDS[kind](tmp_path)
    before = contents(path)
    whole = file.read_bytes()
    counts: Counter[str] = Counter()
    for length in sorted({0, 1, *np.linspace(2, len(whole) - 1, 40).astype(int).tolist()}):
        file.write_bytes(whole[:length])
        counts[fate(path, before)] += 1
    print(f"\n{kind}: {sum(counts.values())} lengths, {dict(counts)}")
    assert counts["error"]


def test_columns_of_a_damaged_file_are_never_of_different_lengths(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", dict(zip("xyz", SCANS[0].points.T, strict=True)))
    assert {len(v) for v in read_columns(tmp_path / "a.ply").values()} == {20}
