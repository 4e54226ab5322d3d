"""What one recording teaches a model, and what the blocks that are held back say of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import Config, sections_of
from cello3d_ros.covariance.model import Model, find_model, load_model
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.learning import tune as tuning
from cello3d_ros.learning.dataset import Dataset, PairRecord, open_dataset
from cello3d_ros.learning.sample import sample
from cello3d_ros.learning.tune import EXAMPLES, SIZE, tune
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.recordings.writers import write_folder
from cello3d_ros.tracking.warmup import room

N, WRONG = 12, ("walk", 5, 6)


@pytest.fixture(scope="module")
def general() -> Model:
    return load_model(find_model("general"))


@pytest.fixture(scope="module")
def dataset(general: Model, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Registrations of a walk through a room with exact poses."""
    folder = tmp_path_factory.mktemp("walk")
    T, step, scans = np.eye(4), exp(np.array([0.15, 0.02, 0.0, 0.0, 0.0, 0.03])), []
    for k in range(N):
        points = transform(inverse(T), room(np.random.default_rng(k)))
        scans.append(Scan(stamp_ns=(k + 1) * 10**8, points=points, T_world_sensor=T))
        T = T @ step
    write_folder(folder / "walk", scans, ".npy")
    sampling = replace(general.sampling, precision=0.0, n_samples=60, max_gap=2)
    sections = sections_of(general.pipeline)
    config = Config(**sections, sampling=sampling)
    sample([open_recording(folder / "walk")], folder / "dataset", config, 1)
    return open_dataset(folder / "dataset")


def changed(
    dataset: Dataset, folder: Path, *, times: float = 1.0, offset_m: float = 0.0
) -> Dataset:
    """Return a copy in which the errors of one pair are multiplied and moved."""
    manifest = (dataset.path / "manifest.json").read_bytes()
    (folder / "copy").mkdir()
    (folder / "copy" / "manifest.json").write_bytes(manifest)
    copy = open_dataset(folder / "copy")
    for record in dataset:
        copy.write(record if record.key != WRONG else _off(record, times, offset_m))
    return copy


def _off(record: PairRecord, times: float, offset_m: float) -> PairRecord:
    xi = times * record.xi + offset_m * np.eye(6)[0]
    Y = times**2 * record.covariance + offset_m**2 * np.diag(np.eye(6)[0])
    return replace(record, xi=xi, covariance=Y)


def test_a_pair_far_from_the_model_is_judged_but_not_fitted_to(
    general: Model, dataset: Dataset, tmp_path: Path
) -> None:
    clean, found = tune(general, dataset), tune(general, changed(dataset, tmp_path, times=30.0))
    assert found.outliers == (WRONG,)
    assert found.flagged == ()
    assert found.after.n_pairs == clean.after.n_pairs
    assert found.scale == pytest.approx(clean.scale, rel=0.2)
    assert found.after.dm2_over_6 is not None
    assert found.after.dm2_over_6 > 10.0
    assert "walk" in found.model.provenance["tuned"]["recordings"]
    assert found.model.provenance["tuned"]["recordings"]["walk"] == len(list(dataset)) - 1


def test_a_pair_whose_registrations_contradict_its_pose_is_left_out_by_name(
    general: Model, dataset: Dataset, tmp_path: Path
) -> None:
    clean, found = tune(general, dataset), tune(general, changed(dataset, tmp_path, offset_m=0.5))
    assert found.flagged == (WRONG,)
    assert found.after.n_pairs == clean.after.n_pairs - 1
    assert found.after.dm2_over_6 == pytest.approx(clean.after.dm2_over_6, rel=0.3)


def test_the_pairs_held_back_have_the_size_that_the_others_teach(
    general: Model, dataset: Dataset
) -> None:
    timid = replace(general, margin=0.01 * general.margin)
    found, again = tune(timid, dataset), tune(general, dataset)
    assert found.kind == again.kind == SIZE
    assert found.scale == pytest.approx(100.0 * again.scale)
    assert found.after.dm2_over_6 == pytest.approx(again.after.dm2_over_6)
    assert found.after.dm2_over_6 == pytest.approx(1.0, abs=0.3)


def test_pairs_join_the_examples_where_the_model_has_a_wrong_shape(
    general: Model, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tuning, "_FEWEST_FOR_EXAMPLES", 12)
    D = np.diag([30.0, 1.0, 1.0, 1.0, 1.0, 30.0])
    few = general.projections[::1000], general.covariances[::1000]  # that a dozen pairs outweigh
    crooked = replace(general, projections=few[0], covariances=D @ few[1] @ D)
    found = tune(crooked, dataset)
    n_new = len(found.model.covariances) - len(crooked.covariances)
    assert found.kind == EXAMPLES
    assert n_new > 0
    assert n_new % (len(list(dataset)) - len(found.outliers)) == 0
    assert found.model.covariances[:-n_new] == pytest.approx(found.scale * crooked.covariances)
    size_only = tuning.figures(
        found.scale * tuning.predictions(crooked, _examples(crooked, dataset)),
        _examples(crooked, dataset),
    )
    assert found.after.kl_median is not None
    assert size_only.kl_median is not None
    assert found.after.kl_median < 0.9 * size_only.kl_median


def _examples(model: Model, dataset: Dataset) -> tuning.Examples:
    return tuning.select_inputs(tuning.load_examples([dataset], {"walk"}), model.features)
