"""``cello3d convert``: round trips through every format, atomic output, what others can read."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.convert import FORMATS
from cello3d_ros.cli.main import main
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, Scan, open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.poses import kitti_line, tum_line

START = 1_700_000_000_123_456_789
LOSSLESS = [name for name in FORMATS if name != "kitti"]


def make_scans(n: int = 4, single: bool = True, n_points: int = 50) -> list[Scan]:
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(scale=0.7, size=(2, n, 6)))
    points = [rng.normal(scale=5.0, size=(n_points + k, 3)) for k in range(n)]
    return [
        Scan(
            stamp_ns=START + k * 100_000_007,
            points=p.astype(np.float32).astype(np.float64) if single else p,
            T_world_sensor=poses[0, k],
            T_odom_sensor=poses[1, k],
            intensity=np.arange(len(p)) / 4.0,
            time_s=np.linspace(-0.05, 0.05, len(p)),
        )
        for k, p in enumerate(points)
    ]


def same(a: Scan, b: Scan) -> None:
    assert a.stamp_ns == b.stamp_ns
    assert np.array_equal(a.points, b.points)
    for name in ("T_world_sensor", "T_odom_sensor"):
        assert np.abs(getattr(a, name) - getattr(b, name)).max() < 1e-14
    assert np.array_equal(a.intensity, b.intensity)
    assert np.array_equal(a.time_s, b.time_s)


@pytest.mark.parametrize("kind", LOSSLESS)
def test_a_round_trip_keeps_everything(tmp_path: Path, kind: str) -> None:
    scans = make_scans()
    write_bag(tmp_path / "a", scans)
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--format", kind]) == 0
    assert main(["convert", str(tmp_path / "b"), str(tmp_path / "c")]) == 0
    for step in "abc":
        for a, b in zip(scans, open_recording(tmp_path / step), strict=True):
            same(a, b)


@pytest.mark.parametrize("kind", ["npy", "ply", "--double"])
def test_double_precision_is_kept_where_asked_for(tmp_path: Path, kind: str) -> None:
    scans = make_scans(single=False)
    write_bag(tmp_path / "a", scans, double=True)
    words = [kind] if kind.startswith("--") else ["--format", kind]
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), *words]) == 0
    for a, b in zip(scans, open_recording(tmp_path / "b"), strict=True):
        same(a, b)


def test_kitti_keeps_points_intensities_stamps_and_poses(tmp_path: Path) -> None:
    scans = make_scans()
    write_bag(tmp_path / "a", scans)
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "k"), "--format", "kitti"]) == 0
    for a, b in zip(scans, open_recording(tmp_path / "k"), strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert np.array_equal(a.points, b.points)
        assert np.array_equal(a.intensity, b.intensity)
        assert np.abs(a.T_world_sensor - b.T_world_sensor).max() < 1e-14


@pytest.mark.parametrize("name", ["street", "hall", "tree_road", "rooms_narrow_fov"])
@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_real_recordings_to_a_bag_and_back(evaluation, tmp_path, name: str, kind: str) -> None:
    source = evaluation / "data" / name
    assert main(["convert", str(source), str(tmp_path / "bag"), "--format", kind]) == 0
    back = ["convert", str(tmp_path / "bag"), str(tmp_path / "back"), "--format", "kitti"]
    assert main(back) == 0
    for a, b in zip(open_recording(source), open_recording(tmp_path / "back"), strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert np.array_equal(a.points, b.points)
        assert np.array_equal(a.intensity, b.intensity, equal_nan=True)
        assert np.abs(a.T_world_sensor - b.T_world_sensor).max() < 1e-14


def test_independent_readers_open_the_mcap(tmp_path: Path) -> None:
    """The official mcap package checks every chunk's checksum and decodes with its own parser."""
    make_reader = pytest.importorskip("mcap.reader").make_reader
    factory = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    scans = make_scans()
    write_bag(tmp_path / "a", scans)
    found: dict[str, list] = {}
    with (tmp_path / "a" / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[factory])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
        header, summary = reader.get_header(), reader.get_summary()
    assert header.profile == "ros2"
    assert {c.topic for c in summary.channels.values()} == set(found)
    assert set(found) == {"/points", "/odom", "/ground_truth", "/tf", "/tf_static"}
    for scan, (log_ns, cloud) in zip(scans, found["/points"], strict=True):
        assert log_ns == scan.stamp_ns
        assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == scan.stamp_ns
        assert [f.name for f in cloud.fields] == ["x", "y", "z", "intensity", "time"]
        kinds = [("p", "<f4", 3), ("intensity", "<f4"), ("time", "<f8")]
        rows = np.frombuffer(cloud.data, np.dtype(kinds))
        assert np.array_equal(rows["p"], scan.points)
        assert np.array_equal(rows["time"], scan.time_s)
    edges = {(t.header.frame_id, t.child_frame_id) for _, m in found["/tf"] for t in m.transforms}
    assert edges == {("map", "odom"), ("odom", "base_link")}
    static = found["/tf_static"][0][1].transforms[0]
    assert (static.header.frame_id, static.child_frame_id) == ("base_link", "lidar")


def test_the_metadata_has_what_ros2_bag_needs(tmp_path: Path) -> None:
    import yaml

    write_bag(tmp_path / "a", make_scans())
    (tree,) = yaml.safe_load((tmp_path / "a" / "metadata.yaml").read_text()).values()
    assert tree["version"] == 9
    assert tree["storage_identifier"] == "mcap"
    assert tree["relative_file_paths"] == ["a.mcap"]
    assert tree["starting_time"]["nanoseconds_since_epoch"] == START
    assert tree["duration"]["nanoseconds"] == 3 * 100_000_007
    counts = {
        t["topic_metadata"]["name"]: (t["message_count"], t["topic_metadata"]["type"])
        for t in tree["topics_with_message_count"]
    }
    assert counts["/points"] == (4, "sensor_msgs/msg/PointCloud2")
    assert counts["/tf_static"] == (1, "tf2_msgs/msg/TFMessage")
    assert tree["message_count"] == sum(n for n, _ in counts.values())


def test_transforms_lead_from_the_map_to_the_lidar(tmp_path: Path) -> None:
    scans = make_scans()
    write_bag(tmp_path / "a", scans)
    frames = ("map", "lidar")
    for a, b in zip(
        scans, open_recording(tmp_path / "a", ReadOptions(ground_truth_frames=frames)), strict=True
    ):
        assert np.abs(a.T_world_sensor - b.T_world_sensor).max() < 1e-13


@pytest.mark.parametrize("kind", FORMATS)
def test_an_existing_target_is_refused_and_left_alone(tmp_path, capsys, kind: str) -> None:
    write_bag(tmp_path / "a", make_scans(2))
    (tmp_path / "b").mkdir()
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--format", kind]) == 1
    assert "b exists already" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]
    assert not any((tmp_path / "b").iterdir())


@pytest.mark.parametrize("kind", FORMATS)
def test_a_source_that_ends_badly_leaves_nothing(tmp_path, capsys, kind: str) -> None:
    source = tmp_path / "a"
    write_bag(source, make_scans(8, n_points=20_000))
    file = source / "a.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x10  # a chunk's checksum no longer fits
    file.write_bytes(data)
    assert main(["convert", str(source), str(tmp_path / "b"), "--format", kind]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"cello3d: {source}: ")
    assert error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("room", [0, 500_000])
def test_a_full_disk_leaves_nothing(tmp_path: Path, kind: str, room: int) -> None:
    """No file may grow beyond ``room`` bytes: write() fails as on a full disk."""
    write_bag(tmp_path / "a", make_scans(4, n_points=70_000))
    code = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "from cello3d_ros.cli.main import main\n"
        "import rosbags.highlevel, cello3d_ros.recordings.bag\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {resource.RLIM_INFINITY}))\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = ["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--format", kind]
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("cello3d: cannot write"), done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_open3d_reads_the_ply_files(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    scans = make_scans()
    write_bag(tmp_path / "a", scans)
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--format", "ply"]) == 0
    for k, scan in enumerate(scans):
        cloud = o3d.t.io.read_point_cloud(str(tmp_path / "b" / f"{k:06d}.ply"))
        assert np.array_equal(cloud.point.positions.numpy(), scan.points)
        assert np.array_equal(cloud.point["time"].numpy().ravel(), scan.time_s)


def test_scans_beyond_the_poses_are_counted(tmp_path: Path, capsys) -> None:
    write_bag(tmp_path / "a", make_scans(4))
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--format", "npy"]) == 0
    poses = tmp_path / "b" / "ground_truth.tum"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:3]))
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "b"), str(tmp_path / "c")]) == 0
    assert "4 scans; only 3 have ground truth" in capsys.readouterr().out


def test_json_says_what_was_done(tmp_path: Path, capsys) -> None:
    write_bag(tmp_path / "a", make_scans(3))
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["n_scans"] == 3
    assert found["n_left_out"] == found["n_poses_projected"] == 0
    assert found["format"] == "mcap"


@pytest.mark.parametrize("name", ["out.ply", "one.mcap", "one.db3", "one.bag", "a.npy"])
def test_a_folder_named_like_a_file_is_refused(tmp_path: Path, capsys, name: str) -> None:
    write_bag(tmp_path / "a", make_scans(2))
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert f"{name}: a folder is made, name it without an ending: " in error
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_poses_of_a_file_are_the_ground_truth_of_any_recording(tmp_path: Path) -> None:
    """Any SLAM's: TUM by stamp, KITTI by order; what the file does not cover has none."""
    scans = make_scans(4)
    bare = [Scan(stamp_ns=s.stamp_ns, points=s.points) for s in scans]
    write_bag(tmp_path / "bare", bare)
    (tmp_path / "p.tum").write_text(
        "".join(tum_line(s.stamp_ns, s.T_world_sensor) for s in scans[:3])
    )
    (tmp_path / "p.kitti").write_text("".join(kitti_line(s.T_world_sensor) for s in scans))
    for file, n_known in (("p.tum", 3), ("p.kitti", 4)):
        out = tmp_path / f"with {file}"
        words = ["convert", str(tmp_path / "bare"), str(out), "--format", "npy"]
        assert main([*words, "--poses", str(tmp_path / file)]) == 0
        found = [scan.T_world_sensor for scan in open_recording(out)]
        assert [T is not None for T in found] == [k < n_known for k in range(4)]
        for T, scan in zip(found[:n_known], scans, strict=False):
            assert np.abs(T - scan.T_world_sensor).max() < 1e-12


def test_poses_that_fit_no_cloud_are_an_error(tmp_path: Path, capsys) -> None:
    scans = make_scans(3)
    write_bag(tmp_path / "a", scans)
    (tmp_path / "p.tum").write_text(tum_line(0, np.eye(4)) + tum_line(10**9, np.eye(4)))
    (tmp_path / "p.kitti").write_text(kitti_line(np.eye(4)))
    for file, words in (
        ("p.tum", "no pose has the time of any"),
        ("p.kitti", "has 1 poses for 3"),
    ):
        more = ["--poses", str(tmp_path / file)]
        assert main(["convert", str(tmp_path / "a"), str(tmp_path / "b"), *more]) == 1
        assert words in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
