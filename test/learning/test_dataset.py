"""The dataset folder: whole files, one configuration, nothing that is not finite."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import IcpConfig, Pipeline, SamplingConfig
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.errors import DatasetError, WriteError
from cello3d_ros.learning.dataset import Dataset, PairRecord, open_dataset


def accepted(recording: str = "hall", i: int = 0, j: int = 1, seed: int = 0) -> PairRecord:
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(30, 6)) * 0.01
    kept = np.arange(30) < 25
    Y = xi[kept].T @ xi[kept] / 24
    return PairRecord(
        recording=recording,
        i=i,
        j=j,
        accepted=True,
        T_mean=np.eye(4),
        xi=xi,
        kept=kept,
        n_converged=29,
        n_failed=1,
        covariance=Y,
        descriptors=rng.random((4, 704), dtype=np.float32),
        features=rng.normal(5.0, size=len(FEATURES)),
        rotations_rad=np.arange(4) * np.pi / 2,
        shapes={"hessian": np.eye(6), "sandwich": 2 * Y},
        overlap_ratio=0.8,
    )


def rejected(i: int = 1, j: int = 3) -> PairRecord:
    return PairRecord(
        recording="hall", i=i, j=j, accepted=False, reason="no_overlap", T_mean=np.eye(4)
    )


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return open_dataset(tmp_path / "set", Pipeline(), SamplingConfig(), create=True)


def assert_same(a: PairRecord, b: PairRecord) -> None:
    for setting in dataclasses.fields(PairRecord):
        x, y = getattr(a, setting.name), getattr(b, setting.name)
        assert type(x) is type(y)
        if isinstance(x, dict):
            assert x.keys() == y.keys()
            assert all(np.array_equal(x[name], y[name]) for name in x)
        else:
            assert np.array_equal(x, y)
            assert not isinstance(x, np.ndarray) or x.dtype == y.dtype


@pytest.mark.parametrize("record", [accepted(), rejected()])
def test_what_is_written_is_read_to_the_bit(dataset: Dataset, record: PairRecord) -> None:
    dataset.write(record)
    assert_same(dataset.read(*record.key), record)
    assert dataset.has(*record.key)


def test_counts_may_be_numpy_numbers(dataset: Dataset) -> None:
    counts = {"i": np.int64(0), "n_failed": np.sum([True]), "overlap_ratio": np.float32(0.5)}
    dataset.write(dataclasses.replace(accepted(), **counts, accepted=np.True_))  # type: ignore[arg-type]
    assert_same(dataset.read("hall", 0, 1), dataclasses.replace(accepted(), overlap_ratio=0.5))


def test_iteration_is_ordered_by_recording_i_j_as_numbers(dataset: Dataset) -> None:
    for name, i, j in [("b_2", 2, 3), ("b_2", 10, 11), ("a", 1, 2), ("a", 0, 2), ("b_2", 2, 11)]:
        dataset.write(accepted(name, i, j))
    wanted = [("a", 0, 2), ("a", 1, 2), ("b_2", 2, 3), ("b_2", 2, 11), ("b_2", 10, 11)]
    assert [record.key for record in dataset] == wanted == dataset.pair_keys()
    assert len(dataset) == 5


def test_equal_records_give_equal_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("one", "two"):
        dataset = open_dataset(tmp_path / name, create=True)
        dataset.add_recording("hall", {"n_scans": 3})
        dataset.write(accepted())
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        contents.append([(str(p.relative_to(tmp_path / name)), p.read_bytes()) for p in files])
    assert contents[0] == contents[1]
    assert [name for name, _ in contents[0]] == ["manifest.json", "pairs/hall_0_1.npz"]


def test_reopening_with_the_same_settings_finds_what_is_done(dataset: Dataset) -> None:
    dataset.write(rejected())
    again = open_dataset(dataset.path, Pipeline(), SamplingConfig(), create=True)
    assert again.has("hall", 1, 3)
    assert not again.has("hall", 0, 1)
    assert again.pipeline == Pipeline()
    assert again.sampling == SamplingConfig()


@pytest.mark.parametrize(
    ("pipeline", "sampling", "sentence"),
    [
        (Pipeline(icp=IcpConfig(trim_ratio=0.8)), SamplingConfig(), "icp.trim_ratio is 0.7, here"),
        (Pipeline(), SamplingConfig(variance=0.1), "sampling.variance is 0.05, here 0.1"),
        (Pipeline(), SamplingConfig(seed=1), "sampling.seed is 0, here 1"),
    ],
)
def test_other_settings_are_refused_by_name(
    dataset: Dataset, pipeline: Pipeline, sampling: SamplingConfig, sentence: str
) -> None:
    with pytest.raises(DatasetError, match=sentence):
        open_dataset(dataset.path, pipeline, sampling, create=True)


def test_a_folder_opens_for_reading_without_settings(dataset: Dataset) -> None:
    assert open_dataset(dataset.path).sampling == SamplingConfig()


def test_a_truncated_pair_counts_as_missing_and_reading_it_says_so(dataset: Dataset) -> None:
    dataset.write(accepted())
    path = dataset.path / "pairs" / "hall_0_1.npz"
    whole = path.read_bytes()
    for length in range(0, len(whole), 977):
        path.write_bytes(whole[:length])
        assert not dataset.has("hall", 0, 1)
    with pytest.raises(DatasetError, match=r"hall_0_1.npz is damaged"):
        list(dataset)
    dataset.write(accepted())
    assert dataset.has("hall", 0, 1)


def test_a_flipped_byte_is_detected_or_harmless(dataset: Dataset) -> None:
    dataset.write(accepted())
    path = dataset.path / "pairs" / "hall_0_1.npz"
    whole = path.read_bytes()
    n_detected = 0
    for position in np.random.default_rng(0).integers(0, len(whole), 300):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(bytes(damaged))
        if dataset.has("hall", 0, 1):
            assert_same(dataset.read("hall", 0, 1), accepted())
        else:
            n_detected += 1
    assert n_detected > 200


def test_a_pair_file_under_the_name_of_another_is_damage(dataset: Dataset) -> None:
    dataset.write(accepted())
    pairs = dataset.path / "pairs"
    (pairs / "hall_0_1.npz").rename(pairs / "hall_0_2.npz")
    assert not dataset.has("hall", 0, 2)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"covariance": np.full((6, 6), np.nan)}, "covariance is not finite"),
        ({"xi": np.full((30, 6), np.inf)}, "xi is not finite"),
        ({"covariance": np.diag([1.0, 1, 1, 1, 1, 0])}, "covariance is not a positive definite"),
        (
            {"covariance": np.eye(6) + np.eye(6, k=1) * 0.1},
            "covariance is not a positive definite",
        ),
        ({"shapes": {"hessian": -np.eye(6)}}, "hessian is not a positive definite"),
        ({"descriptors": np.zeros((3, 704), np.float32)}, "4 rotations"),
        ({"shapes": {"hessian": np.eye(3)}}, "hessian is not a positive definite"),
        ({"shapes": {"hessian": np.full((6, 6), np.nan)}}, "hessian is not finite"),
        (
            {
                "accepted": False,
                "reason": "offset",
                "shapes": {"hessian": np.full((6, 6), np.nan)},
            },
            "hessian is not finite",
        ),
        ({"overlap_ratio": float("nan")}, "refused to write"),
        ({"kept": np.ones(3, np.bool_)}, "disagree"),
        ({"T_mean": np.eye(3)}, "T_mean has shape"),
        ({"accepted": False}, "needs a reason"),
    ],
)
def test_unfit_records_are_refused_and_leave_nothing(
    dataset: Dataset, change: dict[str, object], sentence: str
) -> None:
    with pytest.raises(DatasetError, match=sentence):
        dataset.write(dataclasses.replace(accepted(), **change))  # type: ignore[arg-type]
    assert not dataset.has("hall", 0, 1)
    assert dataset.pair_keys() == []


def test_leftovers_of_an_interrupted_write_are_removed(dataset: Dataset) -> None:
    dataset.write(accepted())
    leftover = dataset.path / "pairs" / ".hall_0_2.npz.123.tmp"
    leftover.write_bytes(b"half")
    assert len(dataset) == 1
    open_dataset(dataset.path, Pipeline(), SamplingConfig(), create=True)
    assert not leftover.exists()


def test_a_failing_disk_is_one_sentence_and_keeps_the_old_file(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset.write(accepted(seed=1))

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(WriteError, match=r"cannot write .*hall_0_1.npz: No space left"):
        dataset.write(accepted(seed=2))
    assert_same(dataset.read("hall", 0, 1), accepted(seed=1))
    assert [path.name for path in (dataset.path / "pairs").iterdir()] == ["hall_0_1.npz"]


def test_a_folder_of_something_else_is_not_taken_over(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(DatasetError, match="is not a dataset"):
        open_dataset(tmp_path, create=True)
    with pytest.raises(DatasetError, match="is not a dataset"):
        open_dataset(tmp_path / "missing")


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 99}', '{"format": 1}', '{"format": 1, "configuration": 3}']
)
def test_a_damaged_manifest_is_one_sentence(dataset: Dataset, text: str) -> None:
    (dataset.path / "manifest.json").write_text(text)
    with pytest.raises(DatasetError, match=r"manifest.json"):
        open_dataset(dataset.path)


def test_an_unknown_setting_in_the_manifest_is_named(dataset: Dataset) -> None:
    path = dataset.path / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["configuration"]["icp"]["warp"] = 9
    path.write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match="unknown setting 'warp'"):
        open_dataset(dataset.path)


def test_another_recording_of_the_same_name_is_refused(dataset: Dataset) -> None:
    dataset.add_recording("hall", {"n_scans": 20, "duration_s": 3.5})
    again = open_dataset(dataset.path)
    again.add_recording("hall", {"n_scans": 20, "duration_s": 3.5})
    assert again.recordings == {"hall": {"n_scans": 20, "duration_s": 3.5}}
    with pytest.raises(DatasetError, match="n_scans is 20, here 21"):
        again.add_recording("hall", {"n_scans": 21, "duration_s": 3.5})


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a:b"])
def test_names_that_are_no_file_names_are_refused(dataset: Dataset, name: str) -> None:
    with pytest.raises(DatasetError, match="cannot be named"):
        dataset.has(name, 0, 1)


def test_the_manifest_says_conventions_and_versions(dataset: Dataset) -> None:
    manifest = json.loads((dataset.path / "manifest.json").read_text())
    assert "(u, omega)" in manifest["conventions"]
    assert manifest["versions"]["numpy"] == np.__version__
    assert manifest["configuration"]["icp"]["trim_ratio"] == 0.7
    assert manifest["configuration"]["sampling"]["variance"] == 0.05


def test_outcomes_tell_what_is_done_and_how_it_ended(dataset: Dataset) -> None:
    dataset.write(accepted())
    dataset.write(rejected())
    dataset.write(accepted(i=2, j=3))
    path = dataset.path / "pairs" / "hall_2_3.npz"
    path.write_bytes(path.read_bytes()[:-9])
    pairs = [(0, 1), (0, 2), (1, 3), (2, 3)]
    for n_threads in (1, 3):
        found = dataset.outcomes("hall", pairs, n_threads)
        assert found == {(0, 1): "", (1, 3): "no_overlap"}
    assert dataset.outcomes("other", pairs) == {}


def test_the_number_of_registrations_is_recorded(dataset: Dataset) -> None:
    dataset.write(accepted())
    assert dataset.read("hall", 0, 1).n_samples == 31


def test_a_manifest_from_before_precision_noise_and_backends_is_read(dataset: Dataset) -> None:
    path = dataset.path / "manifest.json"
    manifest = json.loads(path.read_text())
    for name in ("precision", "min_samples", "noise_m"):
        del manifest["configuration"]["sampling"][name]
    for name in ("backend", "max_distance_m"):
        del manifest["configuration"]["icp"][name]
    path.write_text(json.dumps(manifest))
    again = open_dataset(dataset.path, Pipeline(), SamplingConfig(), create=True)
    assert (again.pipeline, again.sampling) == (Pipeline(), SamplingConfig())
