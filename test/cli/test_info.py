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
from cello3d_ros.errors import Cello3dError, ModelError

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
    assert rows["cutoff_rho"] == ["none"]
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
    assert found["format_version"] == 1
    assert found["size_bytes"] == path.stat().st_size
    assert found["provenance"] == PROVENANCE
    assert found["sampling"] == config["sampling"]
    assert found["pipeline"] == {k: config[k] for k in ("cloud", "icp", "overlap", "grid")}
    assert "mean_sigmas_relative" in found
    assert "mean_sigmas_m" not in found


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
