"""Scanning a simulated recording again, from the bag that it was written to."""

from __future__ import annotations

import argparse
import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli import simulate as verb
from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.bag import BagRecording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.rescan import rescannable
from cello3d_ros.simulation.scanner import Echoes, measure
from cello3d_ros.simulation.simulation import Simulation

pytestmark = pytest.mark.skipif(find_spec("embreex") is None, reason="embreex is not installed")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    words = "corridor --seed 4 --scans 2 --scanner spinning16 --set range_noise_m=0.02"
    verb.run(parser.parse_args([*words.split(), "--out", str(tmp_path / "my_bag")]))
    return tmp_path / "my_bag"


def test_a_simulated_bag_comes_back_as_its_simulation(bag: Path) -> None:
    again = rescannable(bag)
    assert isinstance(again, Simulation)
    assert (again.name, len(again), again.scanner.range_noise_m) == ("my_bag", 2, 0.02)
    for k, (found, recorded) in enumerate(zip(again, open_recording(bag), strict=True)):
        np.testing.assert_array_equal(found.points, recorded.points)
        assert np.abs(found.T_world_sensor - recorded.T_world_sensor).max() < 1e-9
        assert found.echoes is not None
        points = measure(found.echoes, np.random.default_rng([4, k]))
        np.testing.assert_array_equal(points, recorded.points)


def test_what_was_not_simulated_is_opened_as_it_is(bag: Path, tmp_path: Path) -> None:
    write_bag(tmp_path / "other", open_recording(bag))
    assert isinstance(rescannable(tmp_path / "other"), BagRecording)
    with pytest.raises(RecordingError, match="no such file"):
        rescannable(tmp_path / "missing")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"seed": 4', '"seed": 5', "gives other scans now"),
        ('"range_noise_m": 0.02', '"range_noise_m": 0.03', "gives other scans now"),
        ('"corridor"', '"/gone/world.yaml"', "cannot be simulated again: .*gone"),
        ('"range_noise_m"', '"noise"', "cannot be simulated again: .*noise"),
        ('"n_scans": 2', '"n_scans": 0', "cannot be simulated again: .*at least one scan"),
        ('{"world"', '{{"world"', "cannot be simulated again"),
    ],
)
def test_a_simulation_that_has_changed_is_one_sentence(
    bag: Path, old: str, new: str, sentence: str
) -> None:
    file = bag / "metadata.yaml"
    text = file.read_text()
    pattern = r"\s+".join(re.escape(word) for word in old.split(" "))  # the file folds long lines
    assert re.search(pattern, text)
    file.write_text(re.sub(pattern, new, text))
    with pytest.raises(RecordingError, match=sentence) as caught:
        rescannable(bag)
    assert "\n" not in str(caught.value)


def test_new_scans_have_the_stated_noise_and_lose_other_returns() -> None:
    n = len(SCANNERS["spinning16"].directions())
    echoes = Echoes(SCANNERS["spinning16"], np.full(n, 5.0), np.ones(n))
    for sigma in (0.0, 0.01, 0.1):
        ranges = np.linalg.norm(measure(echoes, np.random.default_rng(0), sigma), axis=1)
        assert len(ranges) == pytest.approx(0.97 * n, rel=0.01)
        assert ranges.mean() == pytest.approx(5.0, abs=4 * sigma / np.sqrt(n) + 1e-6)
        assert ranges.std() == pytest.approx(sigma, rel=0.03, abs=1e-6)
    echoes.distances[: n // 2] = np.inf
    assert len(measure(echoes, np.random.default_rng(0), 0.01)) < 0.5 * n
