"""The model: laws of the prediction (check 15), and a file that is read with suspicion."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cello3d_ros.config import (
    CloudConfig,
    GridConfig,
    IcpConfig,
    Pipeline,
    SamplingConfig,
    pipeline_name,
)
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.covariance.lost import Lost
from cello3d_ros.covariance.model import (
    SHIPPED,
    Model,
    constant_model,
    find_model,
    load_model,
    predict,
    project,
    save_model,
    shipped_model_path,
    weigh,
)
from cello3d_ros.errors import ModelError, WriteError
from cello3d_ros.geometry import gaussian
from cello3d_ros.geometry.gaussian import INDEPENDENT, Bias, is_positive_definite
from cello3d_ros.geometry.se3 import Array, adjoint, exp

N, D, R = 40, 7, 3
ARRAYS = ("theta", "mean", "scale", "projections", "covariances", "rho_quantiles")
UNITS = np.outer([1e-2] * 3 + [1e-3] * 3, [1e-2] * 3 + [1e-3] * 3)


def covariances(n: int = N, seed: int = 1) -> Array:
    """Return random covariances of the size that ICP has.  (n, 6, 6)."""
    A = np.random.default_rng(seed).standard_normal((n, 6, 12))
    return gaussian.symmetrized(A @ np.swapaxes(A, 1, 2) / 12) * UNITS


def descriptors(n: int = N, seed: int = 2) -> Array:
    """Return random descriptors.  (n, D)."""
    return np.random.default_rng(seed).uniform(0, 1, (n, D))


def model_of(theta: Array, d: Array, Y: Array, **settings: Any) -> Model:
    mean, scale = d.mean(axis=0), np.maximum(d.std(axis=0), 1e-3)
    return Model(
        theta=theta,
        mean=mean,
        scale=scale,
        projections=project(d, theta, mean, scale),
        covariances=Y,
        **settings,
    )


def a_model(factor: float = 1.0, **settings: Any) -> Model:
    theta = factor * np.random.default_rng(3).standard_normal((R, D))
    return model_of(theta, descriptors(), covariances(), **settings)


def weighted_mean(model: Model, d: Array) -> Array:
    """Return the paper's F by its printed formula, one example at a time."""
    q = model.theta @ ((d - model.mean) / model.scale)
    s = [math.exp(-float((q - p) @ (q - p))) for p in model.projections]
    terms = [w * Y for w, Y in zip(s, model.covariances, strict=True)]
    return np.asarray(np.sum(terms, axis=0) / sum(s))


# --- prediction -----------------------------------------------------------------------------


def test_prediction_is_the_printed_weighted_mean() -> None:
    model = a_model(0.3)
    for d in descriptors(5, seed=4):
        np.testing.assert_allclose(
            predict(model, d).covariance, weighted_mean(model, d), rtol=1e-11
        )


def test_zero_theta_predicts_the_training_mean() -> None:
    model = a_model(0.0)
    F, nearest, neighbors, _ = predict(model, descriptors(1, seed=5)[0])
    np.testing.assert_allclose(F, model.covariances.mean(axis=0), rtol=1e-13)
    assert nearest == 0.0
    assert neighbors == pytest.approx(N)


@pytest.mark.parametrize("factor", [1e3, 1e8, 1e100])
def test_very_large_theta_predicts_the_nearest_example(factor: float) -> None:
    model = a_model(factor)
    for d in descriptors(20, seed=6):
        q = project(d, model.theta, model.mean, model.scale)
        k = np.argmin(np.linalg.norm((model.projections - q) / factor, axis=1))
        F, nearest, neighbors, _ = predict(model, d)
        np.testing.assert_allclose(F, model.covariances[k], rtol=1e-12)
        assert np.isfinite(nearest)
        assert neighbors == pytest.approx(1.0)


def test_far_from_every_example_the_weights_are_never_zero_by_zero() -> None:
    F, nearest, neighbors, _ = predict(a_model(), np.full(D, 1e6))
    assert gaussian.is_positive_definite(F)
    assert nearest > 1e6
    assert 1 <= neighbors <= N


@pytest.mark.parametrize("shape", ["none", "hessian", "sandwich"])
@pytest.mark.parametrize("factor", [0.0, 0.3, 3.0, 1e6])
def test_prediction_is_exactly_symmetric_and_positive_definite(factor: float, shape: str) -> None:
    model = a_model(factor, shape=shape, mean_weight=0.05)
    for d, S in zip(descriptors(20, seed=7), covariances(20, seed=8), strict=True):
        F = predict(model, d, S).covariance
        np.testing.assert_array_equal(F, F.T)
        np.linalg.cholesky(F)


def test_prediction_does_not_depend_on_the_training_order() -> None:
    order = np.random.default_rng(9).permutation(N)
    theta = np.random.default_rng(3).standard_normal((R, D))
    model = model_of(theta, descriptors(), covariances(), mean_weight=0.1)
    shuffled = model_of(theta, descriptors()[order], covariances()[order], mean_weight=0.1)
    for d in descriptors(10, seed=10):
        F, G = predict(model, d).covariance, predict(shuffled, d).covariance
        np.testing.assert_allclose(F, G, rtol=1e-12, atol=1e-12 * np.abs(F).max())


def test_the_mean_weight_mixes_in_the_training_mean() -> None:
    d, mean = descriptors(1, seed=11)[0], covariances().mean(axis=0)
    sharp = predict(a_model(), d).covariance
    mixed = predict(a_model(mean_weight=0.25), d).covariance
    np.testing.assert_allclose(mixed, 0.75 * sharp + 0.25 * mean, rtol=1e-12)
    np.testing.assert_allclose(predict(a_model(mean_weight=1.0), d).covariance, mean, rtol=1e-12)


def test_inputs_beyond_the_training_are_clipped_but_not_in_the_evidence() -> None:
    """One input, two examples at 0 and 1: far out the nearer one would be the only one."""
    line = Model(
        theta=np.eye(1),
        mean=np.zeros(1),
        scale=np.ones(1),
        projections=np.array([[0.0], [1.0]]),
        covariances=covariances(2),
        rho_quantiles=np.array([0.0, 50.0, 100.0]),
    )
    clipping = dataclasses.replace(line, input_range=np.array([[0.0], [1.0]]))
    inside, edge, outside = (predict(clipping, [x]) for x in (0.3, 1.0, 8.0))
    np.testing.assert_array_equal(inside.covariance, predict(line, [0.3]).covariance)
    np.testing.assert_array_equal(outside.covariance, edge.covariance)
    assert outside.effective_neighbors == edge.effective_neighbors
    assert (outside.nearest_rho, outside.novelty) == (49.0, pytest.approx(0.49))
    assert predict(line, [8.0]).effective_neighbors == pytest.approx(1.0, abs=1e-5)


def test_weights_sum_to_one_however_far() -> None:
    rho = np.array([[1e300, 1e300, 2e300], [0.0, 1.0, 800.0], [5.0, 5.0, 5.0]])
    w = weigh(rho)
    np.testing.assert_allclose(w.sum(axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(w[0], [0.5, 0.5, 0.0])
    np.testing.assert_allclose(w[1, 1] / w[1, 0], math.exp(-1))


def test_one_example_is_predicted_everywhere() -> None:
    Y = covariances(1)[0]
    model = constant_model(Y, D, mean_weight=0.3, provenance={"why": "baseline"})
    for d in (np.zeros(D), np.full(D, 1e9)):
        F, nearest, neighbors, _ = predict(model, d)
        np.testing.assert_allclose(F, Y, rtol=1e-13)
        assert (nearest, neighbors) == (0.0, 1.0)


# --- relative covariances -------------------------------------------------------------------


def test_the_constant_relative_model_predicts_its_multiple_of_the_shape() -> None:
    S = covariances(1, seed=13)[0]
    model = constant_model(4.0 * np.eye(6), D, shape="sandwich")
    np.testing.assert_allclose(predict(model, np.zeros(D), S).covariance, 4.0 * S, rtol=1e-9)


def test_an_example_made_relative_to_its_shape_comes_back() -> None:
    Y, S = covariances(2, seed=14)
    root = gaussian.matrix_inverse_sqrt(S)
    model = constant_model(root @ Y @ root, D, shape="hessian")
    np.testing.assert_allclose(predict(model, np.zeros(D), S).covariance, Y, rtol=1e-8, atol=1e-16)


def test_a_relative_prediction_scales_with_the_shape_and_keeps_its_divergence() -> None:
    model = a_model(shape="sandwich", mean_weight=0.1)
    (S, Y), d = covariances(2, seed=15), descriptors(1, seed=16)[0]
    F = predict(model, d, S).covariance
    for c in (1e-12, 0.3, 1e6):
        scaled = predict(model, d, c * S).covariance
        np.testing.assert_allclose(scaled, c * F, rtol=1e-9)
        assert gaussian.kl(c * Y, scaled) == pytest.approx(float(gaussian.kl(Y, F)), rel=1e-9)


def test_a_relative_prediction_turns_with_the_shape_and_the_examples() -> None:
    Ad = adjoint(exp([0, 0, 0, 0.3, -0.5, 1.1]))
    S, d = covariances(1, seed=17)[0], descriptors(1, seed=18)[0]
    model = a_model(shape="sandwich", mean_weight=0.1)
    turned = dataclasses.replace(
        model, covariances=gaussian.symmetrized(Ad @ model.covariances @ Ad.T)
    )
    F = predict(model, d, S).covariance
    G = predict(turned, d, gaussian.symmetrized(Ad @ S @ Ad.T)).covariance
    np.testing.assert_allclose(G, Ad @ F @ Ad.T, rtol=0, atol=1e-9 * np.abs(F).max())


def test_the_shape_is_not_looked_at_by_an_absolute_model() -> None:
    d, S = descriptors(1, seed=19)[0], covariances(1, seed=20)[0]
    np.testing.assert_array_equal(
        predict(a_model(), d, S).covariance, predict(a_model(), d).covariance
    )


# --- misuse ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("d", "message"),
    [
        (np.zeros(D + 1), r"shape \(8,\), the model needs \(7,\)"),
        (np.zeros((1, D)), r"shape \(1, 7\)"),
        (np.full(D, np.nan), "not finite"),
        (np.full(D, np.inf), "not finite"),
        (np.full(D, 1e300), "too far"),
    ],
)
def test_a_descriptor_that_does_not_fit_is_refused(d: Array, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        predict(a_model(), d)


@pytest.mark.parametrize(
    ("S", "message"),
    [
        (None, "relative to the hessian of a pair, and none is given"),
        (np.eye(3), "not a positive definite 6x6"),
        (np.zeros((6, 6)), "not a positive definite 6x6"),
        (np.full((6, 6), np.nan), "not a positive definite 6x6"),
        (np.diag([1.0, 1, 1, 1, 1, -1]), "not a positive definite 6x6"),
    ],
)
def test_a_shape_that_does_not_fit_is_refused(S: Array | None, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        predict(a_model(shape="hessian"), np.zeros(D), S)


def indefinite() -> Array:
    Y = covariances()
    Y[17] *= -1
    return Y


def with_nan(values: Array) -> Array:
    values.flat[3] = np.nan
    return values


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "theta": ({"theta": np.zeros((R, D + 1))}, r"mean has shape \(7,\), expected \(8,\)"),
    "flat theta": ({"theta": np.zeros(D)}, "must be matrices"),
    "no examples": ({"projections": np.zeros((0, R))}, "not empty"),
    "rank": ({"projections": np.zeros((N, R + 1))}, r"projections has shape \(40, 4\)"),
    "count": ({"covariances": covariances(N - 1)}, r"covariances has shape \(39, 6, 6\)"),
    "nan": ({"mean": with_nan(np.zeros(D))}, "mean is not finite"),
    "nan covariance": ({"covariances": with_nan(covariances())}, "covariances is not finite"),
    "indefinite": ({"covariances": indefinite()}, "covariance 17 is not positive definite"),
    "text": ({"theta": np.full((R, D), "x")}, "theta is not an array of numbers"),
    "scale": ({"scale": np.zeros(D)}, "scale is not positive"),
    "shape": ({"shape": "censi"}, "shape must be one of none, hessian, sandwich: 'censi'"),
    "weight": ({"mean_weight": 1.5}, r"mean_weight must be in \[0, 1\]: 1.5"),
    "nan weight": ({"mean_weight": math.nan}, "mean_weight must be"),
    "weight type": ({"mean_weight": "0.1"}, "mean_weight must be a number: '0.1'"),
    "turns": ({"rotations_rad": [1.0, 2.0]}, "40 examples are not turns by"),
    "turn count": ({"rotations_rad": [0.0, 1.0, 2.0]}, "40 examples are not turns by"),
    "range": ({"input_range": np.zeros((2, D + 1))}, r"input_range has shape \(2, 8\)"),
    "empty range": ({"input_range": np.eye(2, D)}, "input_range is not the least and the largest"),
    "training mean": ({"training_mean": np.eye(5)}, r"training_mean has shape \(5, 5\)"),
    "provenance": ({"provenance": {"x": object()}}, "provenance cannot be written as JSON"),
    "list": ({"provenance": [1]}, "provenance must be a mapping"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_model_that_does_not_fit_together_is_refused(case: str) -> None:
    changes, message = WRONG[case]
    with pytest.raises(ModelError, match=message):
        dataclasses.replace(a_model(), **changes)


def test_a_model_is_read_only_and_leaves_its_arguments_writable() -> None:
    Y = covariances()
    model = model_of(np.eye(R, D), descriptors(), Y)
    with pytest.raises(ValueError, match="read-only"):
        model.covariances[0] = 0.0
    assert Y.flags.writeable


# --- files ----------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "model.npz"
    save_model(a_model(provenance={"seeds": [1, 2]}, lost=Lost(0.0128, np.eye(6))), path)
    return path


def items_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rewrite(path: Path, items: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in items.items():
            archive.writestr(name, data)


def replace_array(path: Path, name: str, array: Any, **options: Any) -> None:
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    rewrite(path, items_of(path) | {f"{name}.npy": buffer.getvalue()})


def change_header(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    header = json.loads(np.load(io.BytesIO(items_of(path)["header.npy"])).tobytes())
    change(header)
    replace_array(path, "header", np.frombuffer(json.dumps(header).encode(), np.uint8))


def refused(path: Path) -> str:
    """Return the one sentence with which loading fails; it names the file."""
    with pytest.raises(ModelError) as caught:
        load_model(path)
    sentence = str(caught.value)
    assert str(path) in sentence
    assert "\n" not in sentence
    return sentence


def test_a_saved_model_comes_back_bit_by_bit(tmp_path: Path) -> None:
    model = a_model(
        math.pi,
        shape="sandwich",
        mean_weight=0.1,
        input_range=np.array([np.zeros(D), np.full(D, 1 / 3)]),
        rotations_rad=np.array([0.0, 1 / 3]),
        training_mean=covariances(1, seed=8)[0],
        pipeline=Pipeline(
            cloud=CloudConfig(voxel_m=0.123456789),
            icp=IcpConfig(trim_ratio=1 / 3, error_metric="point_to_point"),
            grid=GridConfig(n_cells=(2, 3, 4), extent_m=(1 / 7, 2.0, 3.0)),
        ),
        sampling=SamplingConfig(variance=0.02, seed=7),
        lost=Lost(1 / 3, covariances(1, seed=9)[0]),
        bias=Bias(1 / 3, 7.0),
        provenance={"recordings": ["a", "é"], "kl": {"mean": 1 / 3}, "tuple": (1, 2), "n": None},
    )
    save_model(model, tmp_path / "m.npz")
    back = load_model(tmp_path / "m.npz")
    for name in (*ARRAYS, "input_range", "rotations_rad", "training_mean"):
        ours, theirs = getattr(model, name), getattr(back, name)
        assert ours.dtype == theirs.dtype
        assert ours.tobytes() == theirs.tobytes()
    for name in ("shape", "mean_weight", "pipeline", "sampling", "provenance"):
        assert getattr(model, name) == getattr(back, name)
    assert model.lost is not None
    assert back.lost is not None
    assert model.lost.limit_m == back.lost.limit_m
    assert back.bias == Bias(1 / 3, 7.0)
    np.testing.assert_array_equal(model.lost.covariance, back.lost.covariance)
    d, S = descriptors(1, seed=21)[0], covariances(1, seed=22)[0]
    ours, theirs = predict(model, d, S), predict(back, d, S)
    np.testing.assert_array_equal(ours.covariance, theirs.covariance)
    assert ours[1:] == theirs[1:]


def test_a_file_of_format_2_is_read_and_keeps_what_its_provenance_says(saved: Path) -> None:
    def older(header: dict[str, Any]) -> None:
        header.update(format_version=2, cutoff_rho=None)
        header["provenance"] |= {"rotations_rad": [0.5, 0.0], "mean_covariance": [[2.0] * 6] * 6}

    new = load_model(saved)
    kept = [f"{name}.npy" for name in ("header", *ARRAYS)]
    rewrite(saved, {name: items_of(saved)[name] for name in kept})
    change_header(saved, older)
    old = load_model(saved)
    assert old.rotations_rad.tolist() == [0.5, 0.0]
    np.testing.assert_array_equal(old.training_mean, np.full((6, 6), 2.0))
    assert not len(old.input_range)
    d = descriptors(1, seed=21)[0]
    np.testing.assert_array_equal(predict(old, d).covariance, predict(new, d).covariance)


def test_a_column_ordered_array_comes_back_too(tmp_path: Path) -> None:
    model = dataclasses.replace(a_model(), theta=np.asfortranarray(a_model().theta))
    save_model(model, tmp_path / "m.npz")
    np.testing.assert_array_equal(load_model(tmp_path / "m.npz").theta, a_model().theta)


def test_the_same_model_makes_the_same_bytes_without_pickle(saved: Path, tmp_path: Path) -> None:
    save_model(load_model(saved), tmp_path / "again.npz")
    assert saved.read_bytes() == (tmp_path / "again.npz").read_bytes()
    with np.load(saved, allow_pickle=False) as archive:
        assert {archive[name].dtype.kind for name in archive.files} == {"f", "u"}
        header = json.loads(archive["header"].tobytes())
    assert header["format_version"] == 4
    assert header["conventions"]["order"] == "u omega"
    assert header["config"]["sampling"]["variance"] == SamplingConfig().variance


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = saved.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    with pytest.raises(WriteError, match=r"cannot write .*No space left"):
        save_model(a_model(), saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_a_reader_of_the_old_file_is_not_disturbed(saved: Path) -> None:
    before = saved.read_bytes()
    with open(saved, "rb") as stream:
        save_model(a_model(2.0), saved)
        assert stream.read() == before
    assert saved.read_bytes() != before


def test_a_model_goes_nowhere_where_there_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match="cannot write"):
        save_model(a_model(), tmp_path / "missing" / "m.npz")


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    assert "no such model file; shipped are general" in refused(tmp_path / "none.npz")
    assert "cannot read" in refused(tmp_path)


@pytest.mark.parametrize("data", [b"", b"PK", b"hello, world" * 99, b"\x93NUMPY\x01\x00"])
def test_a_file_that_is_no_npz_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "m.npz").write_bytes(data)
    assert "is not an .npz file" in refused(tmp_path / "m.npz")


@pytest.mark.parametrize("share", [0.01, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(saved: Path, share: float) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[: int(share * len(data))])
    assert "truncated or damaged" in refused(saved)


def test_damage_anywhere_is_refused_or_harmless(saved: Path) -> None:
    data, model = saved.read_bytes(), load_model(saved)
    rng = np.random.default_rng(23)
    n_refused = 0
    for position in rng.choice(len(data), 400, replace=False):
        broken = bytearray(data)
        broken[position] ^= int(rng.integers(1, 256))
        saved.write_bytes(broken)
        try:
            survivor = load_model(saved)
        except ModelError:
            n_refused += 1
        else:  # a byte that carries no content, such as a date
            np.testing.assert_array_equal(survivor.covariances, model.covariances)
            assert survivor.provenance == model.provenance
    assert n_refused > 300


@pytest.mark.parametrize(
    "name", ["header", "theta", "mean", "scale", "projections", "covariances"]
)
def test_a_missing_item_is_named(saved: Path, name: str) -> None:
    items = items_of(saved)
    del items[f"{name}.npy"]
    rewrite(saved, items)
    assert f"item '{name}' is missing" in refused(saved)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_item_that_is_there_twice_is_named(saved: Path) -> None:
    data = items_of(saved)["theta.npy"]
    with zipfile.ZipFile(saved, "a") as archive:
        archive.writestr("theta.npy", data)
    assert "item 'theta' is there twice" in refused(saved)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([[{"a": 1}]], dtype=object), "item 'theta' has dtype object"),
        (np.zeros((R, D), np.float32), "item 'theta' has dtype float32, not float64"),
        (np.zeros((R, D), ">f8"), "item 'theta' has dtype >f8"),
        (np.zeros((R, D), np.complex128), "item 'theta' has dtype complex128"),
        (np.zeros((R, D + 1)), "mean has shape (7,), expected (8,)"),
        (np.zeros((R + 1, D)), "projections has shape (40, 3), expected (40, 4)"),
        (with_nan(np.zeros((R, D))), "theta is not finite"),
        (np.zeros((0, D)), "expected (40, 0)"),
        (np.float64(3.0), "must be matrices"),
        (np.asfortranarray(np.ones((R, D))), "item 'theta' is stored column by column"),
    ],
)
def test_an_item_of_another_kind_is_named(saved: Path, array: Any, message: str) -> None:
    replace_array(saved, "theta", array, allow_pickle=True)
    assert message in refused(saved)


def test_a_covariance_that_is_not_positive_definite_is_named(saved: Path) -> None:
    replace_array(saved, "covariances", indefinite())
    assert "covariance 17 is not positive definite" in refused(saved)


HEADERS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "format": (lambda h: h.update(format="other"), "not that of a cello3d-model file"),
    "version": (
        lambda h: h.update(format_version=5),
        "format version 5, this package reads 2, 3 and 4",
    ),
    "no version": (lambda h: h.pop("format_version"), "format version None"),
    "order": (lambda h: h["conventions"].update(order="omega u"), "conventions are"),
    "side": (lambda h: h["conventions"].pop("side"), "conventions are"),
    "no conventions": (lambda h: h.pop("conventions"), "item 'conventions' is missing"),
    "no provenance": (lambda h: h.pop("provenance"), "item 'provenance' is missing"),
    "no margin": (lambda h: h.pop("margin"), "item 'margin' is missing"),
    "no config": (lambda h: h.pop("config"), "item 'config' is missing"),
    "config": (lambda h: h.update(config=[]), "item 'config' holds no sections"),
    "no grid": (lambda h: h["config"].pop("grid"), "section 'grid' of 'config' is missing"),
    "setting": (lambda h: h["config"]["icp"].update(trim_ratio=2.0), "trim_ratio must be in"),
    "huge": (lambda h: h["config"]["icp"].update(trim_ratio=10**400), "too large"),
    "unknown": (lambda h: h["config"]["icp"].update(speed=1), "unknown setting 'speed'"),
    "section": (lambda h: h["config"].update(icp=3), "section 'icp' must hold settings"),
    "shape": (lambda h: h.update(shape=["none"]), "shape must be one of"),
    "weight": (lambda h: h.update(mean_weight=True), "mean_weight must be a number"),
    "margin": (lambda h: h.update(margin="wide"), "margin must be a number"),
    "provenance": (lambda h: h.update(provenance="me"), "provenance must be a mapping"),
    "nan": (lambda h: h.update(provenance={"x": math.nan}), "provenance cannot"),
    "lost": (lambda h: h.update(lost=[3]), "'lost' is not a limit_m and a covariance"),
    "lost limit": (lambda h: h["lost"].update(limit_m=-1.0), "limit_m must be positive"),
    "lost word": (lambda h: h["lost"].update(limit_m="wide"), "limit_m must be a number"),
    "lost matrix": (
        lambda h: h["lost"].update(covariance=[[0.0] * 6] * 6),
        "lost.covariance is not a positive definite",
    ),
    "lost extent": (lambda h: h["lost"].update(covariance=[1.0]), "positive definite 6x6"),
    "lost item": (lambda h: h["lost"].pop("limit_m"), "not a limit_m and a covariance"),
    "bias": (lambda h: h.update(bias=[0.1, 1.0]), "'bias' is not a share and a way_m"),
    "bias item": (lambda h: h["bias"].pop("share"), "'bias' is not a share and a way_m"),
    "bias share": (lambda h: h["bias"].update(share=1.5), "bias.share must be in [0, 1]"),
    "bias way": (lambda h: h["bias"].update(way_m=0.0), "bias.way_m must be positive"),
    "bias word": (lambda h: h["bias"].update(way_m="far"), "bias.way_m must be a number"),
}


def test_a_model_made_before_the_bias_was_measured_has_the_default(saved: Path) -> None:
    change_header(saved, lambda h: h.pop("bias"))
    assert load_model(saved).bias == INDEPENDENT  # its shape is none
    change_header(saved, lambda h: h.update(shape="sandwich"))
    assert load_model(saved).bias == Bias()


def test_a_model_made_before_lost_registrations_were_known_knows_nothing(saved: Path) -> None:
    change_header(saved, lambda h: h.pop("lost"))
    assert load_model(saved).lost is None


@pytest.mark.parametrize("case", HEADERS)
def test_a_header_that_does_not_fit_is_refused(saved: Path, case: str) -> None:
    change, message = HEADERS[case]
    change_header(saved, change)
    assert message in refused(saved)


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"3", b"null"])
def test_a_header_that_is_no_mapping_is_refused(saved: Path, text: bytes) -> None:
    replace_array(saved, "header", np.frombuffer(text, np.uint8))
    assert "the header is not" in refused(saved)


def test_a_setting_that_a_file_does_not_know_has_its_default(saved: Path) -> None:
    change_header(saved, lambda h: h["config"]["icp"].pop("n_smoothed"))
    assert load_model(saved).pipeline == Pipeline()


def peak_bytes_of_refusing(path: Path) -> tuple[str, int]:
    tracemalloc.start()
    try:
        return refused(path), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def npy(shape: str, data: bytes) -> bytes:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + data


@pytest.mark.parametrize(
    "shape", ["(10000000000, 7)", f"({10**30}, {10**30})", "(-1, 21)", "(3, 8)", "(3,)"]
)
def test_a_shape_that_its_bytes_do_not_fill_is_refused_before_memory_is_used(
    saved: Path, shape: str
) -> None:
    rewrite(saved, items_of(saved) | {"theta.npy": npy(shape, bytes(8 * R * D))})
    sentence, peak = peak_bytes_of_refusing(saved)
    assert "item 'theta' has shape" in sentence
    assert peak < 2**21


def test_negative_extents_are_refused(saved: Path) -> None:
    for shape in ("(-1, -21)", "(-3, -7)"):
        rewrite(saved, items_of(saved) | {"theta.npy": npy(shape, bytes(8 * R * D))})
        assert "item 'theta' is damaged" in refused(saved)


def test_a_file_of_absurd_size_is_refused_before_memory_is_used(saved: Path) -> None:
    zeros = bytes(2**24)
    with (
        zipfile.ZipFile(saved, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("bomb.npy", "w", force_zip64=True) as item,
    ):
        for _ in range(2**31 // len(zeros)):
            item.write(zeros)
    assert saved.stat().st_size < 2**25
    sentence, peak = peak_bytes_of_refusing(saved)
    assert "more than the 2147483648 allowed" in sentence
    assert peak < 2**21


def test_a_stream_that_holds_more_than_it_declares_is_not_inflated(saved: Path) -> None:
    bomb = npy("(100, 100)", bytes(2**26))
    rewrite(saved, items_of(saved) | {"theta.npy": bomb})
    true_size = len(bomb).to_bytes(4, "little")
    lie = (len(bomb) - 2**26 + 80_000).to_bytes(4, "little")
    saved.write_bytes(saved.read_bytes().replace(true_size, lie))
    sentence, peak = peak_bytes_of_refusing(saved)
    assert "item 'theta' is damaged" in sentence
    assert peak < 2**21


def test_other_compression_has_no_bound_and_is_refused(saved: Path) -> None:
    items = items_of(saved)
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_BZIP2) as archive:
        for name, data in items.items():
            archive.writestr(name, data)
    assert "item 'header' is compressed by method 12" in refused(saved)


def test_a_header_of_absurd_size_is_not_parsed(saved: Path) -> None:
    change_header(saved, lambda h: h.update(provenance={"x": "y" * 2**24}))
    assert "item 'header' has 1677" in refused(saved)
    with pytest.raises(ModelError, match="is too long"):
        save_model(a_model(provenance={"x": "y" * 2**24}), saved)


@pytest.mark.parametrize("name", [name for name in SHIPPED if name != "paper"])
def test_a_shipped_model_is_small_and_says_what_it_was_made_of(name: str) -> None:
    path = find_model(name)
    assert path.parts[-3:] == ("cello3d_ros", "models", f"{name}.npz")
    assert path.is_absolute()
    assert path.stat().st_size < 5_000_000
    model = load_model(path)
    assert model.features == "global"
    assert model.n_features == len(FEATURES)
    assert model.frame == "motion"
    assert pipeline_name(model.pipeline) in ("robot", "robot, changed")
    assert is_positive_definite(model.training_mean)
    assert model.input_range.shape == (2, len(FEATURES))
    seen = model.provenance["recordings"]
    seeds = [int(name.rsplit("-", 1)[1]) for name in seen if name.count("-") == 3]
    assert len(seeds) > 200
    assert max(seeds) < 5000  # from there on they are for the figures of docs/evaluation.md


def test_the_papers_model_has_its_form_and_was_trained_on_its_seven_sequences() -> None:
    path = find_model("paper")
    assert path.stat().st_size < 2_500_000
    model = load_model(path)
    assert model.features == "descriptor"
    assert model.shape == "none"
    assert model.frame == "sensor"
    assert model.mean_weight == 0.1
    assert model.margin == 1.0
    assert model.lost is None
    assert pipeline_name(model.pipeline) == "paper"
    assert model.n_features == 704
    assert len(model.rotations_rad) == 7
    assert {name.rsplit("-", 1)[0] for name in model.provenance["recordings"]} == {
        *("apartment", "hauptgebaude", "stairs", "gazebo_summer", "gazebo_winter"),
        *("wood_autumn", "wood_summer"),
    }


def test_a_model_is_found_by_name_or_path() -> None:
    assert find_model("") == find_model("general") == shipped_model_path()
    assert find_model("my/general.npz") == Path("my/general.npz")


def test_the_margin_multiplies_every_prediction() -> None:
    d = descriptors()[3]
    F, G = (predict(a_model(margin=margin), d).covariance for margin in (1.0, 1.5))
    np.testing.assert_allclose(G, 1.5 * F, rtol=1e-12)
    for margin in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ModelError, match="margin"):
            a_model(margin=margin)


def test_novelty_is_the_share_of_training_pairs_that_were_nearer() -> None:
    d = descriptors()[0]
    model = a_model(rho_quantiles=np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
    assert predict(model, d).novelty < 1e-20  # the example itself
    theta = np.zeros((R, D))
    theta[0, 0] = 1.0
    one = Model(
        theta=theta,
        mean=np.zeros(D),
        scale=np.ones(D),
        projections=np.zeros((1, R)),
        covariances=covariances(1),
        rho_quantiles=np.array([0.0, 1.0, 2.0, 3.0, 4.0]),
    )
    for rho, novelty in ((1.0, 0.25), (2.5, 0.625), (4.0, 1.0), (100.0, 1.0)):
        away = np.sqrt(rho) * np.eye(D)[0]
        assert predict(one, away).novelty == pytest.approx(novelty)
    assert predict(dataclasses.replace(one, rho_quantiles=np.zeros(0)), d).novelty == 0.0


def test_quantiles_that_are_none_are_refused() -> None:
    for values in (np.array([0.0, 2.0, 1.0]), np.zeros((2, 2))):
        with pytest.raises(ModelError, match="rho_quantiles are not ascending"):
            a_model(rho_quantiles=values)
    with pytest.raises(ModelError, match="features must be one of"):
        a_model(features="all")


def test_a_model_of_other_global_features_is_refused_when_it_is_loaded(tmp_path: Path) -> None:
    save_model(constant_model(np.eye(6), 13, features="global"), tmp_path / "old.npz")
    with pytest.raises(ModelError, match=r"old.npz: it looks at 13 global features.*train it"):
        load_model(tmp_path / "old.npz")
