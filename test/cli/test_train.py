"""``cello3d train``: what enters training, what is written, what is refused."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli import train as verb
from cello3d_ros.cli.main import main
from cello3d_ros.config import Pipeline, SamplingConfig
from cello3d_ros.covariance.archive import write_arrays
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.covariance.model import load_model
from cello3d_ros.errors import Cello3dError, DatasetError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.dataset import PairRecord, open_dataset
from cello3d_ros.learning.examples import load_examples
from cello3d_ros.learning.train import split_recordings


def fill(path: Path, names: list[str], seed: int = 0, **settings: object) -> Path:
    sampling = SamplingConfig(**settings)  # type: ignore[arg-type]
    dataset = open_dataset(path, Pipeline(), sampling, create=True)
    for name in names:
        dataset.add_recording(name, {"n_scans": 7, "fingerprint": f"of {name}"})
        rng = np.random.default_rng([seed, *name.encode()])
        for i in range(6):
            xi = rng.normal(size=(40, 6)) * 0.01
            dataset.write(
                PairRecord(
                    recording=name,
                    i=i,
                    j=i + 1,
                    accepted=i > 0,
                    reason="" if i > 0 else "offset",
                    T_mean=np.eye(4),
                    xi=xi,
                    kept=np.ones(40, np.bool_),
                    covariance=xi.T @ xi / 39,
                    descriptors=rng.random((2, 22), dtype=np.float32),
                    features=rng.normal(5.0, size=len(FEATURES)),
                    rotations_rad=np.array([0.0, np.pi / 2]),
                    shapes={"sandwich": np.eye(6) * 1e-4, "hessian": np.eye(6) * 1e-6},
                )
            )
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return fill(tmp_path / "set", ["hall_s0", "hall_s1", "hall_s3", "wood_s0", "wood_s3"])


def cello3d_train(*words: object) -> None:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    verb.run(parser.parse_args([str(word) for word in words]))


def test_a_model_with_its_provenance_and_a_table_come_out(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model.npz"
    cello3d_train(folder, "--out", out, "--validation", "*_s3")
    model = load_model(out)
    assert model.n_examples == 3 * 5  # global features: without turned copies
    assert (model.features, model.n_features) == ("global", len(FEATURES))
    assert len(model.rho_quantiles) == 101
    assert model.shape == "sandwich"
    assert model.provenance["recordings"] == {"hall_s0": 5, "hall_s1": 5, "wood_s0": 5}
    assert model.provenance["validation_recordings"] == {"hall_s3": 5, "wood_s3": 5}
    names = ("hall_s0", "hall_s1", "hall_s3", "wood_s0", "wood_s3")
    assert model.provenance["prints"] == {name: [f"of {name}"] for name in names}
    assert model.provenance["rejected_pairs"] == {"offset": 3}
    assert model.provenance["training"]["seed"] == 0
    assert model.provenance["versions"]["numpy"] == np.__version__
    printed = capsys.readouterr().out
    assert "15 pairs of 3 recordings" in printed
    assert "validation (10 pairs)" in printed
    for row in ("cello3d", "mean covariance", "constant"):
        assert f"\n  {row} " in printed
    figures = model.provenance["figures"]["validation"]["cello3d"]
    assert f"{figures['kl_mean']:.4g}" in printed


def test_validation_and_excluded_recordings_never_enter_training(
    folder: Path, tmp_path: Path
) -> None:
    outs = [tmp_path / "one.npz", tmp_path / "two.npz"]
    words = ("--validation", "hall_s3", "--exclude", "wood_*", "--config", tmp_path / "c.yaml")
    (tmp_path / "c.yaml").write_text("training: {max_iterations: 3, features: descriptor}")
    cello3d_train(folder, "--out", outs[0], *words)
    model = load_model(outs[0])
    dataset = open_dataset(folder)
    seen = load_examples([dataset], ["hall_s0", "hall_s1"])
    np.testing.assert_array_equal(model.mean, seen.features.astype(float).mean(axis=(0, 1)))
    assert model.n_examples == 2 * 5 * 2
    for name in ("hall_s3", "wood_s0", "wood_s3"):
        for i in range(1, 6):  # gone from the folder: training must not notice
            (folder / "pairs" / f"{name}_{i}_{i + 1}.npz").unlink()
    fill(folder, ["hall_s3", "wood_s0", "wood_s3"], seed=9)
    cello3d_train(folder, "--out", outs[1], *words)
    again = load_model(outs[1])
    for name in ("mean", "scale", "covariances"):
        np.testing.assert_array_equal(getattr(model, name), getattr(again, name))


def test_what_is_excluded_is_not_even_opened(folder: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "one.npz", tmp_path / "two.npz"
    words = ("--validation", "hall_s3", "--exclude", "wood_*")
    cello3d_train(folder, "--out", one, *words)
    for pair in (folder / "pairs").glob("wood_*"):
        pair.write_bytes(b"of no use to anybody")
    cello3d_train(folder, "--out", two, *words)
    assert one.read_bytes() == two.read_bytes()
    with pytest.raises(DatasetError, match="is damaged"):
        cello3d_train(folder, "--out", two, "--validation", "wood_*")


@pytest.mark.parametrize("use", ["--validation", "--exclude"])
def test_one_recording_under_two_names_has_one_use(folder: Path, tmp_path: Path, use: str) -> None:
    other = fill(tmp_path / "other", ["again"])
    manifest = other / "manifest.json"
    manifest.write_text(manifest.read_text().replace("of again", "of hall_s1"))
    with pytest.raises(DatasetError, match="'again' and 'hall_s1' are the same recording under"):
        cello3d_train(folder, other, "--out", tmp_path / "model.npz", use, "hall_s1")
    assert not (tmp_path / "model.npz").exists()
    both = ("--exclude", "hall_s1", "again")
    cello3d_train(folder, other, "--out", tmp_path / "model.npz", *both)


def test_two_recordings_under_one_name_do_not_mix(folder: Path, tmp_path: Path) -> None:
    other = fill(tmp_path / "other", ["hall_s1"])
    manifest = other / "manifest.json"
    manifest.write_text(manifest.read_text().replace("of hall_s1", "of another"))
    with pytest.raises(DatasetError, match="other: 'hall_s1' is another recording than that"):
        cello3d_train(folder, other, "--out", tmp_path / "model.npz")


def test_pairs_that_the_manifest_does_not_name_are_refused(folder: Path, tmp_path: Path) -> None:
    other = fill(tmp_path / "other", ["secret_test"])
    for pair in (other / "pairs").iterdir():
        pair.rename(folder / "pairs" / pair.name)
    with pytest.raises(DatasetError, match="pairs of 'secret_test', which its manifest does not"):
        cello3d_train(folder, "--out", tmp_path / "model.npz")


def test_an_older_manifest_without_fingerprints_is_trained_on(
    folder: Path, tmp_path: Path
) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    for facts in manifest["recordings"].values():
        del facts["fingerprint"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    cello3d_train(folder, "--out", tmp_path / "model.npz", "--validation", "*_s3")
    assert load_model(tmp_path / "model.npz").n_examples == 3 * 5


def test_a_learning_curve_stands_beside_the_model(folder: Path, tmp_path: Path) -> None:
    from matplotlib.image import imread

    for validation in ([], ["--validation", "*_s3"]):
        cello3d_train(folder, "--out", tmp_path / "model.npz", *validation)
        picture = imread(tmp_path / "model.learning_curve.png")
        assert picture.shape[0] > 300
        assert picture.std() > 0.01  # something is drawn
    first = (tmp_path / "model.learning_curve.png").read_bytes()
    cello3d_train(folder, "--out", tmp_path / "model.npz", *validation)
    assert (tmp_path / "model.learning_curve.png").read_bytes() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "model.learning_curve.png", "model.npz", "set",
    ]  # fmt: skip


def test_the_papers_descent_is_a_flag(folder: Path, tmp_path: Path) -> None:
    cello3d_train(folder, "--out", tmp_path / "model.npz", "--optimizer", "sgd")
    training = load_model(tmp_path / "model.npz").provenance["training"]
    assert (training["optimizer"], training["learning_rate"]) == ("sgd", 1e-5)


def spoiled(item: str, value: float) -> Callable[[dict[str, Array]], None]:
    def spoil(arrays: dict[str, Array]) -> None:
        arrays[item] = arrays[item].copy()
        arrays[item][0] = value

    return spoil


def test_what_cannot_be_trained_on_is_one_sentence_and_leaves_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = folder / "pairs" / "hall_s1_2_3.npz"
    with np.load(file) as archive:
        good = dict(archive)
    lone = ["--exclude", "hall_*", "wood_s3"]
    cases: list[tuple[Callable[[dict[str, Array]], None], list[str], str]] = [
        (
            spoiled("descriptors", np.nan),
            [],
            "hall_s1_2_3.npz is damaged.* descriptors is not fin",
        ),
        (spoiled("covariance", np.nan), [], "hall_s1_2_3.npz is damaged.* covariance is not fin"),
        (spoiled("covariance", 0.0), [], "hall_s1_2_3.npz is damaged.* not a positive definite"),
        (spoiled("shapes", np.inf), [], "hall_s1_2_3.npz is damaged.* is not finite"),
        (lambda arrays: None, lone, "at least two recordings.* found only wood_s0"),
        (lambda arrays: None, ["--config", str(tmp_path / "none.yaml")], "none.yaml"),
    ]
    for spoil, flags, sentence in cases:
        arrays = dict(good)
        spoil(arrays)
        write_arrays(file, arrays)
        assert main(["train", str(folder), "--out", str(tmp_path / "model.npz"), *flags]) == 1
        captured = capsys.readouterr()
        assert re.fullmatch(f"cello3d: .*{sentence}.*\n", captured.err), captured.err
        assert captured.out == ""
        assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_ctrl_c_in_training_writes_the_best_so_far(tmp_path: Path) -> None:
    out, dataset = tmp_path / "model.npz", fill(tmp_path / "set", ["a", "b", "c"])
    (tmp_path / "c.yaml").write_text(
        "training: {features: descriptor, optimizer: sgd, learning_rate: 1.0e-6, "
        "max_iterations: 1000000}"
    )
    command = [sys.executable, "-m", "cello3d_ros.cli.main", "train", dataset, "--out", out]
    controller, terminal = os.openpty()
    process = subprocess.Popen(
        [*map(str, command), "--config", str(tmp_path / "c.yaml")],
        stdout=subprocess.PIPE,
        stderr=terminal,
    )
    os.close(terminal)
    shown = b""
    while b"step 3:" not in shown:  # a terminal sees progress
        shown += os.read(controller, 1000)
    process.send_signal(signal.SIGINT)
    drain = threading.Thread(target=lambda: b"".join(iter(lambda: _read(controller), b"")))
    drain.start()
    printed, _ = process.communicate(timeout=120)
    drain.join()
    assert process.returncode == 0
    assert b"15 pairs of 3 recordings" in printed
    model = load_model(out)
    assert 3 <= model.provenance["iterations"] < 1000000
    assert 0 <= model.provenance["best_iteration"] <= model.provenance["iterations"]


def _read(controller: int) -> bytes:
    try:
        return os.read(controller, 1000)
    except OSError:  # the other end is closed
        return b""


def test_a_dataset_folder_may_be_what_is_validated_on(folder: Path, tmp_path: Path) -> None:
    other = fill(tmp_path / "other", ["stairs", "garden"])
    out = tmp_path / "model.npz"
    cello3d_train(folder, "--out", out, "--validation", other, "--theta", "diagonal")
    provenance = load_model(out).provenance
    assert sorted(provenance["validation_recordings"]) == ["garden", "stairs"]
    assert len(provenance["recordings"]) == 5
    assert provenance["training"]["theta"] == "diagonal"


def test_overrides_win_over_the_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("training: {shape: hessian, max_iterations: 2, seed: 5}")
    out = tmp_path / "model.npz"
    cello3d_train(folder, "--out", out, "--config", tmp_path / "c.yaml", "--shape", "none")
    model = load_model(out)
    assert model.shape == "none"
    assert model.provenance["training"]["seed"] == 5
    assert model.provenance["iterations"] <= 2


def test_a_pattern_that_matches_nothing_is_refused(folder: Path, tmp_path: Path) -> None:
    for option in ("--validation", "--exclude"):
        with pytest.raises(DatasetError, match=r"no recording matches 'hal_s3'.*hall_s0"):
            cello3d_train(folder, "--out", tmp_path / "model.npz", option, "hal_s3")
    assert not (tmp_path / "model.npz").exists()


@pytest.mark.parametrize(
    ("validation", "exclude", "training"),
    [
        ([], [], ["a_s0", "a_s1", "b_s0"]),
        (["*_s1"], [], ["a_s0", "b_s0"]),
        (["a_*"], ["a_s1"], ["b_s0"]),
        (["b_s0"], ["b_*"], ["a_s0", "a_s1"]),
    ],
)
def test_split(validation: list[str], exclude: list[str], training: list[str]) -> None:
    split = split_recordings(["b_s0", "a_s1", "a_s0"], validation, exclude)
    assert split.training == training
    assert not set(split.validation) & set(split.training)


def test_nothing_left_to_train_on_is_said() -> None:
    with pytest.raises(DatasetError, match="no recording is left"):
        split_recordings(["a", "b"], ["*"], [])


def test_where_the_model_cannot_go_is_said_before_training(folder: Path, tmp_path: Path) -> None:
    for out in (tmp_path / "missing" / "model.npz", tmp_path):
        with pytest.raises(Cello3dError, match="not a file in an existing folder"):
            cello3d_train(folder, "--out", out)


def test_datasets_that_do_not_mix_are_refused(folder: Path, tmp_path: Path) -> None:
    other = fill(tmp_path / "other", ["stairs"], max_offset_m=0.2)
    with pytest.raises(DatasetError, match=r"sampling.max_offset_m is 0.2, not 1.0"):
        cello3d_train(folder, other, "--out", tmp_path / "model.npz")
    far = fill(tmp_path / "far", ["stairs"], variance=0.2)
    with pytest.raises(DatasetError, match=r"sampling.variance is 0.2, not 0.05"):
        cello3d_train(folder, "--validation", far, "--out", tmp_path / "model.npz")
    unlike = fill(tmp_path / "unlike", ["stairs"], variance=0.2, max_offset_m=0.2)
    with pytest.raises(DatasetError, match=r"sampling.max_offset_m is 0.2, not 1.0"):
        cello3d_train(folder, unlike, "--out", tmp_path / "model.npz")
    twice = fill(tmp_path / "twice", ["stairs"], variance=0.3)
    with pytest.raises(DatasetError, match="hold the same pair"):
        cello3d_train(folder, far, twice, "--out", tmp_path / "model.npz")
    with pytest.raises(DatasetError, match="stairs cannot validate"):
        cello3d_train(folder, far, "--validation", "stairs", "--out", tmp_path / "model.npz")
    names = list(open_dataset(folder).recordings)
    with pytest.raises(DatasetError, match="no recording is left to train on whose starts"):
        cello3d_train(folder, far, "--exclude", *names, "--out", tmp_path / "model.npz")


def test_of_farther_starts_only_the_lost_registrations_count(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The examples are those of the near ones alone; how the lost scatter is of both."""
    far = fill(tmp_path / "far", ["stairs", "hall_s0"], seed=1, variance=0.2)
    dataset = open_dataset(far)
    for key in dataset.pair_keys():
        record = dataset.read(*key)
        xi = record.xi.copy()
        xi[:10, 0] += 5.0
        dataset.write(replace(record, xi=xi, kept=np.arange(40) >= 10))
    alone, both = tmp_path / "alone.npz", tmp_path / "both.npz"
    cello3d_train(folder, "--exclude", "hall_s0", "--out", alone)
    capsys.readouterr()
    cello3d_train(far, folder, "--exclude", "hall_s0", "--out", both)
    first, second = load_model(alone), load_model(both)
    assert "far: its starts are farther" in capsys.readouterr().out
    assert first.lost is None
    assert second.lost is not None
    n = 50  # of stairs alone: five accepted pairs
    assert second.provenance["farther_starts"] == [["far", n]]
    np.testing.assert_allclose(second.lost.covariance[0, 0], 12.5 * n / (n - 1), rtol=0.02)
    np.testing.assert_array_equal(first.covariances, second.covariances)
    np.testing.assert_array_equal(first.theta, second.theta)
    assert second.provenance["recordings"] == first.provenance["recordings"]
