"""``cello3d simulate``: a bag from a seed, through the verb's own arguments."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli import simulate as verb
from cello3d_ros.errors import ConfigError, RecordingError, WriteError
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.deskew import deskew
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.rescan import rescannable
from cello3d_ros.simulation.simulation import Simulation, simulate


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    return parser.parse_args(words)


def test_the_bag_holds_the_simulation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex")
    out = tmp_path / "new" / "bag"
    words = ["corridor", "--seed", "4", "--scans", "3", "--scanner", "spinning16"]
    verb.run(parsed(*words, "--out", str(out)))
    scans = simulate("corridor", 4, 3, SCANNERS["spinning16"])
    for kept, made in zip(open_recording(out), scans, strict=True):
        assert kept.stamp_ns == made.stamp_ns
        assert np.array_equal(kept.points, made.points)
        assert np.abs(kept.T_world_sensor - made.T_world_sensor).max() < 1e-9
    assert "cello3d simulate " + " ".join(words) in (out / "metadata.yaml").read_text()
    printed = capsys.readouterr()
    assert printed.out == f"{out}: 3 scans of corridor-4\n"
    assert printed.err == ""  # no progress bar where there is no terminal


@pytest.mark.parametrize(
    "words",
    [
        ["moon"],
        ["rooms", "--scanner", "x"],
        ["rooms", "--seed", "a"],
        ["rooms", "--seed", "-1"],
        ["rooms", "--scans", "0"],
    ],
)
def test_wrong_arguments_are_usage_errors(words: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        parsed(*words, "--out", str(tmp_path / "bag"))
    assert caught.value.code == 2


def test_a_taken_name_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match="exists already"):
        verb.run(parsed("rooms", "--out", str(tmp_path)))


def test_a_drive_is_told_and_its_points_carry_times(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    words = ["tunnel", "--scans", "2", "--drive", "reverse", "--scanner", "vlp16"]
    words += ["--set", "speed_m_s=4", "--set", "rate_hz=20", "--set", "azimuth_step_deg=2"]
    verb.run(parsed(*words, "--out", str(tmp_path / "bag")))
    drive = Drive(motion="reverse", speed_m_s=4.0, rate_hz=20.0)
    scanner = replace(SCANNERS["vlp16"], azimuth_step_deg=2.0)
    made = Simulation("tunnel", 0, 2, scanner, drive=drive)
    recording = open_recording(tmp_path / "bag")
    for kept, scan in zip(recording, made, strict=True):
        assert np.array_equal(kept.points, scan.points)
        assert np.allclose(kept.time_s, scan.time_s, atol=1e-9)
        undone, expected = deskew(kept, recording.track()), deskew(scan, made.track())
        assert np.abs(undone.points - expected.points).max() < 1e-5  # the first sweep as well
    metadata = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "--drive reverse" in " ".join(metadata.split())  # the file folds long lines
    assert type(rescannable(tmp_path / "bag")) is type(recording)  # its motion is in the scans


def test_a_frozen_drive_can_be_scanned_anew(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    words = ["tunnel", "--scans", "2", "--drive", "forward", "--scanner", "mid360"]
    verb.run(parsed(*words, "--set", "sweeps=false", "--out", str(tmp_path / "bag")))
    again = rescannable(tmp_path / "bag")
    assert isinstance(again, Simulation)
    for kept, scan in zip(open_recording(tmp_path / "bag"), again, strict=True):
        assert kept.time_s is None
        assert np.array_equal(kept.points, scan.points)
        assert scan.echoes is not None


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("speed_m_s=-1", "Drive.speed_m_s is out of range"),
        ("sweeps=maybe", "'maybe' is no number"),
        ("elevations_deg=1,b", "is no number"),
        ("reach_m=0", "Scanner.reach_m is out of range"),
    ],
)
def test_wrong_properties_are_one_sentence(setting: str, message: str, tmp_path: Path) -> None:
    words = ["tunnel", "--drive", "forward", "--set", setting, "--out", str(tmp_path / "bag")]
    with pytest.raises((RecordingError, ConfigError), match=message) as caught:
        verb.run(parsed(*words))
    assert "\n" not in str(caught.value)


def test_a_path_gives_as_many_scans_as_it_has_poses(tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    rows = [f"{1.6e9 + 0.1 * k:.1f} {0.05 * k} 0 1 0 0 0 1\n" for k in range(31)]
    (tmp_path / "path.tum").write_text("".join(rows))
    words = ["corridor", "--scanner", "spinning16", "--path", str(tmp_path / "path.tum")]
    verb.run(parsed(*words, "--out", str(tmp_path / "all")))
    assert len(open_recording(tmp_path / "all")) == 31
    verb.run(parsed(*words, "--scans", "2", "--out", str(tmp_path / "two")))
    assert len(open_recording(tmp_path / "two")) == 2


def test_a_bag_named_like_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"one\.mcap: a folder is made, name it without"):
        verb.run(parsed("rooms", "--out", str(tmp_path / "one.mcap")))
