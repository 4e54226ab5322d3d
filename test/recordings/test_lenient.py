"""One bad message costs that message: it is counted, and the rest is read."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_bag import START, cloud, pose, write

from cello3d_ros.cli.main import main
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import ReadOptions, open_recording

STEP = 10**8
STAMPS = [START + k * STEP for k in range(6)]
POINTS = np.random.default_rng(0).normal(size=(50, 3))


def clouds(stamps, points=POINTS):
    """Return clouds recorded one after the other, whatever their stamps."""
    return [
        ("/points", START + k * STEP + 5, cloud("mcap", t, points)) for k, t in enumerate(stamps)
    ]


def odometry(quaternions=None):
    for k, t in enumerate(STAMPS):
        q = (quaternions or {}).get(k)
        yield "/odom", t, pose("mcap", t, se3.exp([0.1 * k, 0, 0, 0, 0, 0]), quaternion=q)


def in_time(messages):
    return sorted(messages, key=lambda message: message[1])


@pytest.mark.parametrize(
    ("stamps", "kept", "skipped"),
    [
        ([0, 0, 0, 1, 2, 3], [0, 1, 2, 3], {"duplicate_stamp": 2}),
        ([0, 1, 3, 2, 4, 5], [0, 1, 3, 4, 5], {"out_of_order": 1}),
        ([0, 1, 50_000, 2, 3, 4], [0, 1, 2, 3, 4], {"out_of_order": 1}),
        ([50_000, 1, 2, 3, 4, 5], [1, 2, 3, 4, 5], {"out_of_order": 1}),
        ([0, 1, 2, 3, 4, 50_000], [0, 1, 2, 3, 4, 50_000], {}),
        ([3, 4, 5, 0, 1, 2], [3, 4, 5], {"out_of_order": 3}),
    ],
)
def test_clouds_out_of_order_are_left_out(tmp_path: Path, stamps, kept, skipped) -> None:
    path = write(tmp_path / "b", "mcap", clouds([START + k * STEP for k in stamps]))
    recording = open_recording(path)
    assert [(s.stamp_ns - START) // STEP for s in recording] == kept
    assert recording.skipped == skipped
    assert len(recording) == len(kept)
    assert recording.n_declared == 6
    assert len(open_recording(path)) == len(kept)  # also before anything has been read


@pytest.mark.parametrize(
    "change",
    [
        {"width": 9999, "row_step": 12 * 9999},
        {"point_step": 0},
        {"fields": []},
        {"data": np.zeros(3, np.uint8)},
    ],
)
@pytest.mark.parametrize("place", [0, 3, 5])
def test_a_malformed_cloud_is_left_out_wherever_it_is(tmp_path, change, place) -> None:
    messages = clouds(STAMPS)
    bad = cloud("mcap", STAMPS[place], POINTS, **change)
    messages[place] = ("/points", messages[place][1], bad)
    recording = open_recording(write(tmp_path / "b", "mcap", messages))
    assert [s.stamp_ns for s in recording] == [t for k, t in enumerate(STAMPS) if k != place]
    assert recording.skipped == {"malformed": 1}


def test_bytes_that_are_no_message_are_left_out(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "sensor_msgs/msg/PointCloud2"
    with Writer(tmp_path / "b", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/points", kind, typestore=store)
        for k, (_, t, message) in enumerate(clouds(STAMPS)):
            raw = b"\0\1\0\0\7" if k == 2 else store.serialize_cdr(message, kind)
            writer.write(connection, t, raw)
    recording = open_recording(tmp_path / "b")
    assert len(list(recording)) == 5
    assert recording.skipped == {"malformed": 1}


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, np.nan, 1), (0, 0, 0, 3)])
def test_a_pose_that_is_none_is_left_out(tmp_path: Path, quaternion) -> None:
    messages = [*odometry({0: quaternion}), *clouds(STAMPS)]
    recording = open_recording(write(tmp_path / "b", "mcap", in_time(messages)))
    scans = list(recording)
    assert [s.T_odom_sensor is None for s in scans] == [True, *[False] * 5]
    assert recording.skipped == {"unusable_pose": 1}


def test_with_nothing_left_it_is_refused_and_the_first_reason_named(tmp_path: Path) -> None:
    messages = [(t, s, cloud("mcap", s, POINTS, fields=[])) for t, s, _ in clouds(STAMPS)]
    recording = open_recording(write(tmp_path / "b", "mcap", messages))
    sentence = r"b: none of its 6 clouds can be read; of the first: .*no field 'x'"
    with pytest.raises(RecordingError, match=sentence):
        list(recording)
    with pytest.raises(RecordingError, match=sentence):
        len(recording)


def test_strict_refuses_the_bag(tmp_path: Path, capsys) -> None:
    path = write(tmp_path / "b", "mcap", clouds([STAMPS[0], *STAMPS[:3]]))
    with pytest.raises(RecordingError, match="does not follow"):
        list(open_recording(path, ReadOptions(strict=True)))
    assert main(["info", str(path)]) == 0
    assert "duplicate_stamp" in capsys.readouterr().out
    assert main(["info", str(path), "--strict"]) == 1


def test_convert_says_what_was_left_out(tmp_path: Path, capsys) -> None:
    path = write(tmp_path / "b", "mcap", clouds([STAMPS[0], *STAMPS[:3]]))
    assert main(["convert", str(path), str(tmp_path / "c")]) == 0
    assert "3 scans; 1 message left out: duplicate stamp" in capsys.readouterr().out
    assert main(["convert", str(path), str(tmp_path / "d"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["n_scans"], found["n_left_out"]) == (3, 0)
    assert found["skipped"] == {"duplicate_stamp": 1}


@pytest.mark.parametrize("ending", ["npy", "ply"])
def test_a_file_that_cannot_be_read_is_left_out_of_a_folder(tmp_path: Path, ending) -> None:
    path = write(tmp_path / "b", "mcap", in_time([*odometry(), *clouds(STAMPS)]))
    assert main(["convert", str(path), str(tmp_path / "c"), "--format", ending]) == 0
    file = tmp_path / "c" / f"000002.{ending}"
    file.write_bytes(file.read_bytes()[:-30])
    recording = open_recording(tmp_path / "c")
    scans = list(recording)
    assert [s.stamp_ns for s in scans] == [t for t in STAMPS if t != STAMPS[2]]
    assert np.allclose(scans[2].T_odom_sensor[:3, 3], [0.3, 0, 0])  # poses stay with their clouds
    assert recording.skipped == {"malformed": 1}
