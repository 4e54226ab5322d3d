"""Checks 15 to 17 of the design: gradient, planted data, noise; and who may see whom."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import CloudConfig, Pipeline, SamplingConfig, TrainingConfig
from cello3d_ros.covariance.closed_form import HELD
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.covariance.model import predict
from cello3d_ros.errors import ConfigError, DatasetError
from cello3d_ros.geometry.gaussian import INDEPENDENT, is_positive_definite, kl, matrix_sqrt
from cello3d_ros.geometry.se3 import Array, adjoint, exp
from cello3d_ros.learning.dataset import Dataset, PairRecord, open_dataset
from cello3d_ros.learning.examples import Examples, answers, feature_scaler, load_examples
from cello3d_ros.learning.loss import (
    Problem,
    leave_out_problem,
    loss_and_gradient,
    median_rho,
    predicted,
)
from cello3d_ros.learning.training import fit, known_lost

N_MORE = len(FEATURES) - 10  # global features beside the planted ones
PAPER = TrainingConfig(
    features="descriptor",
    shape="none",
    frame="sensor",
    theta="diagonal",
    mean_weight=0.0,
    regularization=1e-3,
)
SIZE = np.diag([1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2])  # det of SIZE SIZE^T is 1e-24


def covariances(n: int, rng: np.random.Generator, degrees: int = 12) -> Array:
    A = SIZE @ rng.normal(size=(n, 6, degrees)) / np.sqrt(degrees)
    return A @ np.swapaxes(A, 1, 2)


def some(
    n: int = 24, n_features: int = 5, seed: int = 0, rotations: tuple[float, ...] = (0.0,)
) -> Examples:
    rng = np.random.default_rng(seed)
    Y = covariances(n, rng)
    return Examples(
        features=rng.normal(size=(n, len(rotations), n_features)).astype(np.float32),
        covariances=Y,
        motions=np.tile([1e6, 0.0], (n, 1)),
        groups=np.array([f"world_s{k % 3}" for k in range(n)]),
        shapes={"sandwich": covariances(n, rng), "hessian": covariances(n, rng)},
        rotations_rad=np.array(rotations),
        xi=tuple(rng.multivariate_normal(np.zeros(6), Y_k, size=50) for Y_k in Y),
    )


def planted(n: int = 300, seed: int = 0, n_groups: int = 5) -> Examples:
    """Covariances of random shape, in which feature 3 of 10 decides how large they are."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(n, 1, 10)).astype(np.float32)
    sizes = np.exp(2.0 * features[:, 0, 3].astype(np.float64))
    return dataclasses.replace(
        some(n, 10),
        features=features,
        covariances=sizes[:, None, None] * covariances(n, rng, 40),
        groups=np.array([f"g{seed}_{k % n_groups}" for k in range(n)]),
        xi=(),
    )


def noise(n: int, seed: int) -> Examples:
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        planted(n, seed), features=rng.normal(size=(n, 1, 10)).astype(np.float32)
    )


def a_problem(mean_weight: float = 0.05, rotations: tuple[float, ...] = (0.0, 1.0)) -> Problem:
    config = TrainingConfig(features="descriptor", shape="none", mean_weight=mean_weight)
    examples = some(rotations=rotations)
    return leave_out_problem(examples, config, np.zeros(5), np.ones(5))


THETAS = {
    "upper_triangular": np.triu(np.random.default_rng(1).normal(size=(5, 5)) * 0.4),
    "diagonal": np.random.default_rng(2).normal(size=5) * 0.4,
    "low_rank": np.random.default_rng(3).normal(size=(2, 5)) * 0.4,
}


@pytest.mark.parametrize("form", THETAS)
@pytest.mark.parametrize("loss", ["log_det", "paper"])
@pytest.mark.parametrize("mean_weight", [0.0, 0.3])
def test_gradient_is_that_of_finite_differences(form: str, loss: str, mean_weight: float) -> None:
    theta, problem = THETAS[form], a_problem(mean_weight)
    assert -26 < np.median(np.linalg.slogdet(problem.Y)[1]) / np.log(10) < -22
    _, gradient = loss_and_gradient(theta, problem, loss)
    numeric = np.zeros_like(theta)
    for index in np.ndindex(theta.shape):
        step = np.zeros_like(theta)
        step[index] = 1e-3

        def value(t: float, step: Array = step) -> float:
            return loss_and_gradient(theta + t * step, problem, loss)[0]

        near, far = (value(1) - value(-1)) / 2e-3, (value(2) - value(-2)) / 4e-3
        numeric[index] = (4 * near - far) / 3
    if form == "upper_triangular":
        gradient, numeric = np.triu(gradient), np.triu(numeric)
    assert np.linalg.norm(gradient - numeric) < 1e-6 * np.linalg.norm(numeric)


def test_det_and_its_gradient_are_those_of_the_printed_loss() -> None:
    problem = a_problem()
    larger = dataclasses.replace(
        problem,
        Y=problem.Y * 1e4,
        packed_examples=problem.packed_examples * 1e4,
        means=problem.means * 1e4,
    )  # det is about 1: neither term drowns
    theta, step = THETAS["low_rank"], np.random.default_rng(5).normal(size=(2, 5)) * 1e-3
    F = predicted(theta, larger)
    fit = np.trace(np.linalg.solve(F, larger.Y), axis1=1, axis2=2)
    loss, gradient = loss_and_gradient(theta, larger, "paper")
    assert loss == pytest.approx(np.mean(np.linalg.det(F) + fit))
    ahead, behind = (
        loss_and_gradient(theta + sign * step, larger, "paper")[0] for sign in (1, -1)
    )
    assert np.sum(gradient * step) == pytest.approx((ahead - behind) / 2, rel=1e-4)


def test_loss_at_the_covariance_itself_is_ln_det_plus_6_and_higher_beside_it() -> None:
    Y = covariances(1, np.random.default_rng(0))
    packed = Y[0][np.triu_indices(6)]

    def loss(factor: float) -> float:
        problem = Problem(
            X=np.zeros((1, 1)),
            Y=Y,
            groups=np.array([0]),
            X_examples=np.zeros((1, 1)),
            packed_examples=factor * packed[None],
            groups_examples=np.array([1]),
            means=factor * packed[None],
            mean_weight=0.0,
        )
        return loss_and_gradient(np.zeros(1), problem)[0]

    assert loss(1.0) == pytest.approx(np.linalg.slogdet(Y[0])[1] + 6, abs=1e-9)
    assert loss(0.5) > loss(1.0) + 1
    assert loss(2.0) > loss(1.0) + 1


def test_zero_theta_predicts_the_mean_of_the_other_recordings() -> None:
    examples, problem = some(), a_problem(0.0, (0.0,))
    F = predicted(np.zeros(5), problem)
    for k in range(24):
        others = examples.covariances[examples.groups != examples.groups[k]]
        np.testing.assert_allclose(F[k], others.mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("mean_weight", [0.0, 0.5])
def test_an_example_never_sees_its_own_recording(mean_weight: float) -> None:
    examples = some(rotations=(0.0, np.pi / 2))
    config = TrainingConfig(features="descriptor", shape="none", mean_weight=mean_weight)
    own = examples.groups == "world_s1"
    changed = dataclasses.replace(
        examples, covariances=np.where(own[:, None, None], 1e6 * np.eye(6), examples.covariances)
    )
    theta = THETAS["upper_triangular"]
    before, after = (
        predicted(theta, leave_out_problem(some_, config, np.zeros(5), np.ones(5)))
        for some_ in (examples, changed)
    )
    np.testing.assert_array_equal(before[own], after[own])
    assert (np.abs(after[~own] - before[~own]).max(axis=(1, 2)) > 1e-9).all()


def test_planted_feature_is_found_and_beats_the_mean() -> None:
    config = dataclasses.replace(PAPER, theta="upper_triangular")
    training = fit(planted(seed=0), config, planted(100, seed=1))
    figures = training.figures["validation"]
    assert figures["cello3d"].kl_mean < 0.3 * figures["mean_covariance"].kl_mean
    weights = np.linalg.norm(training.model.theta / training.model.scale, axis=0)
    assert np.argmax(weights) == 3
    assert weights[3] > 3 * np.delete(weights, 3).max()


def test_targets_are_the_pairs_as_they_were_recorded() -> None:
    examples = some(rotations=(0.5, 0.0, 1.0))
    config = TrainingConfig(features="descriptor", shape="none")
    problem = leave_out_problem(examples, config, np.zeros(5), np.ones(5))
    np.testing.assert_array_equal(problem.X, examples.features[:, 1])
    np.testing.assert_array_equal(problem.Y, examples.covariances)
    np.testing.assert_array_equal(problem.X_examples, examples.features.reshape(-1, 5))
    with pytest.raises(DatasetError, match="none at 0 rad"):
        fit(some(rotations=(0.5, 1.0)), config)


@pytest.mark.parametrize("form", ["upper_triangular", "diagonal", "low_rank"])
def test_the_search_ends_where_the_regularised_gradient_vanishes(form: str) -> None:
    examples = planted(80)
    config = dataclasses.replace(
        PAPER, theta=form, rank=2, regularization=0.02, max_iterations=500
    )
    model = fit(examples, config).model
    problem = leave_out_problem(examples, config, model.mean, model.scale)
    _, gradient = loss_and_gradient(model.theta, problem)
    residual = gradient + 2 * 0.02 * model.theta
    if form != "low_rank":
        residual = np.triu(residual)
    if form == "diagonal":
        residual = np.diag(np.diag(residual))
    assert np.abs(residual).max() < 0.02 * np.abs(2 * 0.02 * model.theta).max()
    if form != "low_rank":
        assert not np.tril(model.theta, -1).any()


@pytest.mark.parametrize("form", ["upper_triangular", "diagonal", "low_rank"])
def test_the_search_starts_where_many_examples_are_heard(form: str) -> None:
    examples = some(150, n_features=60)
    losses: list[float] = []
    fit(
        examples,
        dataclasses.replace(PAPER, theta=form, max_iterations=1),
        progress=lambda iteration, training, judged: losses.append(training),
    )
    config = dataclasses.replace(PAPER, theta="diagonal")
    problem = leave_out_problem(examples, config, np.zeros(60), np.ones(60))
    of_mean, _ = loss_and_gradient(np.zeros(60), problem)
    of_nearest, _ = loss_and_gradient(np.ones(60), problem)
    assert of_mean - 0.5 < losses[0] < of_mean + 0.5 < of_nearest


@pytest.mark.parametrize("form", ["upper_triangular", "diagonal", "low_rank"])
def test_pure_noise_is_within_two_percent_of_the_mean(form: str) -> None:
    config = dataclasses.replace(PAPER, theta=form, rank=4, regularization=0.03)
    training = fit(noise(400, 2), config, noise(200, 3))
    unseen = noise(300, 4)
    F = np.array([answer.covariance for answer in answers(training.model, unseen)])
    baseline = np.tile(noise(400, 2).covariances.mean(axis=0), (300, 1, 1))
    assert kl(unseen.covariances, F).mean() < 1.02 * kl(unseen.covariances, baseline).mean()


@pytest.mark.parametrize("form", ["upper_triangular", "diagonal", "low_rank"])
@pytest.mark.parametrize("shape", ["none", "hessian", "sandwich"])
@pytest.mark.parametrize("frame", ["motion", "sensor"])
def test_the_model_predicts_as_training_judged_it(form: str, shape: str, frame: str) -> None:
    examples, validation = some(seed=0, rotations=(0.0, 0.5)), some(9, seed=1)
    moved = np.random.default_rng(2).normal(size=(33, 2)) * 0.05
    examples = dataclasses.replace(examples, motions=moved[:24])
    groups = np.array(["v"] * 9)
    validation = dataclasses.replace(validation, groups=groups, motions=moved[24:])
    config = TrainingConfig(
        features="descriptor",
        shape=shape,
        frame=frame,
        theta=form,
        rank=2,
        max_iterations=5,
        mean_weight=0.1,
    )
    training = fit(examples, config, validation)
    F = np.array([answer.covariance for answer in answers(training.model, validation)])
    divergence = kl(validation.covariances, F)
    figures = training.figures["validation"]["cello3d"]
    assert figures.kl_mean == pytest.approx(divergence.mean(), rel=1e-9)
    assert figures.kl_median == pytest.approx(np.median(divergence), rel=1e-9)
    assert is_positive_definite(F).all()


def test_a_turned_copy_predicts_the_turned_covariance() -> None:
    examples = some(6, rotations=(0.0, 0.7))
    config = TrainingConfig(
        features="descriptor",
        shape="sandwich",
        frame="sensor",
        theta="diagonal",
        mean_weight=0.0,
        max_iterations=1,
    )
    model = fit(examples, config).model
    Ad = adjoint(exp([0, 0, 0, 0, 0, 0.7]))
    for k in range(6):
        turned_S = Ad @ examples.shapes["sandwich"][k] @ Ad.T
        root = matrix_sqrt(turned_S)
        np.testing.assert_allclose(
            root @ model.covariances[2 * k + 1] @ root,
            Ad @ examples.covariances[k] @ Ad.T,
            rtol=1e-8,
            atol=1e-12,
        )


def test_constant_features_weigh_nothing() -> None:
    examples = some(n_features=6)
    features = examples.features.copy()
    features[:, :, 2] = 0.1
    config = TrainingConfig(
        features="descriptor", shape="none", theta="low_rank", rank=3, max_iterations=3
    )
    model = fit(dataclasses.replace(examples, features=features), config).model
    assert model.scale[2] == 1.0
    assert not model.theta[:, 2].any()


def test_training_twice_gives_the_same_bits() -> None:
    config = TrainingConfig(
        features="descriptor", shape="none", theta="low_rank", rank=2, max_iterations=15
    )
    one, two = fit(some(), config).model, fit(some(), config).model
    for name in ("theta", "mean", "scale", "projections", "covariances"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert one.provenance == two.provenance


def test_the_order_of_the_examples_does_not_change_predictions() -> None:
    examples = some()
    order = np.random.default_rng(0).permutation(24)
    shuffled = dataclasses.replace(
        examples,
        features=examples.features[order],
        covariances=examples.covariances[order],
        groups=examples.groups[order],
        xi=tuple(examples.xi[k] for k in order),
    )
    config = dataclasses.replace(PAPER, max_iterations=3)  # rounding grows from step to step
    one, two = fit(examples, config).model, fit(shuffled, config).model
    d, ahead = np.linspace(-1, 1, 5), {"motion": [1.0, 0.0]}
    np.testing.assert_allclose(
        predict(one, d, **ahead).covariance, predict(two, d, **ahead).covariance, rtol=1e-6
    )


SGD = TrainingConfig(
    features="descriptor",
    shape="none",
    theta="diagonal",
    mean_weight=0.0,
    regularization=1e-3,
    optimizer="sgd",
)


def test_stochastic_descent_is_that_of_one_target_after_another_at_a_small_rate() -> None:
    rate, examples = 1e-7, planted(60)
    config = dataclasses.replace(SGD, learning_rate=rate, max_iterations=1)
    judge = planted(60, 1)
    problem = leave_out_problem(examples, config, *feature_scaler(examples)[:2])
    theta = np.ones(10) / np.sqrt(median_rho(problem, np.ones(10)))
    _, gradient = loss_and_gradient(theta, problem)
    expected = theta - rate * len(problem.X) * (gradient + 2 * SGD.regularization * theta)
    found = np.abs(np.diagonal(fit(examples, config, judge).model.theta))
    np.testing.assert_allclose(found - theta, expected - theta, rtol=1e-3)


@pytest.mark.parametrize("form", ["diagonal", "low_rank", "upper_triangular"])
def test_stochastic_descent_lowers_the_loss_on_planted_data(form: str) -> None:
    config = dataclasses.replace(SGD, theta=form, learning_rate=1e-4, max_iterations=10)
    training = fit(planted(), config, planted(150, 1))
    losses = np.array([loss for _, loss, _ in training.curve])
    assert (np.diff(losses) < 0).all()
    assert losses[-1] < losses[0] - 0.02
    paper = fit(planted(), dataclasses.replace(config, learning_rate=1e-5))
    assert paper.curve[-1][1] < paper.curve[0][1]
    again = fit(planted(), config, planted(150, 1))
    assert again.curve == training.curve
    np.testing.assert_array_equal(again.model.theta, training.model.theta)


def test_too_high_a_rate_is_one_sentence() -> None:
    with pytest.raises(ConfigError, match=r"training.learning_rate must be less than 1e\+100"):
        fit(planted(60), dataclasses.replace(SGD, learning_rate=1e100))


def test_the_curve_is_what_progress_was_told() -> None:
    told: list[tuple[int, float, float]] = []
    training = fit(planted(60), PAPER, planted(60, 1), lambda *step: told.append(step))
    assert list(training.curve) == told
    assert [step for step, _, _ in told] == list(range(training.n_iterations + 1))
    examples, config = planted(60), PAPER
    problem = leave_out_problem(examples, config, *feature_scaler(examples)[:2])
    step, loss, _ = told[training.best_iteration]
    theta = np.diagonal(training.model.theta)
    assert step == training.best_iteration
    assert loss == pytest.approx(loss_and_gradient(theta, problem)[0], rel=1e-12)


def test_an_interrupt_keeps_the_best_so_far() -> None:
    def interrupt(iteration: int, training: float, validation: float) -> None:
        if iteration == 2:
            raise KeyboardInterrupt

    training = fit(planted(120), PAPER, planted(60, 1), interrupt)
    whole = fit(planted(120), PAPER, planted(60, 1))
    assert training.interrupted
    assert not whole.interrupted
    assert training.n_iterations == 2 < whole.n_iterations
    kl_of = [t.figures["validation"]["cello3d"].kl_mean for t in (whole, training)]
    assert kl_of[0] < kl_of[1] < training.figures["validation"]["mean_covariance"].kl_mean


def test_the_best_theta_by_validation_is_kept() -> None:
    seen: list[tuple[float, int]] = []

    def record(iteration: int, training: float, validation: float) -> None:
        seen.append((validation, iteration))

    config = dataclasses.replace(PAPER, theta="upper_triangular", regularization=0.0)
    training = fit(noise(60, 5), config, noise(60, 6), record)
    best = min(seen)
    assert training.n_iterations == seen[-1][1] <= training.best_iteration + 20
    assert training.best_iteration in (best[1], 0)
    figures = training.figures["validation"]
    assert figures["cello3d"].kl_mean <= figures["mean_covariance"].kl_mean * (1 + 1e-9)


def test_figures_say_both_how_far_and_in_which_direction() -> None:
    rng = np.random.default_rng(0)
    Y = covariances(1, rng)[0]
    examples = dataclasses.replace(
        some(60),
        covariances=np.tile(Y, (60, 1, 1)),
        xi=tuple(rng.multivariate_normal(np.zeros(6), 4 * Y, size=50) for _ in range(60)),
    )
    figures = fit(examples, PAPER).figures["leave_recording_out"]
    assert set(figures) == {"cello3d", "mean_covariance", "constant"}
    # all pairs have the same covariance, and the sampled errors are twice as large
    assert figures["cello3d"].kl_mean == pytest.approx(0.0, abs=1e-9)
    assert figures["cello3d"].dm2_over_6 == pytest.approx(1.0)
    inside = np.mean(rng.chisquare(6, 100000) < 12.5916 / 4)
    assert figures["cello3d"].coverage_95 == pytest.approx(inside, abs=0.03)
    smaller = dataclasses.replace(examples, covariances=np.tile(Y, (60, 1, 1)))
    smaller.covariances[examples.groups == "world_s0"] /= 10
    figures = fit(smaller, PAPER).figures["leave_recording_out"]
    assert figures["mean_covariance"].dm2_over_6 == pytest.approx((0.1 + 2 / 0.55) / 3)
    wide, narrow = (float(kl(np.eye(6), size * np.eye(6))) for size in (0.55, 10.0))
    assert figures["mean_covariance"].kl_mean == pytest.approx((2 * wide + narrow) / 3)
    assert figures["mean_covariance"].kl_median == pytest.approx(wide)
    assert figures["mean_covariance"].kl_trimmed_mean == pytest.approx(
        (40 * wide + 14 * narrow) / 54
    )
    assert figures["constant"] == figures["mean_covariance"]  # the shape is none


def test_one_recording_is_too_few() -> None:
    examples = dataclasses.replace(some(), groups=np.array(["alone"] * 24))
    with pytest.raises(DatasetError, match=r"at least two recordings.*found only alone"):
        fit(examples, PAPER)


def test_a_recording_cannot_be_validated_on_and_trained_on() -> None:
    with pytest.raises(DatasetError, match="world_s0 is both trained on and validated on"):
        fit(some(), PAPER, some(3))


def test_a_singular_shape_is_one_sentence() -> None:
    examples = some()
    examples.shapes["sandwich"][5] = np.diag([1.0, 1, 1, 1, 1, 0])
    with pytest.raises(DatasetError, match="the sandwich of a pair is singular to rounding"):
        fit(examples, TrainingConfig(features="descriptor", shape="sandwich"))


def test_a_missing_shape_is_named() -> None:
    with pytest.raises(DatasetError, match="does not hold the sandwich"):
        fit(
            dataclasses.replace(some(), shapes={}),
            TrainingConfig(features="descriptor", shape="sandwich"),
        )


def filled(path: Path, names: tuple[str, ...], **settings: object) -> Dataset:
    sampling = SamplingConfig(**settings)  # type: ignore[arg-type]
    dataset = open_dataset(path, Pipeline(), sampling, create=True)
    rng = np.random.default_rng(len(path.name))
    for name in names:
        for i in range(4):
            dataset.write(
                PairRecord(
                    recording=name,
                    i=i,
                    j=i + 1,
                    accepted=i < 3,
                    reason="" if i < 3 else "offset",
                    T_mean=np.eye(4),
                    xi=rng.normal(size=(500, 6)),
                    kept=np.arange(500) < 450,
                    covariance=covariances(1, rng)[0],
                    descriptors=rng.random((2, 11), dtype=np.float32),
                    features=rng.normal(5.0, size=len(FEATURES)),
                    rotations_rad=np.array([0.0, np.pi / 2]),
                    shapes={"sandwich": covariances(1, rng)[0]},
                )
            )
    return dataset


def test_examples_are_the_accepted_pairs_of_the_named_recordings(tmp_path: Path) -> None:
    one, two = filled(tmp_path / "one", ("a", "b")), filled(tmp_path / "two", ("c",), seed=7)
    examples = load_examples([one, two], ["a", "c"])
    assert examples.n_pairs == {"a": 3, "c": 3}
    assert examples.rejected == {"offset": 2}
    assert examples.features.shape == (6, 2, 11)
    np.testing.assert_array_equal(examples.covariances[1], one.read("a", 1, 2).covariance)
    np.testing.assert_array_equal(
        examples.shapes["sandwich"][3], two.read("c", 0, 1).shapes["sandwich"]
    )
    record = one.read("a", 0, 1)
    assert 100 <= len(examples.xi[0]) <= 200
    assert set(examples.xi[0][:, 0]) <= set(record.xi[record.kept, 0])


def test_lost_registrations_are_those_of_accepted_pairs_whatever_the_order(tmp_path: Path) -> None:
    one, two = filled(tmp_path / "one", ("a",)), filled(tmp_path / "three", ("c",), seed=7)
    examples = load_examples([one, two], ["a", "c"])
    records = [
        dataset.read(name, i, i + 1)
        for dataset, name in ((one, "a"), (two, "c"))
        for i in range(3)
    ]
    far = [
        xi
        for record in records
        for xi in record.xi
        if np.linalg.norm(xi[:3]) > 0.3 or np.linalg.norm(xi[3:]) > 0.15
    ]
    np.testing.assert_array_equal(examples.lost_xi, far)
    np.testing.assert_array_equal(load_examples([two, one], ["c", "a"]).lost_xi, far)


def test_the_limit_is_what_three_pairs_in_a_hundred_exceed() -> None:
    examples = some(201)
    sizes = np.arange(1, 202) * 1e-3
    S = sizes[:, None, None] ** 2 * np.diag([1 / 3, 1 / 3, 1 / 3, 1, 1, 1])
    lost_xi = np.random.default_rng(4).normal(size=(4000, 6)) * [2.0, 1, 1, 1, 1, 0.5]
    examples = dataclasses.replace(examples, shapes={"sandwich": S}, lost_xi=lost_xi)
    known = known_lost(examples)
    assert known is not None
    assert known.limit_m == pytest.approx(0.195)
    assert np.diag(known.covariance) == pytest.approx([4, 1, 1, 1, 1, 0.25], rel=0.1)
    assert known_lost(dataclasses.replace(examples, lost_xi=lost_xi[:29])) is None
    assert known_lost(dataclasses.replace(examples, shapes={})) is None


def test_lost_registrations_scatter_about_the_truth_not_about_their_mean() -> None:
    lost_xi = np.random.default_rng(5).normal(size=(40, 6)) + [3.0, 0, 0, 0, 0, 0.5]
    S = np.tile(np.eye(6), (8, 1, 1))
    known = known_lost(dataclasses.replace(some(8), shapes={"sandwich": S}, lost_xi=lost_xi))
    assert known is not None
    np.testing.assert_allclose(known.covariance, lost_xi.T @ lost_xi / 39, rtol=1e-12)


def test_the_papers_form_knows_nothing_of_other_minima() -> None:
    lost_xi = np.random.default_rng(4).normal(size=(400, 6))
    examples = dataclasses.replace(some(), lost_xi=lost_xi)
    relative = dataclasses.replace(PAPER, shape="sandwich", max_iterations=2)
    assert fit(examples, dataclasses.replace(PAPER, max_iterations=2)).model.lost is None
    assert fit(examples, relative).model.lost is not None


def test_datasets_of_different_settings_do_not_mix(tmp_path: Path) -> None:
    one = filled(tmp_path / "one", ("a",))
    two = filled(tmp_path / "two", ("b",), variance=0.1)
    with pytest.raises(DatasetError, match=r"sampling.variance is 0.1, not 0.05"):
        load_examples([one, two], ["a", "b"])
    pipeline = Pipeline(cloud=CloudConfig(voxel_m=0.3))
    three = open_dataset(tmp_path / "three", pipeline, SamplingConfig(), create=True)
    with pytest.raises(DatasetError, match=r"cloud.voxel_m is 0.3, not 0.1"):
        load_examples([one, three], ["a"])


def test_a_pair_in_two_datasets_is_refused(tmp_path: Path) -> None:
    one, two = filled(tmp_path / "one", ("a",)), filled(tmp_path / "two", ("a",))
    with pytest.raises(DatasetError, match="repeats the pair"):
        load_examples([one, two], ["a"])


def test_a_damaged_pair_stops_training_with_its_name(tmp_path: Path) -> None:
    one = filled(tmp_path / "one", ("a",))
    (tmp_path / "one" / "pairs" / "a_1_2.npz").write_bytes(b"PK\x03\x04 half")
    with pytest.raises(DatasetError, match=r"a_1_2.npz is damaged"):
        load_examples([one], ["a"])


def test_no_accepted_pair_is_said(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no accepted pair"):
        load_examples([filled(tmp_path / "one", ("a",))], ["nobody"])


def test_a_pair_with_a_free_direction_is_no_example() -> None:
    examples = planted(120)
    held = np.random.default_rng(4).uniform(1.0, 4.0, 120)
    features = np.column_stack([examples.features[:, 0], np.full((120, N_MORE - 1), 5.0)])
    examples = dataclasses.replace(
        examples, global_features=np.column_stack([features, np.log(held)])
    )
    model = fit(examples, dataclasses.replace(PAPER, features="global", max_iterations=2)).model
    assert model.n_examples == (held >= HELD).sum()
    assert model.n_examples < 120


def test_global_features_are_learned_from_without_turned_copies() -> None:
    """Planted: Y depends on one global feature; the descriptor is noise."""
    examples = planted(120)
    noise = np.random.default_rng(3).normal(size=(120, 2, 4))
    with_both = dataclasses.replace(
        examples,
        features=noise.astype(np.float32),
        global_features=np.column_stack(
            [examples.features[:, 0].astype(np.float64), np.full((120, N_MORE), 5.0)]
        ),
        rotations_rad=np.array([0.0, 1.0]),
    )
    config = dataclasses.replace(PAPER, features="global", max_iterations=20)
    model = fit(with_both, config).model
    plain = fit(examples, dataclasses.replace(config, features="descriptor")).model
    assert model.features == "global"
    assert model.n_examples == 120
    np.testing.assert_allclose(model.theta[:, :-N_MORE], plain.theta, rtol=1e-4, atol=1e-6)
    both = fit(with_both, dataclasses.replace(config, features="both")).model
    assert both.n_features == len(FEATURES) + 4
    seen = with_both.global_features
    np.testing.assert_array_equal(model.input_range, [seen.min(axis=0), seen.max(axis=0)])
    assert len(plain.input_range) == 0
    assert plain.rotations_rad.tolist() == examples.rotations_rad.tolist()
    np.testing.assert_allclose(plain.training_mean, examples.covariances.mean(axis=0), rtol=1e-12)
    with pytest.raises(DatasetError, match="no global features"):
        fit(examples, config)


def test_the_evidence_is_that_of_leaving_recordings_out() -> None:
    model = fit(planted(120), dataclasses.replace(PAPER, max_iterations=5)).model
    groups = planted(120).groups
    P = model.projections
    rho = ((P[:, None] - P) ** 2).sum(axis=2)
    rho[groups[:, None] == groups] = np.inf
    expected = np.quantile(rho.min(axis=1), np.linspace(0, 1, 101))
    np.testing.assert_allclose(model.rho_quantiles, expected, rtol=1e-6, atol=1e-9)


def test_the_margin_is_in_the_figures_too() -> None:
    one, wide = (
        fit(planted(60), dataclasses.replace(PAPER, margin=margin, max_iterations=3))
        for margin in (1.0, 2.0)
    )
    a, b = (t.figures["leave_recording_out"]["cello3d"] for t in (one, wide))
    assert b.dm2_over_6 == pytest.approx(a.dm2_over_6 / 2.0)
    assert wide.model.margin == 2.0


def test_a_model_holds_the_bias_that_its_recordings_show_and_absolute_ones_none() -> None:
    """All errors of a recording are one draw, in units of the sandwich."""
    rng, n = np.random.default_rng(2), 60
    examples = some(n)
    b = rng.normal(size=(3, 6))
    b *= np.sqrt(3.0) / np.linalg.norm(b, axis=1, keepdims=True)  # half of the six of a chi square
    L = np.linalg.cholesky(examples.shapes["sandwich"])
    xi = tuple(np.tile(L[k] @ b[k % 3], (50, 1)) for k in range(n))
    examples = dataclasses.replace(
        examples,
        covariances=L @ np.swapaxes(L, 1, 2),
        scans=np.array([[k // 3, k // 3 + 1] for k in range(n)]),
        T_mean=np.tile(np.eye(4), (n, 1, 1)),
        xi=xi,
    )
    config = TrainingConfig(features="descriptor", frame="sensor", theta="diagonal")
    bias = fit(examples, config).model.bias
    assert bias.share == pytest.approx(0.5, abs=0.01)
    assert fit(examples, PAPER).model.bias == INDEPENDENT
