"""Recordings taken in motion are sampled without it, and the dataset says so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from sweeps import swept

from cello3d_ros.config import Config
from cello3d_ros.evaluation import evaluate
from cello3d_ros.geometry import se3
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.learning.identity import scan_prints
from cello3d_ros.learning.sample import sample
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.deskew import WithoutMotion, without_motion

N = 4


def bag(path: Path, **changes) -> Path:
    """Write scans stamped at the end of their sweep; the first begins before all poses."""
    scans = [replace(swept(k), **changes) for k in range(N)]
    write_bag(path, scans, double=True, odometry=4)
    return path


def test_scans_are_straight_where_poses_cover_them_and_else_as_they_are(tmp_path) -> None:
    recording = open_recording(bag(tmp_path / "drive"))
    found = without_motion(recording)
    assert (found.times, len(found)) == ("", N)
    for k, (raw, scan) in enumerate(zip(recording, found, strict=True)):
        places = np.abs(se3.transform(scan.T_world_sensor, scan.points))
        off = np.abs(places - [6.0, 4.8, 3.0]).min(axis=1)  # walls, floor and ceiling
        assert np.array_equal(scan.T_world_sensor, raw.T_world_sensor)
        assert np.mean(off < 0.01) > 0.75 if k else np.array_equal(scan.points, raw.points)
    for name, time_s in (("no-times", None), ("equal-times", np.zeros(len(swept(0).points)))):
        other = open_recording(bag(tmp_path / name, time_s=time_s))
        assert without_motion(other) is other


def test_the_manifest_says_that_the_motion_is_undone_and_evaluation_follows(tmp_path) -> None:
    path, out = bag(tmp_path / "drive"), tmp_path / "dataset"
    config = Config()
    config = replace(config, sampling=replace(config.sampling, n_samples=50, max_gap=1))
    sample([path], out, config)
    dataset = open_dataset(out)
    facts = dataset.recordings["drive"]
    assert facts["motion"] == "undone"
    assert facts["scans"] == scan_prints(open_recording(path))  # as recorded: crops are known
    (recording,) = evaluate._recordings([path], ["drive"], [dataset])
    assert isinstance(recording, WithoutMotion)
