"""Learning Theta: which training pairs resemble a new one (Sec. IV-B of the paper).

Theta minimises the loss of ``learning/loss.py`` plus ``lambda |Theta|^2``.  Covariances are
relative to the shape S of their pair, ``S^-1/2 Y S^-1/2``, unless the shape is "none".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from cello3d_ros.config import TrainingConfig
from cello3d_ros.covariance.heading import mean_of_turns
from cello3d_ros.covariance.lost import Lost, spread_m
from cello3d_ros.covariance.model import Model, project
from cello3d_ros.covariance.sums import unpack
from cello3d_ros.errors import ConfigError, DatasetError, FreeDirectionError
from cello3d_ros.geometry.gaussian import INDEPENDENT, Bias, sampled_covariance
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.bias import measured_bias
from cello3d_ros.learning.dataset import package_versions
from cello3d_ros.learning.examples import (
    Examples,
    Indices,
    are_held,
    feature_scaler,
    flat_features,
    select_inputs,
    to_absolute,
)
from cello3d_ros.learning.loss import (
    Problem,
    expand_features,
    leave_out_problem,
    loss_and_gradient,
    median_rho,
    nearest_rho,
    pair_losses,
    predicted,
    select_features,
    select_targets,
    validation_problem,
)
from cello3d_ros.learning.measures import Figures, evaluate, select

Progress = Callable[[int, float, float], None]  # iteration, training loss, what Theta is judged by

_LEVELS = np.linspace(0.0, 1.0, 101)  # of the quantiles that a model keeps
_PATIENCE = 20  # iterations without a better validation loss that end training
_DIVERGED = 1e100  # |Theta|^2, far beyond anything and far below where numbers end
_BATCH = 64  # targets of one stochastic gradient
_LOST_QUANTILE = 0.97  # of the pairs' sandwiches; decision 11
_FEWEST_LOST = 30  # registrations in other minima that make a covariance


@dataclass(frozen=True, kw_only=True, eq=False)
class Training:
    """A trained model and how good it is.

    figures: for "leave_recording_out" and, if there was one, "validation": predictor -> figures.
    n_iterations: steps made; best_iteration: the one whose Theta was kept (0 is before any).
    curve: what ``progress`` was told, step by step.
    """

    model: Model
    figures: dict[str, dict[str, Figures]]
    n_iterations: int
    best_iteration: int
    interrupted: bool
    curve: tuple[tuple[int, float, float], ...]


def fit(
    examples: Examples,
    config: TrainingConfig,
    validation: Examples | None = None,
    progress: Progress | None = None,
) -> Training:
    """Fit Theta by L-BFGS or SGD and return the model with the best one met.

    Best is by the loss on the validation recordings, predicted from the examples, or without them
    by the regularised leave-recording-out loss; 20 iterations without a better one end training.
    Theta = 0, the mean of the examples, takes part.  Deterministic; an interrupt (Ctrl-C) ends
    training with the best so far.  Raises DatasetError for fewer than two recordings.
    """
    examples = _inputs(examples, config.features)
    if validation is not None:
        validation = _inputs(validation, config.features)
    _check_groups(examples, validation)
    mean, scale, active = _scaler(examples, config)
    problem = leave_out_problem(examples, config, mean, scale)
    judge = problem
    if validation is not None:
        judge = validation_problem(problem, validation, config, mean, scale)
    searched = select_features(problem, active)
    judging = searched if validation is None else select_features(judge, active)
    search = _Search(searched, judging, config, progress)
    search.run()
    theta = expand_features(search.theta, active, len(mean))
    figures = {"leave_recording_out": evaluate(problem, theta, examples, examples, config)}
    if validation is not None:
        figures["validation"] = evaluate(judge, theta, examples, validation, config)
    model = _model(theta, (mean, scale), problem, examples, config)
    model.provenance.update(_provenance(search, figures, validation))
    return Training(
        model=model,
        figures=figures,
        n_iterations=search.n_iterations,
        best_iteration=search.best_iteration,
        interrupted=search.interrupted,
        curve=tuple(search.curve),
    )


def _scaler(examples: Examples, config: TrainingConfig) -> tuple[Array, Array, Indices]:
    """Return mean and scale of the features, and which of them vary."""
    mean, scale, active = feature_scaler(examples)
    if not config.standardize:
        mean, scale = np.zeros_like(mean), np.ones_like(scale)
    return mean, scale, active


def _model(
    theta: Array,
    scaler: tuple[Array, Array],
    problem: Problem,
    examples: Examples,
    config: TrainingConfig,
) -> Model:
    mean, scale = scaler
    return Model(
        theta=theta,
        mean=mean,
        scale=scale,
        projections=project(flat_features(examples), theta, mean, scale),
        covariances=unpack(problem.packed_examples),
        shape=config.shape,
        frame=config.frame,
        features=config.features,
        rho_quantiles=np.quantile(nearest_rho(theta, problem), _LEVELS),
        input_range=_input_range(examples, config),
        rotations_rad=examples.rotations_rad,
        training_mean=examples.covariances.mean(axis=0),
        mean_weight=config.mean_weight,
        margin=config.margin,
        lost=None if config.shape == "none" else known_lost(examples, config.frame),
        bias=_bias(theta, problem, examples, config),
        pipeline=examples.pipeline,
        sampling=examples.sampling,
        provenance={
            "recordings": examples.n_pairs,
            "rejected_pairs": examples.rejected,
            "training": dataclasses.asdict(config),
            "versions": package_versions(),
        },
    )


def _bias(theta: Array, problem: Problem, examples: Examples, config: TrainingConfig) -> Bias:
    """Return what neighbouring registrations share; nothing in the paper's absolute form."""
    if config.shape == "none":
        return INDEPENDENT
    F = config.margin * predicted(theta, problem)
    return measured_bias(examples, to_absolute(F, examples, config.shape, config.frame))


def _provenance(
    search: _Search, figures: dict[str, dict[str, Figures]], validation: Examples | None
) -> dict[str, Any]:
    return {
        "validation_recordings": {} if validation is None else validation.n_pairs,
        "iterations": search.n_iterations,
        "best_iteration": search.best_iteration,
        "figures": {
            name: {predictor: dataclasses.asdict(f) for predictor, f in by.items()}
            for name, by in figures.items()
        },
    }


def _input_range(examples: Examples, config: TrainingConfig) -> Array:
    """Return the least and the largest inputs; nothing for the paper's descriptor.  (2 or 0, D).

    Global features are mostly logarithms and have no bounds; those of the descriptor are shares.
    """
    rows = flat_features(examples)
    if config.features == "descriptor":
        return np.zeros((0, rows.shape[1]))
    return np.stack([rows.min(axis=0), rows.max(axis=0)])


def known_lost(examples: Examples, frame: str = "sensor") -> Lost | None:
    """Return how to tell registrations in other minima; None where too few were met.

    The limit is what the sandwiches of 3 % of the pairs exceed where ICP started from the truth.
    In the motion frame the scatter of those in other minima has no direction.
    """
    if len(examples.lost_xi) < _FEWEST_LOST or "sandwich" not in examples.shapes:
        return None
    limit_m = np.quantile(spread_m(examples.shapes["sandwich"]), _LOST_QUANTILE)
    scatter = sampled_covariance(examples.lost_xi)
    return Lost(float(limit_m), mean_of_turns(scatter) if frame == "motion" else scatter)


class _Search:
    """Descent over Theta, remembering the best by the judge's loss."""

    def __init__(
        self, problem: Problem, judge: Problem, config: TrainingConfig, progress: Progress | None
    ) -> None:
        self._problem, self._judge, self._config, self._progress = problem, judge, config, progress
        self._n_features = problem.X.shape[1]
        self.n_iterations = 0
        self.best_iteration = 0
        self.interrupted = False
        self.curve: list[tuple[int, float, float]] = []
        self._evaluated: tuple[Array, float] | None = None  # the last Theta, its loss
        self._initial = self._start()
        self.theta = self._matrix(np.zeros_like(self._initial))
        self._best = self._judged(self.theta)

    def run(self) -> None:
        """Search until converged, no longer improving, out of iterations or interrupted."""
        try:
            self._remember(self._initial)
            if self._config.optimizer == "sgd":
                self._descend()
            else:
                self._quasi_newton()
        except _Stop:
            pass
        except KeyboardInterrupt:
            self.interrupted = True

    def _quasi_newton(self) -> None:
        minimize(
            lambda free: self._objective(free, self._problem),
            self._initial,
            jac=True,
            method="L-BFGS-B",
            callback=self._step,
            options={"maxiter": self._config.max_iterations, "maxcor": 20},
        )

    def _descend(self) -> None:
        """Follow the gradients of a few targets at a time, all of them once in an iteration.

        ``Theta -= rate sum_k dL_k/dTheta`` over the targets k of a batch: to first order in the
        rate the same as target by target, and independent of the size of the batch.
        """
        free, n = self._initial.copy(), len(self._problem.X)
        rng = np.random.default_rng([self._config.seed, 1])
        for _ in range(self._config.max_iterations):
            order = rng.permutation(n)
            for start in range(0, n, _BATCH):
                batch = select_targets(self._problem, order[start : start + _BATCH])
                free -= self._config.learning_rate * len(batch.X) * self._objective(free, batch)[1]
                if not float(free @ free) < _DIVERGED:
                    raise ConfigError(
                        "training by sgd diverged: training.learning_rate must be less than "
                        f"{self._config.learning_rate:g}"
                    )
            self._step(free)

    def _start(self) -> Array:
        """Return the free numbers of a Theta under which the median rho is ``start_rho``."""
        n = self._n_features
        if self._config.theta == "diagonal":
            free = np.ones(n)
        elif self._config.theta == "upper_triangular":
            free = np.eye(n)[np.triu_indices(n)]
        else:
            rank = min(self._config.rank, n)
            free = np.random.default_rng(self._config.seed).normal(size=rank * n)
        rho = median_rho(self._problem, self._matrix(free))
        return free * np.sqrt(self._config.start_rho / rho) if rho > 0 else free

    def _matrix(self, free: Array) -> Array:
        n = self._n_features
        if self._config.theta == "diagonal":
            return free
        if self._config.theta == "low_rank":
            return free.reshape(-1, n)
        theta = np.zeros((n, n))
        theta[np.triu_indices(n)] = free
        return theta

    def _objective(self, free: Array, problem: Problem) -> tuple[float, Array]:
        theta = self._matrix(free)
        value, gradient = loss_and_gradient(theta, problem, self._config.loss)
        if problem is self._problem:
            self._evaluated = theta.copy(), value
        if self._config.theta == "upper_triangular":
            gradient = gradient[np.triu_indices(self._n_features)]
        penalty = self._config.regularization
        return value + penalty * float(free @ free), gradient.ravel() + 2.0 * penalty * free

    def _judged(self, theta: Array) -> float:
        """Return the loss on validation, or without it what the search minimises."""
        if self._judge is self._problem:
            penalty = self._config.regularization * float(np.sum(theta**2))
            return self._training_loss(theta) + penalty
        return self._loss(theta, self._judge)

    def _training_loss(self, theta: Array) -> float:
        """Return the loss, for which the optimiser has mostly asked just before."""
        if self._evaluated is None or not np.array_equal(self._evaluated[0], theta):
            self._evaluated = theta.copy(), self._loss(theta, self._problem)
        return self._evaluated[1]

    def _loss(self, theta: Array, problem: Problem) -> float:
        return float(
            pair_losses(predicted(theta, problem), problem.Y, self._config.loss)[0].mean()
        )

    def _step(self, free: Array) -> None:
        self.n_iterations += 1
        self._remember(free)
        if self.n_iterations - self.best_iteration >= _PATIENCE:
            raise _Stop

    def _remember(self, free: Array) -> None:
        theta = self._matrix(free.copy())
        judged = self._judged(theta)
        if judged < self._best:
            self._best, self.theta, self.best_iteration = judged, theta, self.n_iterations
        self.curve.append((self.n_iterations, self._training_loss(theta), judged))
        if self._progress is not None:
            self._progress(*self.curve[-1])


class _Stop(Exception):
    """Ends the optimiser from its callback."""


def _inputs(examples: Examples, kind: str) -> Examples:
    """Return what a model of ``kind`` is trained on; the paper's descriptor knows of no held."""
    examples = select_inputs(examples, kind)
    if kind == "descriptor" or (held := are_held(examples)).all():
        return examples
    rejected = {**examples.rejected, FreeDirectionError.reason: int((~held).sum())}
    return dataclasses.replace(select(examples, held), rejected=rejected)


def _check_groups(examples: Examples, validation: Examples | None) -> None:
    if len(set(examples.groups.tolist())) < 2:
        raise DatasetError(
            "training needs pairs of at least two recordings, each is predicted from the others: "
            f"found only {examples.groups[0]}"
        )
    if validation is None:
        return
    if both := sorted(set(examples.groups.tolist()) & set(validation.groups.tolist())):
        raise DatasetError(f"recording {both[0]} is both trained on and validated on")
    if examples.features.shape[-1] != validation.features.shape[-1]:
        raise DatasetError(
            f"descriptors of {examples.features.shape[-1]} and of "
            f"{validation.features.shape[-1]} values do not mix"
        )
