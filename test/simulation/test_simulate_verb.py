"""``cello3d simulate``: a bag from a seed, through the verb's own arguments."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli import simulate as verb
from cello3d_ros.errors import RecordingError, WriteError
from cello3d_ros.recordings import open_recording
from cello3d_ros.simulation.scanner import SCANNERS
from cello3d_ros.simulation.simulation import simulate


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    return parser.parse_args(words)


def test_the_bag_holds_the_simulation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("open3d")
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
    "words", [["moon"], ["rooms", "--scanner", "x"], ["rooms", "--seed", "a"]]
)
def test_wrong_arguments_are_usage_errors(words: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        parsed(*words, "--out", str(tmp_path / "bag"))
    assert caught.value.code == 2


@pytest.mark.parametrize("words", [["--scans", "0"], ["--seed", "-1"]])
def test_values_out_of_range_are_errors(words: list[str], tmp_path: Path) -> None:
    with pytest.raises(RecordingError):
        verb.run(parsed("rooms", *words, "--out", str(tmp_path / "bag")))
    assert list(tmp_path.iterdir()) == []


def test_a_taken_name_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match="exists already"):
        verb.run(parsed("rooms", "--out", str(tmp_path)))
