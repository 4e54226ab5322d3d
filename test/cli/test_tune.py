"""Joint poses in ``sample``, and ``tune`` from a recording without any pose."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.covariance.model import find_model, load_model, save_model
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.writers import write_folder
from cello3d_ros.tracking.warmup import room

N = 10


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of a room without any poses, one of them of five points."""
    path = tmp_path_factory.mktemp("recorded") / "mine"
    T, step, scans = np.eye(4), exp(np.array([0.15, 0.02, 0.0, 0.0, 0.0, 0.03])), []
    for k in range(N):
        points = transform(inverse(T), room(np.random.default_rng(k)))
        scans.append(Scan(stamp_ns=(k + 1) * 10**8, points=points if k != 4 else points[:5]))
        T = T @ step
    write_folder(path, scans, ".npy")
    return path


@pytest.fixture(scope="module")
def tuned(
    recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path, list[str]]:
    """A model that says a hundredth of what general says, and the same tuned."""
    folder = tmp_path_factory.mktemp("tuned")
    general = load_model(find_model("general"))
    timid, out = folder / "timid.npz", folder / "mine.npz"
    save_model(replace(general, margin=0.01 * general.margin), timid)
    flags = ["--model", str(timid), "--samples", "60", "--max-gap", "2"]
    assert main(["tune", str(recording), "--out", str(out), *flags]) == 0
    return timid, out, flags


def test_a_recording_without_poses_sizes_a_model(
    tuned: tuple[Path, Path, list[str]],
) -> None:
    timid, out, _ = tuned
    facts = load_model(out).provenance["tuned"]
    assert facts["recordings"]["mine"] >= 12
    assert facts["kind"] == "size"
    factor = load_model(out).margin / load_model(timid).margin
    assert factor == pytest.approx(facts["scale"])
    assert factor > 5.0


def test_the_dataset_says_that_its_poses_are_joint_and_which_scans_are_missing(
    tuned: tuple[Path, Path, list[str]],
) -> None:
    dataset = open_dataset(f"{tuned[1]}.dataset")
    facts = dataset.recordings["mine"]
    assert facts["poses"] == "joint"
    assert facts["n_scans"] == N - 1
    assert list(facts["left_out"]) == ["4"]
    assert 0.0 < facts["step_sigma_m"] < 0.01


def test_the_same_command_samples_nothing_again_and_gives_the_same_model(
    recording: Path, tuned: tuple[Path, Path, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, flags = tuned
    before = out.read_bytes()
    pairs = {p: p.stat().st_mtime_ns for p in Path(f"{out}.dataset").glob("pairs/*")}
    assert main(["tune", str(recording), "--out", str(out), *flags]) == 0
    told = capsys.readouterr().out
    assert "times more than the model said" in told
    assert "on the blocks of time that were held back: D2/6" in told
    assert out.read_bytes() == before
    assert {p: p.stat().st_mtime_ns for p in Path(f"{out}.dataset").glob("pairs/*")} == pairs


def test_a_tuned_model_is_not_judged_by_its_own_recording(
    tuned: tuple[Path, Path, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = tuned
    assert main(["evaluate", f"{out}.dataset", "--model", str(out)]) == 1
    assert "was trained or validated on mine" in capsys.readouterr().err


def test_clouds_are_judged_about_the_poses_that_they_were_sampled_about(
    recording: Path, tuned: tuple[Path, Path, list[str]], tmp_path: Path
) -> None:
    timid, out, _ = tuned
    report = tmp_path / "report.json"
    command = ["evaluate", f"{out}.dataset", "--model", str(timid), "--json", str(report)]
    flags = ["--recordings", str(recording), "--online-pairs", "2", "--trajectories", "2"]
    assert main([*command, *flags]) == 0
    assert list(json.loads(report.read_text())["trajectories"]) == ["mine"]


def test_sample_takes_joint_poses(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    command = ["sample", str(recording), "--out", str(out), "--samples", "50", "--max-gap", "1"]
    assert main([*command, "--poses", "joint"]) == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["recordings"]["mine"]["poses"] == "joint"
    assert len(open_dataset(out)) == N - 2


def test_joint_poses_on_a_cluster_need_shipped_clouds(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["sample", str(recording), "--out", str(tmp_path / "d"), "--poses", "joint"]
    assert main([*command, "--scheduler", "tcp://127.0.0.1:1"]) == 1
    assert "needs --ship-clouds" in capsys.readouterr().err
