"""``cello3d info``: what a person and a machine read about a file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli import info
from cello3d_ros.config import Config, config_to
from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.errors import Cello3dError, ModelError, RecordingError
from cello3d_ros.geometry import se3

PROVENANCE = {
    "recordings": ["rooms-0", "wood-1"],
    "validation": {"kl_mean": 1.25, "dm2_over_6": 0.97},
    "notes": {},
    "held_out": None,
}


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    info.add_arguments(parser)
    return parser.parse_args(words)


def a_model_file(folder: Path, shape: str = "none") -> Path:
    path = folder / "small.npz"
    Y = np.diag([4e-4, 4e-4, 4e-4, 1e-6, 1e-6, 1e-6])
    save_model(constant_model(Y, 704, shape=shape, provenance=PROVENANCE), path)
    return path


def test_a_table_shows_provenance_pipeline_and_sizes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info.run(parsed(str(a_model_file(tmp_path))))
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split(maxsplit=1)[1:] for line in lines if line.strip()}
    assert rows["n_examples"] == ["1"]
    assert rows["n_features"] == ["704"]
    assert rows["relative_to"] == ["none"]
    assert rows["mean_sigmas_m"] == ["0.02, 0.02, 0.02"]
    assert rows["recordings"] == ["rooms-0, wood-1"]
    assert rows["kl_mean"] == ["1.25"]
    assert rows["trim_ratio"] == ["0.7"]
    assert rows["variance"] == ["0.05"]
    assert {"provenance", "pipeline", "sampling"} <= set(lines)
    assert not any(line != line.rstrip() for line in lines)


def test_json_holds_the_same_for_a_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = a_model_file(tmp_path, "sandwich")
    info.run(parsed(str(path), "--json"))
    found = json.loads(capsys.readouterr().out)
    config = config_to(Config())
    assert found["path"] == str(path)
    assert found["relative_to"] == "sandwich"
    assert found["kind"] == "model file (.npz)"
    assert found["format_version"] == 4
    assert found["size_bytes"] == path.stat().st_size
    assert found["provenance"] == PROVENANCE
    assert found["sampling"] == config["sampling"]
    assert found["pipeline"] == {k: config[k] for k in ("cloud", "icp", "overlap", "grid")}
    assert "mean_sigmas_relative" in found
    assert "mean_sigmas_m" not in found


def test_a_table_counts_the_recordings_that_json_lists(
    capsys: pytest.CaptureFixture[str],
) -> None:
    info.run(parsed("general"))
    lines = capsys.readouterr().out.splitlines()
    rows = dict(line.split(maxsplit=1) for line in lines if "--json" in line)
    info.run(parsed("general", "--json"))
    provenance = json.loads(capsys.readouterr().out)["provenance"]
    n, n_pairs = len(provenance["recordings"]), sum(provenance["recordings"].values())
    assert rows["recordings"] == f"{n_pairs} pairs of {n} recordings (--json lists them)"
    assert rows["prints"] == f"of {len(provenance['prints'])} recordings (--json lists them)"
    assert len(lines) < 200


def test_a_path_of_no_known_kind_is_an_error_that_names_the_kinds(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(Cello3dError, match=r"notes.txt is not a model file \(\.npz\)"):
        info.run(parsed(str(tmp_path / "notes.txt")))
    with pytest.raises(Cello3dError, match="no such file"):
        info.run(parsed(str(tmp_path / "missing.npz")))


def test_a_damaged_model_is_one_sentence(tmp_path: Path) -> None:
    path = a_model_file(tmp_path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ModelError, match="truncated or damaged"):
        info.run(parsed(str(path)))


def a_bag(folder: Path) -> Path:
    from cello3d_ros.recordings import Scan
    from cello3d_ros.recordings.bag_writer import write_bag

    scans = [
        Scan(
            stamp_ns=10**18 + k * 500_000_000,
            points=np.ones((10 * (k + 1), 3)),
            T_world_sensor=se3.exp([2.0 * k, 0, 0, 0, 0, 0]),
            T_odom_sensor=np.eye(4) if k < 2 else None,
            intensity=np.zeros(10 * (k + 1)),
            time_s=np.linspace(0.0, 0.1, 10 * (k + 1)),
        )
        for k in range(3)
    ]
    write_bag(folder / "walk", scans)
    return folder / "walk"


def test_a_bag_is_described_from_end_to_end(tmp_path: Path, capsys) -> None:
    path = a_bag(tmp_path)
    info.run(parsed(str(path), "--json"))
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["recording"], found["name"]) == ("recording", "ROS bag", "walk")
    assert found["n_scans"] == found["n_scans_with_ground_truth"] == 3
    assert found["n_scans_with_odometry"] == 2
    assert found["n_scans_with_intensity"] == found["n_scans_with_point_times"] == 3
    assert found["points_per_scan"] == {"min": 10, "median": 20.0, "max": 30, "total": 60}
    assert found["duration_s"] == pytest.approx(1.0)
    assert found["time_span_s"] == pytest.approx(0.1)
    assert found["path_length_m"] == pytest.approx(4.0)
    assert found["topics"]["/points"] == "3 sensor_msgs/msg/PointCloud2"
    assert found["read_as"]["odometry"] == "/odom"


def test_topics_can_be_named(tmp_path: Path, capsys) -> None:
    info.run(parsed(str(a_bag(tmp_path)), "--odometry", "", "--json"))
    found = json.loads(capsys.readouterr().out)
    assert found["n_scans_with_odometry"] == 0
    assert found["read_as"]["odometry"] is None


def test_real_recordings_are_described(evaluation: Path, capsys) -> None:
    info.run(parsed(str(evaluation / "data" / "street")))
    text = capsys.readouterr().out
    assert "KITTI folder" in text
    assert "n_scans                    21" in text


def test_a_damaged_recording_is_one_sentence(tmp_path: Path) -> None:
    path = a_bag(tmp_path)
    (path / "walk.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match="walk: cannot be read"):
        info.run(parsed(str(path)))
    archive = tmp_path / "plain.zip"
    archive.write_bytes(b"PK\3\4 not an archive")
    with pytest.raises(RecordingError, match=r"plain\.zip: cannot be read"):
        info.run(parsed(str(archive)))


@pytest.mark.parametrize("extrinsic", [["0"] * 7, ["nan", "0", "0", "0", "0", "0", "1"]])
def test_an_extrinsic_that_is_no_pose_is_refused(tmp_path: Path, extrinsic) -> None:
    with pytest.raises(RecordingError, match="needs x y z and a unit quaternion"):
        info.run(parsed(str(a_bag(tmp_path)), "--extrinsic", *extrinsic))


def test_a_shipped_model_is_described_by_its_name(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    info.run(parsed("general"))
    assert "general.npz" in capsys.readouterr().out


def test_a_dataset_is_described(tmp_path: Path, capsys) -> None:
    from cello3d_ros.cli.main import main

    bag = str(a_bag(tmp_path))
    assert main(["sample", bag, "--out", str(tmp_path / "d"), "--samples", "50"]) == 0
    capsys.readouterr()
    info.run(parsed(str(tmp_path / "d"), "--json"))
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "dataset"
    assert found["n_pairs"] == sum(found["outcomes"].values()) == 3
    assert found["outcomes"] == {"too_few_points": 3}
    assert found["recordings"] == {"walk": "3 pairs of 3 scans"}
    assert found["sampling"]["n_samples"] == 50
