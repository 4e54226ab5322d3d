"""Rosbags: round trip, the formats of others, choice of topics, damaged files."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.errors import RecordingError, WriteError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, Scan, open_recording
from cello3d_ros.recordings.bag import BagRecording
from cello3d_ros.recordings.bag_writer import write_bag

CLOUD, ODOMETRY = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"
POSE, TRANSFORM = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
TF = "tf2_msgs/msg/TFMessage"
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND + 123_456_789
FORMATS = ["bag", "sqlite3", "mcap"]


def make_scans(n: int = 5, n_points: int = 200) -> list[Scan]:
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(scale=0.7, size=(2, n, 6)))
    return [
        Scan(
            stamp_ns=START + k * SECOND // 2,
            points=rng.normal(scale=5.0, size=(n_points + k, 3)),
            T_world_sensor=poses[0, k],
            T_odom_sensor=poses[1, k],
        )
        for k in range(n)
    ]


def store(kind: str):
    return get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_JAZZY)


def header(types, stamp_ns: int, kind: str):
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    extra = {"seq": 0} if kind == "bag" else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id="x", **extra)


def cloud(kind: str, stamp_ns: int, points, **changes):
    types = store(kind).types
    field = types["sensor_msgs/msg/PointField"]
    values = {
        "header": header(types, stamp_ns, kind),
        "height": 1,
        "width": len(points),
        "fields": [field(name=a, offset=4 * i, datatype=7, count=1) for i, a in enumerate("xyz")],
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(points),
        "data": np.asarray(points, dtype="<f4").reshape(-1).view(np.uint8),
        "is_dense": True,
    }
    return types[CLOUD](**(values | changes))


def pose(kind: str, stamp_ns: int, T, msgtype: str = ODOMETRY, quaternion=None):
    types = store(kind).types
    rotation = types["geometry_msgs/msg/Quaternion"](
        *(float(v) for v in (se3.quaternion(T) if quaternion is None else quaternion))
    )
    head, xyz = header(types, stamp_ns, kind), [float(v) for v in T[:3, 3]]
    if msgtype == TRANSFORM:
        transform = types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](*xyz), rotation=rotation
        )
        return types[TRANSFORM](header=head, child_frame_id="x", transform=transform)
    place = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*xyz), orientation=rotation
    )
    if msgtype == POSE:
        return types[POSE](header=head, pose=place)
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    return types[ODOMETRY](
        header=head,
        child_frame_id="x",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=place, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero),
            covariance=np.zeros(36),
        ),
    )


def write(path: Path, kind: str, messages) -> Path:
    """Write (topic, recorded at, message) with rosbags alone; returns the path."""
    typestore, connections = store(kind), {}
    if kind == "bag":
        writer, serialize = Writer1(path.with_suffix(".bag")), typestore.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
        serialize = typestore.serialize_cdr
    with writer:
        for topic, stamp_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=typestore
                )
            writer.write(connections[topic], stamp_ns, serialize(message, message.__msgtype__))
    return path.with_suffix(".bag") if kind == "bag" else path


def foreign(path: Path, kind: str, scans: list[Scan], truth: str = ODOMETRY) -> Path:
    """Write scans as another program might: poses late, between and around the clouds."""
    messages = []
    for s in scans:
        messages.append(("/velodyne", s.stamp_ns + 5, cloud(kind, s.stamp_ns, s.points)))
        odom, world = (pose(kind, s.stamp_ns, s.T_odom_sensor), s.T_world_sensor)
        messages.append(("/odom", s.stamp_ns + 9, odom))
        messages.append(("/ground_truth", s.stamp_ns + 9, pose(kind, s.stamp_ns, world, truth)))
    return write(path, kind, messages)


def same(scan: Scan, other: Scan) -> None:
    assert scan.stamp_ns == other.stamp_ns
    assert np.array_equal(scan.points, other.points.astype(np.float32))
    assert np.abs(scan.T_world_sensor - other.T_world_sensor).max() < 1e-9
    assert np.abs(scan.T_odom_sensor - other.T_odom_sensor).max() < 1e-9


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    scans = make_scans()
    write_bag(tmp_path / "one", iter(scans))
    for path in (tmp_path / "one", tmp_path / "one" / "one.mcap"):
        recording = open_recording(path)
        assert recording.name == "one"
        assert len(recording) == len(scans)
        for _ in range(2):  # iterating again starts over
            for scan, other in zip(recording, scans, strict=True):
                same(scan, other)


def test_a_folder_named_like_a_rosbag1_is_read(tmp_path: Path) -> None:
    scans = make_scans()
    write_bag(tmp_path / "drive.bag", scans)
    for scan, other in zip(open_recording(tmp_path / "drive.bag"), scans, strict=True):
        same(scan, other)


def test_scans_without_poses_are_read_back_without(tmp_path: Path) -> None:
    bare = [Scan(stamp_ns=s.stamp_ns, points=s.points) for s in make_scans(3)]
    write_bag(tmp_path / "bare", bare)
    recording = BagRecording(tmp_path / "bare")
    assert recording.topics == ("/points", None, None)
    assert all(s.T_world_sensor is None and s.T_odom_sensor is None for s in recording)
    assert list(recording.odometry()) == []


def test_odometry_is_dense_ordered_and_reaches_every_cloud(tmp_path: Path) -> None:
    scans = make_scans(4)
    write_bag(tmp_path / "one", scans, odometry=10)
    track = list(BagRecording(tmp_path / "one").odometry())
    assert [stamp for stamp, _ in track] == [START + k * SECOND // 20 for k in range(31)]
    halfway = se3.interpolate(scans[0].T_odom_sensor, scans[1].T_odom_sensor, 0.5)
    assert np.allclose(track[5][1], halfway, atol=1e-12)
    with Reader(tmp_path / "one") as reader:
        order = [(stamp, c.topic) for c, stamp, _ in reader.messages()]
    assert [stamp for stamp, _ in order] == sorted(stamp for stamp, _ in order)
    for k, (stamp, topic) in enumerate(order):
        assert topic != "/points" or (stamp, "/odom") in order[:k]


def test_a_written_bag_says_what_players_need(tmp_path: Path) -> None:
    write_bag(tmp_path / "one", make_scans(2), provenance={"made_by": "a test"})
    with Reader(tmp_path / "one") as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == {
            "/points": CLOUD, "/odom": ODOMETRY, "/ground_truth": ODOMETRY,
            "/tf": TF, "/tf_static": TF,
        }  # fmt: skip
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            assert qos.reliability.name == "RELIABLE"
            late = connection.topic == "/tf_static"  # who comes late must hear it too
            assert qos.durability.name == ("TRANSIENT_LOCAL" if late else "VOLATILE")
            assert connection.ext.serialization_format == "cdr"
        first = {}
        for connection, _, raw in reader.messages():
            message = store("mcap").deserialize_cdr(raw, connection.msgtype)
            first.setdefault(connection.topic, message)
    assert first["/points"].header.frame_id == "lidar"
    assert [f.name for f in first["/points"].fields] == ["x", "y", "z"]
    assert (first["/odom"].header.frame_id, first["/odom"].child_frame_id) == ("odom", "lidar")
    assert first["/ground_truth"].header.frame_id == "map"
    assert not first["/odom"].pose.covariance.any()
    assert "made_by: a test" in (tmp_path / "one" / "metadata.yaml").read_text()


@pytest.mark.parametrize("kind", FORMATS)
def test_bags_of_others_are_read(tmp_path: Path, kind: str) -> None:
    scans = make_scans()
    recording = open_recording(foreign(tmp_path / "walk", kind, scans))
    assert recording.name == "walk"
    assert len(recording) == len(scans)
    for scan, other in zip(recording, scans, strict=True):
        same(scan, other)


@pytest.mark.parametrize("msgtype", [POSE, TRANSFORM])
@pytest.mark.parametrize("kind", FORMATS)
def test_ground_truth_of_other_types_is_read(tmp_path: Path, kind: str, msgtype: str) -> None:
    scans = make_scans(3)
    path = foreign(tmp_path / "walk", kind, scans, msgtype)
    for scan, other in zip(open_recording(path), scans, strict=True):
        same(scan, other)


def test_poses_are_interpolated_at_the_cloud_and_absent_outside_their_span(tmp_path) -> None:
    T0, T1 = np.eye(4), se3.exp([1, 2, 3, 0, 0, 1.0])
    points = np.ones((4, 3))
    messages = [("/p", t, cloud("mcap", t, points)) for t in (10, 125, 300)]
    messages += [("/odom", 900, pose("mcap", t, T)) for t, T in ((200, T1), (100, T0))]
    before, within, after = open_recording(write(tmp_path / "b", "mcap", messages))
    assert before.T_odom_sensor is None
    assert after.T_odom_sensor is None
    assert within.T_world_sensor is None
    assert np.allclose(within.T_odom_sensor, se3.interpolate(T0, T1, 0.25))


def test_a_message_without_a_stamp_has_the_time_of_recording(tmp_path: Path) -> None:
    path = write(tmp_path / "b", "mcap", [("/p", 77, cloud("mcap", 0, np.ones((4, 3))))])
    assert [s.stamp_ns for s in open_recording(path)] == [77]


def messages_of(topics: dict[str, str]):
    """Return one message on each topic, of the given type."""
    for topic, msgtype in topics.items():
        message = (
            cloud("mcap", 1, np.ones((3, 3)))
            if msgtype == CLOUD
            else pose("mcap", 1, np.eye(4), msgtype)
        )
        yield topic, 1, message


def chosen(tmp_path: Path, topics: dict[str, str], **named: str) -> SimpleNamespace:
    path = write(tmp_path / "b", "mcap", messages_of(topics))
    return SimpleNamespace(**BagRecording(path, ReadOptions(**named)).topics._asdict())


def test_topics_are_found_by_type(tmp_path: Path) -> None:
    topics = chosen(tmp_path, {"/a": CLOUD, "/b": ODOMETRY, "/c": POSE})
    assert (topics.points, topics.odometry, topics.ground_truth) == ("/a", "/b", "/c")


def test_of_several_odometries_the_usual_names_count(tmp_path: Path) -> None:
    topics = chosen(
        tmp_path, {"/a": CLOUD, "/x": ODOMETRY, "/odom": ODOMETRY, "/ground_truth": ODOMETRY}
    )
    assert (topics.odometry, topics.ground_truth) == ("/odom", "/ground_truth")


def test_an_only_odometry_called_ground_truth_is_not_odometry(tmp_path: Path) -> None:
    topics = chosen(tmp_path, {"/a": CLOUD, "/ground_truth": ODOMETRY})
    assert (topics.odometry, topics.ground_truth) == (None, "/ground_truth")


def test_topics_can_be_named_and_left_out(tmp_path: Path) -> None:
    topics = chosen(
        tmp_path, {"/a": CLOUD, "/b": CLOUD, "/odom": ODOMETRY, "/x": ODOMETRY, "/y": POSE},
        points="/b", odometry="/x", ground_truth="",
    )  # fmt: skip
    assert (topics.points, topics.odometry, topics.ground_truth) == ("/b", "/x", None)


@pytest.mark.parametrize(
    ("topics", "named", "message"),
    [
        ({"/a": CLOUD, "/b": CLOUD}, {}, "several PointCloud2 topics, name one of /a, /b"),
        ({"/x": ODOMETRY}, {}, "no PointCloud2 topic; it has /x"),
        ({"/a": CLOUD}, {"points": "/b"}, "no PointCloud2 topic '/b'; candidates are /a"),
        ({"/a": CLOUD}, {"points": ""}, "no PointCloud2 topic"),
        ({"/a": CLOUD, "/x": ODOMETRY, "/y": ODOMETRY}, {}, "several Odometry topics.*/x, /y"),
        ({"/a": CLOUD, "/x": POSE, "/y": TRANSFORM}, {}, "several ground truth topics.*/x, /y"),
        ({"/a": CLOUD, "/x": POSE}, {"odometry": "/x"}, "no Odometry topic '/x'"),
        ({"/a": CLOUD}, {"ground_truth": "/a"}, "no ground truth topic '/a'"),
    ],
)
def test_a_choice_that_is_not_clear_lists_candidates(tmp_path, topics, named, message) -> None:
    path = write(tmp_path / "b", "mcap", messages_of(topics))
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(path, ReadOptions(**named))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, np.nan, 1)])
def test_a_bad_odometry_message_is_an_error_with_topic_and_path(tmp_path, quaternion) -> None:
    bad = pose("mcap", 5, np.eye(4), quaternion=quaternion)
    path = write(tmp_path / "b", "mcap", [("/odom", 1, bad), *messages_of({"/a": CLOUD})])
    with pytest.raises(RecordingError, match=r"b: /odom: the (pose|quaternion) is "):
        list(open_recording(path, ReadOptions(strict=True)))
    sentence = r"/odom: none of its 1 poses can be used: /odom: the (pose|quaternion) is "
    with pytest.raises(RecordingError, match=sentence):
        list(open_recording(path))


def test_a_malformed_cloud_is_an_error_with_its_number_when_strict(tmp_path: Path) -> None:
    good = cloud("mcap", 1, np.ones((3, 3)))
    short = cloud("mcap", 2, np.ones((3, 3)), width=9, row_step=108)
    path = write(tmp_path / "b", "mcap", [("/p", 1, good), ("/p", 2, short)])
    scans = iter(open_recording(path, ReadOptions(strict=True)))
    assert len(next(scans).points) == 3
    with pytest.raises(RecordingError, match=r"b: cloud 1 of /p: "):
        next(scans)


def test_clouds_out_of_order_are_an_error_when_strict(tmp_path: Path) -> None:
    clouds = [("/p", t, cloud("mcap", s, np.ones((3, 3)))) for t, s in ((1, 9), (2, 8))]
    path = write(tmp_path / "b", "mcap", clouds)
    with pytest.raises(RecordingError, match="b: the stamp 8 of a cloud on /p does not follow 9"):
        list(open_recording(path, ReadOptions(strict=True)))


def data_file(path: Path) -> Path:
    return path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
def test_a_truncated_bag_is_one_sentence_with_the_path(tmp_path, kind, share) -> None:
    path = foreign(tmp_path / "walk", kind, make_scans())
    file = data_file(path)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(RecordingError) as caught:
        list(open_recording(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", FORMATS)
def test_random_damage_is_an_error_or_passes_but_never_anything_else(tmp_path, kind) -> None:
    path = foreign(tmp_path / "walk", kind, make_scans(3, 20))
    file = data_file(path)
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    sentences = []
    for _ in range(40):
        damaged = np.frombuffer(whole, dtype=np.uint8).copy()
        damaged[rng.integers(len(whole), size=20)] = rng.integers(256, size=20)
        file.write_bytes(damaged.tobytes())
        try:
            assert all(np.isfinite(scan.points).all() for scan in open_recording(path))
        except RecordingError as error:
            sentences.append(str(error))
    assert sentences
    assert all(s.startswith(f"{path}: ") and "\n" not in s for s in sentences)


def test_a_missing_path_an_empty_folder_and_a_stranger_are_errors(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="gone: no such file or folder"):
        open_recording(tmp_path / "gone")
    with pytest.raises(RecordingError, match=r"gone\.bag: no such file or folder"):
        open_recording(tmp_path / "gone.bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="empty: no recording; expected a rosbag2 folder"):
        open_recording(tmp_path / "empty")
    with pytest.raises(RecordingError, match=r"empty: no metadata\.yaml"):
        BagRecording(tmp_path / "empty")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RecordingError, match="no recording; expected"):
        open_recording(tmp_path / "notes.txt")


def test_broken_metadata_is_an_error(tmp_path: Path) -> None:
    write_bag(tmp_path / "one", make_scans(2))
    for text in ("{", "", "rosbag2_bagfile_information: 5", "a: b"):
        (tmp_path / "one" / "metadata.yaml").write_text(text)
        with pytest.raises(RecordingError, match="one: cannot be read"):
            open_recording(tmp_path / "one")


def test_a_bag_with_fewer_clouds_than_it_declares_is_an_error(tmp_path: Path) -> None:
    bare = [Scan(stamp_ns=s.stamp_ns, points=s.points) for s in make_scans(3)]
    write_bag(tmp_path / "one", bare)
    metadata = tmp_path / "one" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 3\n", "message_count: 4\n"))
    scans = iter(open_recording(tmp_path / "one"))
    assert [next(scans).stamp_ns for _ in range(3)]
    with pytest.raises(RecordingError, match="one: ends early, after 3 of 4 clouds"):
        next(scans)


def test_a_bag_with_fewer_poses_than_it_declares_is_an_error(tmp_path: Path) -> None:
    write_bag(tmp_path / "one", make_scans(3))
    metadata = tmp_path / "one" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 21\n", "message_count: 22\n"))
    with pytest.raises(RecordingError, match="one: /odom: ends early, after 21 of 22 poses"):
        list(open_recording(tmp_path / "one"))


def test_an_existing_target_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    with pytest.raises(WriteError, match="one exists already"):
        write_bag(tmp_path / "one", make_scans(2))
    assert list(tmp_path.iterdir()) == [tmp_path / "one"]


def test_a_failure_while_writing_leaves_nothing_behind(tmp_path: Path) -> None:
    def broken():
        yield from make_scans(2)
        raise RecordingError("the scanner broke")

    with pytest.raises(RecordingError, match="the scanner broke"):
        write_bag(tmp_path / "one", broken())
    with pytest.raises(RecordingError, match="no scan"):
        write_bag(tmp_path / "one", [])
    with pytest.raises(RecordingError, match="not in order of time"):
        write_bag(tmp_path / "one", make_scans(2)[::-1])
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WriteError, match="cannot write"):
        write_bag(tmp_path / "file" / "one", make_scans(2))


def test_the_demo_bag_is_whole_small_and_what_its_command_says() -> None:
    folder = Path(__file__).parents[2] / "bags" / "demo"
    assert sum(f.stat().st_size for f in folder.iterdir()) < 8_000_000
    scans = list(open_recording(folder))
    assert len(scans) == 25
    assert all(s.T_world_sensor is not None and s.T_odom_sensor is not None for s in scans)
    assert min(len(s.points) for s in scans) > 10_000
    metadata = (folder / "metadata.yaml").read_text()
    command = "cello3d simulate garden --seed 7 --scans 25"
    assert command in metadata
    assert command in (folder.parent / "README.md").read_text()


def test_the_demo_bag_comes_from_its_seed() -> None:
    pytest.importorskip("embreex")
    from cello3d_ros.simulation.simulation import simulate

    folder = Path(__file__).parents[2] / "bags" / "demo"
    for made, kept in zip(simulate("garden", 7, 25), open_recording(folder), strict=True):
        assert np.abs(made.T_world_sensor - kept.T_world_sensor).max() < 1e-9
        assert np.abs(made.T_odom_sensor - kept.T_odom_sensor).max() < 1e-9
        # a ray that grazes an edge may end on either side of it on another machine
        assert abs(len(made.points) - len(kept.points)) <= 0.005 * len(kept.points)


def test_a_moved_bag_is_still_readable(tmp_path: Path) -> None:
    write_bag(tmp_path / "one", make_scans(2))
    shutil.move(tmp_path / "one", tmp_path / "two")
    assert len(list(open_recording(tmp_path / "two"))) == 2
