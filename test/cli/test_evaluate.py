"""``cello3d evaluate``: what is refused, what is written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import SamplingConfig
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.covariance.model import constant_model, load_model, save_model
from cello3d_ros.geometry.se3 import Array, exp, inverse, transform
from cello3d_ros.learning.dataset import PairRecord, open_dataset
from cello3d_ros.registration.icp import Registration

METHODS = {
    "mean_covariance",
    "cello3d",
    "cello3d_widened",
    "constant",
    "hessian",
    "hessian_scaled",
    "sandwich",
    "sandwich_scaled",
}
ONLINE = {"censi", "censi_scaled", "sigma_points", "sigma_points_scaled", "monte_carlo", "fused"}
KEYS = {"kl_mean", "kl_median", "kl_ratio", "dm2_over_6", "coverage_95", "ms_per_pair"}
SAMPLING = SamplingConfig(variance=1e-3)


def record(name: str, i: int, offset_m: float = 0.0, n_features: int = 704) -> PairRecord:
    rng = np.random.default_rng([i, *name.encode()])
    xi = rng.normal(size=(60, 6)) * 0.01
    xi[:, 0] += offset_m
    Y = xi.T @ xi / 59
    return PairRecord(
        recording=name,
        i=i,
        j=i + 1,
        accepted=True,
        T_mean=np.eye(4),
        xi=xi,
        kept=np.ones(60, np.bool_),
        covariance=Y,
        descriptors=rng.random((1, n_features), dtype=np.float32),
        features=rng.normal(5.0, size=len(FEATURES)),
        rotations_rad=np.zeros(1),
        shapes={"sandwich": Y / 4.0, "hessian": Y * 100.0},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Dataset of a trained, a validation and two test recordings; the model beside it."""
    dataset = open_dataset(tmp_path / "set", sampling=SAMPLING, create=True)
    for name in ("hall_s0", "hall_s1", "hall_s2", "walk"):
        for i in range(2):
            dataset.write(record(name, i, 0.2 if (name, i) == ("hall_s2", 1) else 0.0))
    provenance = {
        "recordings": {"hall_s0": 2},
        "validation_recordings": {"hall_s1": 2},
    }
    model = constant_model(
        *(4.0 * np.eye(6), 704),
        shape="sandwich",
        sampling=SAMPLING,
        training_mean=np.diag([1e-3] * 6),
        provenance=provenance,
    )
    save_model(model, tmp_path / "model.npz")
    return tmp_path


@pytest.fixture
def walk(tmp_path: Path, room: tuple[Array, Array]) -> Path:
    """A KITTI folder of three scans of a room."""
    (tmp_path / "walk" / "velodyne").mkdir(parents=True)
    rows = []
    for k, scan in enumerate((room[0], room[1], room[0][::-1])):
        T = exp([0.3 * k, 0.1 * k, 0, 0, 0, 0.1 * k])
        points = np.zeros((len(scan), 4), "<f4")
        points[:, :3] = transform(inverse(T), scan)
        points.tofile(tmp_path / "walk" / "velodyne" / f"{k:06}.bin")
        rows.append(T[:3].ravel())
    np.savetxt(tmp_path / "walk" / "poses.txt", rows)
    return tmp_path / "walk"


def evaluate(folder: Path, *words: object) -> int:
    return main(["evaluate", *map(str, (folder / "set", "--model", folder / "model.npz", *words))])


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    return said.err


def test_figures_are_written_and_printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(folder, "--only", "walk", "--json", folder / "e.json") == 0
    report = json.loads((folder / "e.json").read_text())
    assert report["n_pairs"] == 2
    assert set(report["methods"]) == METHODS
    for name, figures in report["methods"].items():
        assert set(figures) >= KEYS, name
        assert figures["ms_per_pair"] is None
    assert report["methods"]["cello3d"]["kl_mean"] == pytest.approx(0.0, abs=1e-9)
    assert report["methods"]["cello3d"]["dm2_over_6"] == pytest.approx(1.0)
    assert report["methods"]["sandwich_scaled"]["scale"] == pytest.approx(4.0)
    assert report["trajectories"] == {}
    assert [pair["i"] for pair in report["pairs"]] == [0, 1]
    assert report["with_flagged_pairs"] is None
    printed = capsys.readouterr().out
    assert "walk (2 pairs)" in printed
    assert "too small: multiply by 4" in printed  # the sandwich
    assert "the model's covariances are about right (D2/6 1); " in printed
    assert "constant" in printed
    assert sorted(path.name for path in folder.iterdir()) == ["e.json", "model.npz", "set"]


def test_pairs_with_a_free_direction_have_no_answer_to_judge(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = open_dataset(folder / "set")
    for i in range(3):
        tunnel = record("tunnel", i)
        tunnel.features[FEATURES.index("log_held")] = 0.0 if i else 5.0
        dataset.write(tunnel)
    assert evaluate(folder, "--only", "tunnel", "--json", folder / "e.json") == 0
    report = json.loads((folder / "e.json").read_text())
    assert (report["n_pairs"], report["n_free"]) == (1, 2)
    assert "2 pairs are left out: no plane holds some direction" in capsys.readouterr().out
    tunnel = record("cave", 0)
    tunnel.features[FEATURES.index("log_held")] = 0.0
    dataset.write(tunnel)
    assert evaluate(folder, "--only", "cave") == 1
    assert "in every pair no plane holds some direction" in complaint(capsys)


def test_what_a_report_draws_is_written(folder: Path, walk: Path) -> None:
    words = ("--only", "walk", "--recordings", walk, "--registrations", 10, "--jobs", 1)
    out = ("--trajectories", 3, "--json", folder / "e.json")
    assert evaluate(folder, *words, *out) == 0
    report = json.loads((folder / "e.json").read_text())
    errors = np.concatenate([record("walk", i).xi for i in range(2)])
    Y = [record("walk", i).covariance for i in range(2)]
    dm2 = [x @ np.linalg.solve(Y[k // 60], x) for k, x in enumerate(errors)]
    quantiles = dict(
        zip(report["calibration"]["probabilities"], report["calibration"]["dm2"]["cello3d"])
    )
    assert quantiles[0.5] == pytest.approx(np.median(dm2))
    assert quantiles[0.95] == pytest.approx(np.quantile(dm2, 0.95))
    pair = report["pairs"][0]
    assert pair["dm2_over_6"]["cello3d"] == pytest.approx(1.0)
    assert pair["dm2_over_6"]["sandwich"] == pytest.approx(4.0)
    assert set(pair["dm2_over_6"]) == set(pair["kl"])
    worst = report["worst_pairs"]
    assert sorted((w["recording"], w["i"], w["j"]) for w in worst) == [
        ("walk", 0, 1),
        ("walk", 1, 2),
    ]
    np.testing.assert_allclose(worst[0]["xi"], record("walk", worst[0]["i"]).xi, atol=1e-7)
    np.testing.assert_allclose(worst[0]["predicted"], worst[0]["covariance"])
    assert worst[0]["kl"] >= worst[1]["kl"]
    paths = report["trajectories"]["walk"]["paths"]
    np.testing.assert_allclose(paths["truth"][2], exp([0.6, 0.2, 0, 0, 0, 0.2])[:3, 3], atol=1e-4)
    np.testing.assert_allclose(np.mean(paths["positions"], axis=0), paths["truth"][1:], atol=0.05)
    assert np.shape(paths["covariances"]) == (3, 2, 3, 3)
    assert (np.linalg.eigvalsh(paths["covariances"]) > 0.0).all()


def test_pairs_with_suspected_poses_are_named_and_left_out(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--only", "hall_s2", "walk", "--json", folder / "e.json")
    assert evaluate(folder, *words) == 0
    report = json.loads((folder / "e.json").read_text())
    check = report["pose_check"]["hall_s2"]
    assert (check["n_pairs"], check["n_flagged"], check["flagged"]) == (2, 1, [[1, 2]])
    assert report["n_pairs"] == 3
    assert report["recordings"]["hall_s2"]["n_pairs"] == 1
    assert report["with_flagged_pairs"]["n_pairs"] == 4
    assert "suspected of wrong poses: 1-2" in capsys.readouterr().out
    assert evaluate(folder, *words, "--exact-poses", "hall_*") == 0
    report = json.loads((folder / "e.json").read_text())
    assert report["n_pairs"] == 4
    assert report["pose_check"]["hall_s2"]["flagged"] == []
    assert report["pose_check"]["hall_s2"]["offset_m"] > 0.05


def test_recordings_that_the_model_has_seen_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(folder, "--json", folder / "e.json") == 1
    said = complaint(capsys)
    assert "trained or validated on hall_s0, hall_s1:" in said
    assert "hall_s2" not in said
    assert not (folder / "e.json").exists()
    assert evaluate(folder, "--allow-seen") == 0


def test_a_recording_that_the_model_has_seen_under_another_name_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = load_model(folder / "model.npz")
    prints = {"hall_s0": ["one", "1a"], "hall_s1": ["two", "2a", "2b"]}
    provenance = {**model.provenance, "prints": prints}
    save_model(replace(model, provenance=provenance), folder / "model.npz")
    dataset = open_dataset(folder / "set")
    for name, facts in (
        ("hall_s2", {"fingerprint": "four", "scans": ["2b", "2c"]}),  # a crop of hall_s1
        ("walk", {"fingerprint": "three", "scans": ["3a"]}),
    ):
        dataset.add_recording(name, facts)
    words = ("--only", "hall_s2", "walk", "--json", folder / "e.json")
    assert evaluate(folder, *words) == 1
    assert "trained or validated on hall_s2 (as hall_s1): choose" in complaint(capsys)
    assert evaluate(folder, *words, "--allow-seen") == 0
    recordings = json.loads((folder / "e.json").read_text())["recordings"]
    assert {name: part["trained_on"] for name, part in recordings.items()} == {
        "hall_s2": True,
        "walk": False,
    }
    said = capsys.readouterr().out
    assert "hall_s2: the model was trained or validated on it" in said
    assert "walk: the model was trained" not in said


def test_methods_on_clouds_and_trajectories(folder: Path, walk: Path) -> None:
    words = ("--only", "walk", "--recordings", walk, "--registrations", 10, "--jobs", 1)
    out = ("--trajectories", 3, "--json", folder / "e.json")
    assert evaluate(folder, *words, *out) == 0
    report = json.loads((folder / "e.json").read_text())
    assert set(report["methods"]) == METHODS | ONLINE
    for name in ("censi", "sigma_points", "monte_carlo", "fused"):
        assert report["methods"][name]["n_pairs"] == 2, name
        assert report["methods"][name]["ms_per_pair"] > 0.0
        assert np.isfinite(report["methods"][name]["kl_ratio"])
    assert report["methods"]["cello3d"]["kl_mean"] == pytest.approx(0.0, abs=1e-9)
    assert [report["methods"][n]["icp_runs"] for n in ("cello3d", "sigma_points", "fused")] == [
        0,
        12,
        10,
    ]
    row = report["trajectories"]["walk"]
    assert row["length_m"] == pytest.approx(2 * np.hypot(0.3, 0.1), rel=0.05)
    assert row["n_runs"] == 3
    assert {"dm_6dof", "dm_translation", "dm_rotation"} <= set(row)
    assert row["error_m"] < 0.05


def test_the_registration_that_is_judged_starts_from_the_truth(
    folder: Path, walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = []

    def remember(reading: Cloud, reference: Cloud, T_init: Array, *rest: object) -> Registration:
        starts.append(T_init)
        return Registration(T_init, 1, True, "", 0.0, 1)

    monkeypatch.setattr("cello3d_ros.evaluation.online.register", remember)
    words = ("--only", "walk", "--recordings", walk, "--online-pairs", 1)
    assert evaluate(folder, *words) == 0
    T_0, T_1 = np.eye(4), exp([0.3, 0.1, 0, 0, 0, 0.1])
    np.testing.assert_allclose(starts[-1], inverse(T_0) @ T_1, atol=1e-6)


def test_some_pairs_are_enough_for_methods_on_clouds(folder: Path, walk: Path) -> None:
    words = ("--only", "walk", "--recordings", walk, "--registrations", 10)
    assert evaluate(folder, *words, "--online-pairs", 1, "--json", folder / "e.json") == 0
    report = json.loads((folder / "e.json").read_text())
    assert report["methods"]["censi"]["n_pairs"] == 1
    assert report["methods"]["cello3d"]["n_pairs"] == 2
    assert report["trajectories"] == {}


def test_the_baseline_may_be_the_mean_of_other_datasets(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = open_dataset(folder / "other", sampling=SAMPLING, create=True)
    for i in range(2):
        other.write(record("street", i))
    words = [str(folder / "other"), "--model", str(folder / "model.npz"), "--json"]
    assert main(["evaluate", *words, str(folder / "a.json")]) == 0
    assert main(["evaluate", *words, str(folder / "b.json"), "--baseline", words[0]]) == 0
    a, b = (json.loads((folder / name).read_text())["methods"] for name in ("a.json", "b.json"))
    assert b["mean_covariance"]["kl_mean"] < 1.0 < a["mean_covariance"]["kl_mean"]
    assert a["cello3d"]["kl_mean"] == b["cello3d"]["kl_mean"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--only", "hal"), "no recording matches 'hal': there are hall_s0,"),
        (("--only", "walk", "--trajectories", 3), "trajectories need clouds"),
        (("--only", "walk", "--json", "/nowhere/e.json"), "cannot write /nowhere/e.json"),
        (("--only", "walk", "--sensor-sigma", 0), "noise must be positive"),
        (("--only", "hall_s2", "--recordings", "{walk}"), "'walk' is not among those evaluated"),
        (("--only", "walk", "--recordings", "/nowhere"), "no such file"),
    ],
)
def test_what_does_not_fit_is_said_in_one_sentence(
    words: tuple[object, ...],
    reason: str,
    folder: Path,
    walk: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert evaluate(folder, *(str(word).format(walk=walk) for word in words)) == 1
    assert reason in complaint(capsys)


def test_a_pair_beyond_the_recording_is_said(
    folder: Path, walk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    open_dataset(folder / "set").write(record("walk", 7))
    assert evaluate(folder, "--only", "walk", "--recordings", walk) == 1
    assert "walk has 3 scans, no scan 7" in complaint(capsys)


def test_descriptors_of_another_length_are_said(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = open_dataset(folder / "short", sampling=SAMPLING, create=True)
    other.write(record("street", 0, n_features=22))
    words = [str(folder / "short"), "--baseline", str(folder / "set")]
    assert main(["evaluate", *words, "--model", str(folder / "model.npz")]) == 1
    assert "descriptor input has shape (22,)" in complaint(capsys)
