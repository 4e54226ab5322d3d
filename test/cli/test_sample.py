"""The offline tools in a row: sample two recordings, train on them, use the model."""

import json

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.geometry.se3 import exp, inverse, transform

CONFIG = """
cloud: {voxel_m: 0.1}
icp: {n_reading_points: 400, n_reference_points: 1500}
sampling: {n_samples: 20, variance: 0.01, max_gap: 2, n_rotations: 2}
training: {max_iterations: 5, rank: 2}
"""


def write_kitti(folder, seed, n_scans=4):
    """Write a KITTI folder: a furnished room seen from a short path."""
    rng = np.random.default_rng(seed)
    half = rng.uniform([3, 2, 1.2], [5, 4, 1.8])
    points = rng.uniform(-1, 1, (6000, 3)) * half
    face = rng.integers(3, size=len(points))
    points[np.arange(len(points)), face] = (rng.choice([-1, 1], len(points)) * half[face]).copy()
    velodyne = folder / "velodyne"
    velodyne.mkdir(parents=True)
    rows = []
    for k in range(n_scans):
        T = exp([0.2 * k, 0.1 * k, 0, 0, 0, 0.1 * k])
        seen = transform(inverse(T), points + rng.normal(scale=0.01, size=points.shape))
        scan = np.column_stack([seen, np.zeros(len(seen))]).astype("<f4")
        scan.tofile(velodyne / f"{k:06d}.bin")
        rows.append(T[:3].ravel())
    np.savetxt(folder / "poses.txt", rows)
    return str(folder)


@pytest.fixture
def recordings(tmp_path):
    (tmp_path / "config.yaml").write_text(CONFIG)
    return [write_kitti(tmp_path / name, seed) for seed, name in enumerate(("one", "two"))]


def sample(tmp_path, recordings, *flags):
    return main(
        [
            "sample",
            *recordings,
            "--out",
            str(tmp_path / "dataset"),
            "--config",
            str(tmp_path / "config.yaml"),
            "--jobs",
            "2",
            *flags,
        ]
    )


def contents(tmp_path):
    return {p.name: p.read_bytes() for p in (tmp_path / "dataset" / "pairs").iterdir()}


def test_what_is_missing_or_damaged_is_sampled_again_and_nothing_else(
    tmp_path, recordings, capsys
):
    assert sample(tmp_path, recordings) == 0
    assert "10 pairs accepted, 0 rejected" in capsys.readouterr().out
    before = contents(tmp_path)
    assert sorted(before)[0] == "one_0_1.npz"
    kept = tmp_path / "dataset" / "pairs" / "two_0_2.npz"
    inode = kept.stat().st_ino
    (tmp_path / "dataset" / "pairs" / "one_0_1.npz").unlink()
    damaged = tmp_path / "dataset" / "pairs" / "two_1_3.npz"
    damaged.write_bytes(before["two_1_3.npz"][:-100])
    assert sample(tmp_path, recordings) == 0
    assert contents(tmp_path) == before
    assert kept.stat().st_ino == inode


def test_other_settings_in_the_same_folder_are_refused(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings[:1]) == 0
    assert sample(tmp_path, recordings[:1], "--seed", "7") == 1
    assert "sampling.seed is 0, here 7" in capsys.readouterr().err


def test_a_setting_out_of_range_is_one_sentence(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings, "--variance", "-1") == 1
    error = capsys.readouterr().err
    assert "variance must be in [0, 10]: -1.0" in error
    assert error.count("\n") == 1


def test_a_missing_recording_is_one_sentence(tmp_path, recordings, capsys):
    assert sample(tmp_path, [str(tmp_path / "nowhere")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "dataset").exists()


def test_a_model_trained_on_samples_estimates(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings) == 0
    model = str(tmp_path / "model.npz")
    config = str(tmp_path / "config.yaml")
    dataset = str(tmp_path / "dataset")
    assert main(["train", dataset, "--out", model, "--config", config]) == 0
    capsys.readouterr()
    scans = [f"{recordings[0]}/velodyne/00000{k}.bin" for k in (1, 0)]
    assert main(["estimate", *scans, "--model", model, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    Y = np.reshape(answer["covariance_reading"], (6, 6))
    assert (np.linalg.eigvalsh(Y) > 0).all()
    assert 1e-4 < np.sqrt(Y[0, 0]) < 0.1
    np.testing.assert_allclose(
        np.reshape(answer["T_ref_read"], (4, 4)), exp([0.2, 0.1, 0, 0, 0, 0.1]), atol=0.05
    )
