"""Figures with known answers, the pose check, and all methods side by side."""

import dataclasses

import numpy as np
import pytest

from cello3d_ros.config import CloudConfig, Pipeline, TrainingConfig
from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.covariance.model import Model, constant_model
from cello3d_ros.errors import DatasetError
from cello3d_ros.evaluation.comparison import (
    add_answers,
    compare,
    divergences,
    from_dataset,
    mean_of,
    seen_recordings,
    training_mean,
)
from cello3d_ros.evaluation.online import Answer
from cello3d_ros.geometry.gaussian import kl
from cello3d_ros.learning.dataset import PairRecord, open_dataset
from cello3d_ros.learning.examples import Examples, load_examples
from cello3d_ros.learning.measures import Figures, best_scale, figures, pose_check, select
from cello3d_ros.learning.training import fit

SIZES = np.array([0.01, 0.02, 0.03, 1e-3, 2e-3, 3e-3])


def some(n: int = 8, n_samples: int = 400, seed: int = 0) -> Examples:
    rng = np.random.default_rng(seed)
    A = SIZES[:, None] * (np.eye(6) + 0.3 * rng.normal(size=(n, 6, 6)))
    xi = rng.normal(size=(n, n_samples, 6)) @ np.swapaxes(A, 1, 2)
    Y = np.swapaxes(xi, 1, 2) @ xi / (n_samples - 1)
    return Examples(
        features=rng.normal(size=(n, 1, 3)).astype(np.float32),
        covariances=Y,
        motions=np.tile([1.0, 0.0], (n, 1)),
        groups=np.array(["a", "b"])[np.arange(n) % 2],
        shapes={"sandwich": Y / 4.0, "hessian": 100.0 * Y},
        rotations_rad=np.zeros(1),
        xi=tuple(xi),
    )


def test_a_right_covariance_has_ideal_figures():
    targets = some()
    report = figures(targets.covariances, targets, targets.covariances * 2.0)
    assert report.n_pairs == 8
    assert report.kl_mean == pytest.approx(0.0, abs=1e-12)
    assert report.kl_ratio == pytest.approx(0.0, abs=1e-12)
    assert report.dm2_over_6 == pytest.approx(1.0)
    assert report.coverage_95 == pytest.approx(0.95, abs=0.01)
    assert report.coverage[4] == pytest.approx(0.5, abs=0.03)
    assert report.coverage == sorted(report.coverage)
    assert report.verdict == "about right"
    for part in ("translation", "rotation"):
        assert getattr(report, part).dm2_over_3 == pytest.approx(1.0)
        assert getattr(report, part).coverage_95 == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize(("factor", "direction"), [(2.0, "too large"), (0.5, "too small")])
def test_the_direction_of_an_error_is_said(factor, direction):
    targets = some()
    F = factor * targets.covariances
    report = figures(F, targets, targets.covariances * 10.0)
    assert report.kl_mean == pytest.approx({2.0: 0.579442, 0.5: 0.920558}[factor])
    assert report.kl_ratio == pytest.approx(report.kl_mean / 4.207755)
    assert report.dm2_over_6 == pytest.approx(1.0 / factor)
    assert report.verdict == f"{direction}: multiply by {1.0 / factor:g}"
    assert (report.coverage_95 > 0.95) == (factor > 1)


def test_translation_and_rotation_are_told_apart():
    targets = some()
    scale = np.repeat([1.0, 3.0], 3)
    report = figures(targets.covariances * np.outer(scale, scale), targets)
    assert report.translation.dm2_over_3 == pytest.approx(1.0)
    assert report.rotation.dm2_over_3 == pytest.approx(1.0 / 9.0)
    assert report.rotation.coverage_95 > 0.999
    assert report.kl_ratio is None


def test_divergences_are_summarised():
    targets = some()
    F = targets.covariances * np.linspace(0.3, 4.0, 8)[:, None, None]
    report, each = figures(F, targets), np.sort(kl(targets.covariances, F))
    assert report.kl_mean == pytest.approx(each.mean())
    assert report.kl_median == pytest.approx(np.median(each))
    assert report.kl_trimmed_mean == pytest.approx(each[:7].mean())
    assert report.kl_90 == pytest.approx(np.quantile(each, 0.9))
    bare = figures(F, dataclasses.replace(targets, xi=()))
    assert bare == dataclasses.replace(
        report,
        coverage_95=None,
        coverage=[],
        translation=dataclasses.replace(report.translation, coverage_95=None),
        rotation=dataclasses.replace(report.rotation, coverage_95=None),
    )


def test_pairs_without_an_answer_enter_no_figure_nor_its_ratio():
    targets = some()
    F, baseline = 2.0 * targets.covariances, 10.0 * targets.covariances
    baseline[3] *= 1e3
    F[3] = np.nan
    report = figures(F, targets, baseline)
    assert report.n_pairs == 7
    assert report.kl_ratio == pytest.approx(0.579442 / 4.207755, rel=1e-5)
    assert figures(np.full_like(F, np.nan), targets) == Figures(n_pairs=0)


def test_the_best_scale_has_the_least_mean_divergence():
    targets = some()
    F = targets.covariances * np.linspace(0.3, 4.0, 8)[:, None, None]
    c = best_scale(F, targets)

    def mean(scale):
        return kl(targets.covariances, scale * F).mean()

    assert mean(c) < min(mean(1.01 * c), mean(0.99 * c), mean(1.0))
    F[2] = np.nan
    assert best_scale(F, targets) != c
    assert best_scale(np.full_like(F, np.nan), targets) == 1.0


def cloud_of(offset_m, offset_rad, sigma_m=0.01, sigma_rad=0.002):
    sigma = np.repeat([sigma_m, sigma_rad], 3) / np.sqrt(3.0)
    xi = np.random.default_rng(5).normal(size=(500, 6)) * sigma
    xi -= xi.mean(axis=0)
    return xi + np.array([0, offset_m, 0, 0, 0, offset_rad])


@pytest.mark.parametrize(
    ("offset_m", "offset_rad", "sigma_m", "flagged"),
    [
        (0.0, 0.0, 0.01, False),
        (0.049, 0.019, 0.01, False),  # within what poses may be off
        (0.051, 0.0, 0.01, True),
        (0.0, 0.021, 0.01, True),
        (0.10, 0.0, 0.05, False),  # 2 scatters
        (0.20, 0.0, 0.05, True),  # 4 scatters
    ],
)
def test_a_pose_is_suspected_by_the_stated_rule(offset_m, offset_rad, sigma_m, flagged):
    check = pose_check(cloud_of(offset_m, offset_rad, sigma_m))
    assert check.flagged is flagged
    assert check.offset_m == pytest.approx(offset_m, abs=1e-12)
    assert check.offset_rad == pytest.approx(offset_rad, abs=1e-12)
    assert check.scatter_m == pytest.approx(sigma_m, rel=0.1)


def test_a_selection_keeps_everything_of_its_pairs():
    targets = some()
    keep = np.arange(8) % 3 == 0
    part = select(targets, keep)
    assert len(part.xi) == len(part.groups) == 3
    np.testing.assert_array_equal(part.xi[1], targets.xi[3])
    np.testing.assert_array_equal(part.shapes["sandwich"], targets.shapes["sandwich"][keep])
    np.testing.assert_array_equal(part.features[2], targets.features[6])


def test_methods_from_a_dataset():
    """With S = Y / 4 a constant of 4 I is right, H^-1 = 100 Y is not."""
    targets, settings = some(), MethodSettings(sigma_m=0.1)
    model = constant_model(4.0 * np.eye(6), 3, shape="sandwich")
    found = from_dataset(model, targets, np.diag(SIZES**2), settings)
    report, by_recording = compare(found, targets, np.ones(8, np.bool_), settings)
    methods = report.methods
    for name in ("cello3d", "constant", "hessian", "hessian_scaled", "sandwich_scaled"):
        assert methods[name].kl_mean == pytest.approx(0.0, abs=1e-9), name
    assert methods["sandwich"].dm2_over_6 == pytest.approx(4.0)
    assert methods["sandwich_scaled"].scale == pytest.approx(4.0)
    assert methods["mean_covariance"].kl_ratio == pytest.approx(1.0)
    assert methods["cello3d"].ms_per_pair is None
    assert set(by_recording) == {"a", "b"}
    assert by_recording["a"].n_pairs == 4
    assert report.n_pairs == 8


def test_a_pair_far_from_every_example_is_also_judged_as_it_is_widened():
    targets = dataclasses.replace(
        some(2), features=np.array([[[0.5, 0.0, 0.0]], [[3.0, 0.0, 0.0]]], np.float32)
    )
    small, large = np.diag(SIZES**2), np.diag(SIZES[::-1] ** 2)
    model = Model(
        theta=np.eye(3)[:1],
        mean=np.zeros(3),
        scale=np.ones(3),
        projections=np.array([[0.0], [-50.0]]),
        covariances=np.array([small, large]),
        rho_quantiles=np.array([1.0, 2.0]),
    )
    settings = MethodSettings(unknown_quantile=0.99)
    found = from_dataset(model, targets, small, settings).covariances
    np.testing.assert_array_equal(found["cello3d_widened"][0], found["cello3d"][0])
    mean = (small + large) / 2
    np.testing.assert_allclose(found["cello3d"][1], small, rtol=1e-9)
    np.testing.assert_allclose(
        np.diag(found["cello3d_widened"][1]), np.fmax(np.diag(small), np.diag(mean))
    )


def test_flagged_pairs_are_left_out():
    targets, settings = some(), MethodSettings()
    model = constant_model(4.0 * np.eye(6), 3, shape="sandwich")
    found = from_dataset(model, targets, np.eye(6), settings)
    found.covariances["cello3d"][1] *= 1e6
    keep = np.arange(8) != 1
    report, by_recording = compare(found, targets, keep, settings)
    assert report.n_pairs == 7
    assert by_recording["b"].n_pairs == 3
    assert report.methods["cello3d"].kl_mean == pytest.approx(0.0, abs=1e-9)


def test_answers_from_clouds_stand_beside_those_of_the_dataset():
    targets, settings = some(), MethodSettings(n_registrations=5)
    model = constant_model(4.0 * np.eye(6), 3, shape="sandwich")
    found = from_dataset(model, targets, np.eye(6), settings)
    nothing = np.full((6, 6), np.nan)
    add_answers(
        found,
        [2, 5, 6],
        [
            {"fused": Answer(2.0 * targets.covariances[2], 30.0), "cello3d": Answer(nothing, 7.0)},
            {"fused": Answer(nothing, 50.0), "cello3d": Answer(nothing, 9.0)},
            {"fused": Answer(2.0 * targets.covariances[6], 10.0), "cello3d": Answer(nothing, 8.0)},
        ],
    )
    methods = compare(found, targets, np.ones(8, np.bool_), settings)[0].methods
    assert methods["fused"].n_pairs == 2
    assert methods["fused"].n_failed == 1
    assert methods["fused"].ms_per_pair == pytest.approx(30.0)
    assert methods["fused"].icp_runs == 5
    assert methods["fused"].kl_mean == pytest.approx(0.579442, rel=1e-5)
    assert methods["cello3d"].n_pairs == 8  # from the dataset
    assert methods["cello3d"].n_failed == 0
    assert methods["cello3d"].ms_per_pair == pytest.approx(8.0)
    assert methods["censi"].n_pairs == 0
    assert "fused" in divergences(found, targets, 2)
    assert "fused" not in divergences(found, targets, 5)


def test_other_settings_than_the_models_are_refused():
    pipeline = Pipeline(cloud=CloudConfig(voxel_m=0.5))
    model = constant_model(np.eye(6), 3, shape="sandwich", pipeline=pipeline)
    with pytest.raises(DatasetError, match=r"cloud.voxel_m is 0.1, not 0.5"):
        from_dataset(model, some(), np.eye(6), MethodSettings())


def test_a_dataset_without_the_models_shape_is_refused():
    targets = dataclasses.replace(some(), shapes={})
    model = constant_model(np.eye(6), 3, shape="sandwich")
    with pytest.raises(DatasetError, match="does not hold the sandwich"):
        from_dataset(model, targets, np.eye(6), MethodSettings())
    settings = MethodSettings()
    absolute = from_dataset(constant_model(np.eye(6), 3), targets, np.eye(6), settings)
    methods = compare(absolute, targets, np.ones(8, np.bool_), settings)[0].methods
    assert set(methods) == {"mean_covariance", "cello3d", "cello3d_widened", "constant"}


def test_the_baseline_is_the_mean_that_the_model_was_trained_on(tmp_path):
    dataset = open_dataset(tmp_path / "set", create=True)
    for k, name in enumerate(("a", "a", "b")):
        dataset.write(
            PairRecord(
                recording=name,
                i=k,
                j=k + 1,
                accepted=True,
                T_mean=np.eye(4),
                covariance=(k + 1.0) * np.eye(6),
                xi=np.eye(6),
                kept=np.ones(6, np.bool_),
                shapes={"sandwich": (k + 3.0) * np.eye(6)},
                descriptors=np.zeros((1, 3), np.float32),
                features=np.arange(len(FEATURES)) + 0.1 * k,
                rotations_rad=np.zeros(1),
            )
        )
    np.testing.assert_allclose(mean_of([dataset]), 2.0 * np.eye(6))
    model = fit(load_examples([dataset], ["a", "b"]), TrainingConfig(max_iterations=1)).model
    assert seen_recordings(model, {"b": set(), "c": {"x"}}) == {"b": "b"}
    np.testing.assert_allclose(training_mean(model), 2.0 * np.eye(6))
    np.testing.assert_allclose(training_mean(constant_model(np.diag([7.0] * 6), 3)), 7 * np.eye(6))
    with pytest.raises(DatasetError, match="does not keep it"):
        training_mean(constant_model(np.eye(6), 3, shape="sandwich"))
