"""Poses of bags in other frames: TF, extrinsics of /tf_static or given; split and packed bags."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, Scan, open_recording
from cello3d_ros.recordings.bag_messages import Messages

STORE = get_typestore(Stores.ROS2_JAZZY)
MAKE = Messages(STORE)
START, STEP = 1_700_000_000_000_000_000, 100_000_000
N = 5
RNG = np.random.default_rng(0)
TRUTH = se3.exp(RNG.normal(scale=0.6, size=(N, 6)))
ODOM = se3.exp(RNG.normal(scale=0.6, size=(N, 6)))
MOUNT = se3.exp([0.3, 0.1, 1.2, 0.2, -0.1, 0.8])  # pose of lidar in base_link
POINTS = RNG.normal(size=(20, 3))


def stamp(k: int) -> int:
    return START + k * STEP


def write(path: Path, messages, **writer) -> Path:
    plugin = writer.pop("plugin", StoragePlugin.MCAP)
    connections: dict = {}
    bag = Writer(path, version=9, storage_plugin=plugin)
    if writer:
        bag.set_compression(**writer)
    with bag:
        for topic, stamp_ns, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(
                    topic, message.__msgtype__, typestore=STORE
                )
            bag.write(
                connections[topic], stamp_ns, STORE.serialize_cdr(message, message.__msgtype__)
            )
    return path


def clouds(n: int = N):
    return [
        ("/points", stamp(k), MAKE.cloud(Scan(stamp_ns=stamp(k), points=POINTS + k)))
        for k in range(n)
    ]


def odometry(child: str = "base_link"):
    for k in range(N):
        message = MAKE.odometry(ODOM[k], stamp(k), "odom")
        message.child_frame_id = child
        yield "/odom", stamp(k), message


def mount():
    yield "/tf_static", stamp(0), MAKE.transform(MOUNT, stamp(0), "base_link", "lidar")


def tf(parent="map", child="base_link", poses=TRUTH):
    for k in range(N):
        yield "/tf", stamp(k), MAKE.transform(poses[k], stamp(k), parent, child)


def test_odometry_of_the_base_is_moved_to_the_lidar_by_static_transforms(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *odometry(), *clouds()])
    for k, scan in enumerate(open_recording(path)):
        assert np.allclose(scan.T_odom_sensor, ODOM[k] @ MOUNT, atol=1e-12)


def test_static_transforms_may_be_chained_and_inverted(tmp_path: Path) -> None:
    chain = [
        (
            "/tf_static",
            stamp(0),
            MAKE.transform(se3.inverse(MOUNT), stamp(0), "mast", "base_link"),
        ),
        ("/tf_static", stamp(0), MAKE.transform(MOUNT, stamp(0), "mast", "lidar")),
    ]
    path = write(tmp_path / "b", [*chain, *odometry(), *clouds()])
    for k, scan in enumerate(open_recording(path)):
        assert np.allclose(scan.T_odom_sensor, ODOM[k] @ MOUNT @ MOUNT, atol=1e-12)


def test_an_extrinsic_that_is_given_counts_more(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *odometry(), *clouds()])
    given = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    for k, scan in enumerate(open_recording(path, ReadOptions(T_base_sensor=given))):
        assert np.allclose(scan.T_odom_sensor, ODOM[k] @ given, atol=1e-12)


def test_poses_of_the_lidar_itself_stay(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *odometry("lidar"), *clouds()])
    for k, scan in enumerate(open_recording(path)):
        assert np.allclose(scan.T_odom_sensor, ODOM[k], atol=1e-12)


@pytest.mark.parametrize("frame", ["somewhere", "base_link"])
def test_where_nothing_connects_frames_the_error_names_the_option(tmp_path, frame) -> None:
    transforms = mount() if frame == "somewhere" else []
    path = write(tmp_path / "b", [*odometry(frame), *transforms, *clouds()])
    sentence = rf"b: the poses on /odom are of '{frame}', the clouds of 'lidar', .* --extrinsic X"
    with pytest.raises(RecordingError, match=sentence):
        list(open_recording(path))
    for k, scan in enumerate(open_recording(path, ReadOptions(T_base_sensor=MOUNT))):
        assert np.allclose(scan.T_odom_sensor, ODOM[k] @ MOUNT, atol=1e-12)


def test_a_mount_that_turns_is_no_extrinsic(tmp_path: Path) -> None:
    turning = [se3.exp([0, 0, 0, 0, 0, 0.1 * k]) for k in range(N)]
    path = write(tmp_path / "b", [*odometry(), *tf("base_link", "lidar", turning), *clouds()])
    with pytest.raises(RecordingError, match="--extrinsic"):
        list(open_recording(path))


def test_ground_truth_from_tf_between_two_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *tf(), *clouds()])
    for frame in ("lidar", "base_link"):
        for k, scan in enumerate(
            open_recording(path, ReadOptions(ground_truth_frames=("map", frame)))
        ):
            assert np.allclose(scan.T_world_sensor, TRUTH[k] @ MOUNT, atol=1e-12)


def test_tf_is_composed_over_time_and_interpolated(tmp_path: Path) -> None:
    messages = [*mount(), *tf("map", "odom"), *tf("odom", "base_link", ODOM)]
    late = Scan(stamp_ns=stamp(1) + STEP // 4, points=POINTS)
    path = write(tmp_path / "b", [*messages, ("/points", late.stamp_ns, MAKE.cloud(late))])
    (scan,) = open_recording(path, ReadOptions(ground_truth_frames=("/map", "lidar")))
    parts = [se3.interpolate(T[1], T[2], 0.25) for T in (TRUTH, ODOM)]
    assert np.allclose(scan.T_world_sensor, parts[0] @ parts[1] @ MOUNT, atol=1e-12)


def test_tf_is_walked_upward_too(tmp_path: Path) -> None:
    """As localisation publishes it that must keep odom the child: base_link -> world."""
    path = write(
        tmp_path / "b", [*mount(), *tf("base_link", "world", se3.inverse(TRUTH)), *clouds()]
    )
    for k, scan in enumerate(
        open_recording(path, ReadOptions(ground_truth_frames=("world", "lidar")))
    ):
        assert np.allclose(scan.T_world_sensor, TRUTH[k] @ MOUNT, atol=1e-12)


def test_outside_the_span_of_tf_there_is_no_ground_truth(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *list(tf())[:3], *clouds()])
    found = [
        s.T_world_sensor
        for s in open_recording(path, ReadOptions(ground_truth_frames=("map", "lidar")))
    ]
    assert [T is not None for T in found] == [True, True, True, False, False]


def test_frames_that_nothing_connects_are_an_error_that_lists_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *tf(), *clouds()])
    with pytest.raises(RecordingError, match="connect 'mars' and 'lidar'; frames are base_link"):
        list(open_recording(path, ReadOptions(ground_truth_frames=("mars", "lidar"))))
    bare = write(tmp_path / "c", clouds())
    with pytest.raises(RecordingError, match="no TFMessage topic"):
        open_recording(bare, ReadOptions(ground_truth_frames=("map", "lidar")))


def test_the_track_is_that_of_the_sensor(tmp_path: Path) -> None:
    path = write(tmp_path / "b", [*mount(), *odometry(), *clouds()])
    for (stamp_ns, T), k in zip(open_recording(path).track(), range(N), strict=True):
        assert stamp_ns == stamp(k)
        assert np.allclose(T, ODOM[k] @ MOUNT, atol=1e-12)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_bags_are_read(tmp_path: Path, plugin, mode) -> None:
    kwargs = {"mode": mode, "fmt": CompressionFormat.ZSTD, "plugin": plugin}
    path = write(tmp_path / "b", [*odometry("lidar"), *clouds()], **kwargs)
    for k, scan in enumerate(open_recording(path)):
        assert np.array_equal(scan.points, (POINTS + k).astype(np.float32))
        assert np.allclose(scan.T_odom_sensor, ODOM[k], atol=1e-12)


def test_compressed_chunks_are_read(tmp_path: Path) -> None:
    kwargs = {"mode": CompressionMode.STORAGE, "fmt": CompressionFormat.ZSTD}
    path = write(tmp_path / "b", [*odometry("lidar"), *clouds()], **kwargs)
    assert len(list(open_recording(path))) == N


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_split_bag_is_read_in_order(tmp_path: Path, plugin) -> None:
    """Parts without metadata.yaml, as after a crash of the recorder."""
    (tmp_path / "all").mkdir()
    both = [*odometry("lidar"), *clouds()]
    for part, lot in enumerate(([0, 1, 2], [3, 4])):
        chosen = [m for m in both if (m[1] - START) // STEP in lot]
        folder = write(tmp_path / f"p{part}", chosen, plugin=plugin)
        file = next(f for f in folder.iterdir() if f.suffix in (".mcap", ".db3"))
        file.rename(tmp_path / "all" / file.name)
    scans = list(open_recording(tmp_path / "all"))
    assert [s.stamp_ns for s in scans] == [stamp(k) for k in range(N)]
    assert all(np.allclose(s.T_odom_sensor, ODOM[k]) for k, s in enumerate(scans))


@pytest.mark.parametrize(
    "packed", [None, Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4]
)
def test_a_split_rosbag1_is_read_in_order(tmp_path: Path, packed) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    make = Messages(store)
    header = store.types["std_msgs/msg/Header"]
    make.header = lambda ns, frame: header(  # type: ignore[method-assign]
        seq=0, stamp=store.types["builtin_interfaces/msg/Time"](*divmod(ns, 10**9)), frame_id=frame
    )
    for part, lot in enumerate(([0, 1, 2], [3, 4])):
        writer = Writer1(tmp_path / f"walk_{part}.bag")
        if packed is not None:
            writer.set_compression(packed)
        with writer as bag:
            kind = "sensor_msgs/msg/PointCloud2"
            connection = bag.add_connection("/points", kind, typestore=store)
            for k in lot:
                message = make.cloud(Scan(stamp_ns=stamp(k), points=POINTS + k))
                bag.write(connection, stamp(k), store.serialize_ros1(message, kind))
    scans = list(open_recording(tmp_path))
    assert [s.stamp_ns for s in scans] == [stamp(k) for k in range(N)]


def test_a_split_bag_with_metadata_is_read(tmp_path: Path) -> None:
    """As ros2 bag record --max-bag-size leaves it: one metadata.yaml, several files."""
    import yaml

    first = write(tmp_path / "s", clouds()[:3])
    second = write(tmp_path / "t", clouds()[3:])
    (second / "t.mcap").rename(first / "t.mcap")
    meta = yaml.safe_load((first / "metadata.yaml").read_text())
    info = meta["rosbag2_bagfile_information"]
    info["relative_file_paths"].append("t.mcap")
    info["message_count"] = info["topics_with_message_count"][0]["message_count"] = N
    info["duration"]["nanoseconds"] = 4 * STEP
    (first / "metadata.yaml").write_text(yaml.safe_dump(meta))
    recording = open_recording(first)
    assert len(recording) == len(list(recording)) == N
