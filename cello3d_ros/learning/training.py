"""Learning Theta: which training pairs resemble a new one (Sec. IV-B of the paper).

For a target k the model predicts, from the examples j of OTHER recordings only,

    F_k = (1 - w) sum_j s_kj Y_j + w mean_j Y_j,   s_kj proportional to exp(-|Theta (x_k - x_j)|^2)

and Theta minimises the mean over targets of ``log det F_k + tr(F_k^-1 Y_k)``, plus
``lambda |Theta|^2``.  Targets are the pairs as they were recorded; the examples are those and
their copies turned about z, as in the finished model.  Covariances are relative to the shape S of
their pair, ``S^-1/2 Y S^-1/2``, unless the shape is "none".
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import chdtri

from cello3d_ros.config import Pipeline, SamplingConfig, TrainingConfig, differences
from cello3d_ros.covariance.model import Model, project
from cello3d_ros.errors import DatasetError
from cello3d_ros.geometry.gaussian import (
    kl,
    mahalanobis,
    matrix_inverse_sqrt,
    matrix_sqrt,
    symmetrized,
)
from cello3d_ros.geometry.se3 import Array, adjoint, exp
from cello3d_ros.learning.dataset import Dataset, PairRecord, package_versions

Indices = NDArray[np.intp]
Progress = Callable[[int, float, float], None]  # iteration, training loss, what Theta is judged by
Figures = dict[str, dict[str, float]]  # predictor -> measure -> value

_FREE = ("seed", "n_samples", "max_gap")  # sampling settings in which datasets may differ
_ROWS, _COLUMNS = np.triu_indices(6)
_TWICE = np.where(_ROWS == _COLUMNS, 1.0, 2.0)
_BLOCK = 512  # targets at once, bounds memory
_PATIENCE = 20  # iterations without a better validation loss that end training
_MAX_SAMPLES = 200  # errors of each pair kept for the coverage


@dataclass(frozen=True, kw_only=True, eq=False)
class Examples:
    """Accepted pairs of some recordings; nothing is relative or turned yet but the features.

    features: (N, n_rotations, D) descriptors of the pair turned about z by ``rotations_rad``.
    covariances: (N, 6, 6).  groups: (N,) names of recordings.  shapes: name -> (N, 6, 6).
    xi: N arrays (n, 6), some of the errors that made each covariance.
    """

    features: NDArray[np.float32]
    covariances: Array
    groups: NDArray[np.str_]
    shapes: dict[str, Array]
    rotations_rad: Array
    xi: tuple[Array, ...] = ()
    rejected: dict[str, int] = dataclasses.field(default_factory=dict)  # reason -> pairs
    pipeline: Pipeline = dataclasses.field(default_factory=Pipeline)
    sampling: SamplingConfig = dataclasses.field(default_factory=SamplingConfig)

    @property
    def n_pairs(self) -> dict[str, int]:
        """Accepted pairs of each recording."""
        return dict(sorted(Counter(self.groups.tolist()).items()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Training:
    """A trained model and how good it is.

    figures: for "leave_recording_out" and, if there was one, "validation": predictor -> measure.
    n_iterations: steps made; best_iteration: the one whose Theta was kept (0 is before any).
    """

    model: Model
    figures: dict[str, Figures]
    n_iterations: int
    best_iteration: int
    interrupted: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Targets, and the examples from which each may be predicted: those of another group.

    X: (K, D) standardised features.  Y: (K, 6, 6).  groups: (K,).  The same of the M examples,
    with covariances packed (M, 21).  means: (K, 21), of the examples each target may see.
    """

    X: Array
    Y: Array
    groups: Indices
    X_examples: Array
    packed_examples: Array
    groups_examples: Indices
    means: Array
    mean_weight: float


def load_examples(datasets: Sequence[Dataset], recordings: Iterable[str]) -> Examples:
    """Read the accepted pairs of the named recordings.

    Raises DatasetError where datasets were made with different settings, share a pair, hold a
    damaged pair, or have no accepted pair of these recordings.
    """
    for other in datasets[1:]:
        _check_alike(datasets[0], other)
    wanted = set(recordings)
    records: dict[tuple[str, int, int], PairRecord] = {}
    for dataset in datasets:
        for key in dataset.pair_keys():
            if key[0] in wanted:
                if key in records:
                    raise DatasetError(f"{dataset.path} repeats the pair {key} of another dataset")
                records[key] = _slim(dataset.read(*key))
    return _stacked([records[key] for key in sorted(records)], datasets[0])


def train(
    examples: Examples,
    config: TrainingConfig,
    validation: Examples | None = None,
    progress: Progress | None = None,
) -> Training:
    """Fit Theta by L-BFGS and return the model with the best one met.

    Best is by the loss on the validation recordings, predicted from the examples, or without them
    by the regularised leave-recording-out loss; training ends when that has not improved for 20
    iterations.
    Theta = 0, the mean of the examples, takes part.  Deterministic; an interrupt (Ctrl-C) ends
    training with the best so far.  Raises DatasetError for fewer than two recordings.
    """
    _check_groups(examples, validation)
    mean, scale, active = _scaler(examples)
    problem = leave_out_problem(examples, config, mean, scale)
    judge = problem
    if validation is not None:
        judge = _validation_problem(problem, validation, config, mean, scale)
    searched = _selected(problem, active)
    judging = searched if validation is None else _selected(judge, active)
    search = _Search(searched, judging, config, progress)
    search.run()
    theta = _expanded(search.theta, active, len(mean))
    figures = {"leave_recording_out": _figures(problem, theta, examples, examples, config)}
    if validation is not None:
        figures["validation"] = _figures(judge, theta, examples, validation, config)
    provenance = {
        "recordings": examples.n_pairs,
        "validation_recordings": {} if validation is None else validation.n_pairs,
        "rejected_pairs": examples.rejected,
        "rotations_rad": examples.rotations_rad.tolist(),
        "training": dataclasses.asdict(config),
        "iterations": search.n_iterations,
        "best_iteration": search.best_iteration,
        "figures": figures,
        "versions": package_versions(),
    }
    model = Model(
        theta=theta,
        mean=mean,
        scale=scale,
        projections=project(_flat(examples), theta, mean, scale),
        covariances=_unpacked(problem.packed_examples),
        shape=config.shape,
        mean_weight=config.mean_weight,
        pipeline=examples.pipeline,
        sampling=examples.sampling,
        provenance=provenance,
    )
    return Training(
        model=model,
        figures=figures,
        n_iterations=search.n_iterations,
        best_iteration=search.best_iteration,
        interrupted=search.interrupted,
    )


def leave_out_problem(
    examples: Examples, config: TrainingConfig, mean: Array, scale: Array
) -> Problem:
    """Return the problem of predicting each pair from the other recordings."""
    n_rotations = len(examples.rotations_rad)
    groups = np.unique(examples.groups, return_inverse=True)[1].astype(np.intp)
    Y = _relative(examples, config.shape)
    packed = _packed(_turned(Y, examples.rotations_rad))
    groups_examples = np.repeat(groups, n_rotations)
    others = [packed[groups_examples != group].mean(axis=0) for group in range(groups.max() + 1)]
    X = (_flat(examples) - mean) / scale
    return Problem(
        X=X[_unturned(examples)],
        Y=Y,
        groups=groups,
        X_examples=X,
        packed_examples=packed,
        groups_examples=groups_examples,
        means=np.array(others)[groups],
        mean_weight=config.mean_weight,
    )


def loss_and_gradient(
    theta: Array, problem: Problem, loss: str = "log_det"
) -> tuple[float, Array]:
    """Return the mean loss over the targets and its gradient, without regularisation.

    theta: (r, D), or (D,) for a diagonal one.  loss: "log_det", or "paper" with det F.

    With ``G = dL/dF = F^-1 - F^-1 Y F^-1`` (its first term times det F for "paper") and
    ``g_kj = tr(G_k Y_j)``, ``dL/drho_kj = -(1 - w) s_kj (g_kj - sum_i s_ki g_ki)``, and with
    ``c = dL/drho`` the gradient is ``2 Theta sum_kj c_kj (x_k - x_j)(x_k - x_j)^T``, summed as
    products of matrices.
    """
    P_examples = _projected(problem.X_examples, theta)
    n_targets, total = len(problem.X), 0.0
    A_examples, columns = np.zeros_like(P_examples), np.zeros(len(P_examples))
    gradient = np.zeros_like(theta)
    for block in _blocks(n_targets):
        P = _projected(problem.X[block], theta)
        s = _weights(P, P_examples, problem, block)
        losses, G = _losses(_mixed(s, problem, block), problem.Y[block], loss)
        total += losses.sum()
        g = (_packed(G) * _TWICE) @ problem.packed_examples.T
        c = -(1.0 - problem.mean_weight) / n_targets * s * (g - (s * g).sum(axis=1, keepdims=True))
        gradient += _outer(c.sum(axis=1)[:, None] * P - c @ P_examples, problem.X[block], theta)
        A_examples -= c.T @ P
        columns += c.sum(axis=0)
    A_examples += columns[:, None] * P_examples
    gradient += _outer(A_examples, problem.X_examples, theta)
    return total / n_targets, 2.0 * gradient


def predicted(theta: Array, problem: Problem) -> Array:
    """Return F of every target.  (K, 6, 6)."""
    P_examples = _projected(problem.X_examples, theta)
    return np.concatenate(
        [
            _mixed(
                _weights(_projected(problem.X[block], theta), P_examples, problem, block),
                problem,
                block,
            )
            for block in _blocks(len(problem.X))
        ]
    )


class _Search:
    """L-BFGS over Theta, remembering the best by the judge's loss."""

    def __init__(
        self, problem: Problem, judge: Problem, config: TrainingConfig, progress: Progress | None
    ) -> None:
        self._problem, self._judge, self._config, self._progress = problem, judge, config, progress
        self._n_features = problem.X.shape[1]
        self.n_iterations = 0
        self.best_iteration = 0
        self.interrupted = False
        self._initial = self._start()
        self.theta = self._matrix(np.zeros_like(self._initial))
        self._best = self._judged(self.theta)

    def run(self) -> None:
        """Search until converged, no longer improving, out of iterations or interrupted."""
        try:
            self._remember(self._initial)
            minimize(
                self._objective,
                self._initial,
                jac=True,
                method="L-BFGS-B",
                callback=self._step,
                options={"maxiter": self._config.max_iterations, "maxcor": 20},
            )
        except _Stop:
            pass
        except KeyboardInterrupt:
            self.interrupted = True

    def _start(self) -> Array:
        """Return the free numbers of a Theta under which the median rho is 1."""
        n = self._n_features
        if self._config.theta == "diagonal":
            free = np.ones(n)
        elif self._config.theta == "upper_triangular":
            free = np.eye(n)[np.triu_indices(n)]
        else:
            rank = min(self._config.rank, n)
            free = np.random.default_rng(self._config.seed).normal(size=rank * n)
        rho = _median_rho(self._problem, self._matrix(free))
        return free / np.sqrt(rho) if rho > 0 else free

    def _matrix(self, free: Array) -> Array:
        n = self._n_features
        if self._config.theta == "diagonal":
            return free
        if self._config.theta == "low_rank":
            return free.reshape(-1, n)
        theta = np.zeros((n, n))
        theta[np.triu_indices(n)] = free
        return theta

    def _objective(self, free: Array) -> tuple[float, Array]:
        theta = self._matrix(free)
        value, gradient = loss_and_gradient(theta, self._problem, self._config.loss)
        if self._config.theta == "upper_triangular":
            gradient = gradient[np.triu_indices(self._n_features)]
        penalty = self._config.regularization
        return value + penalty * float(free @ free), gradient.ravel() + 2.0 * penalty * free

    def _judged(self, theta: Array) -> float:
        """Return the loss on validation, or without it what the search minimises."""
        if self._judge is self._problem:
            penalty = self._config.regularization * float(np.sum(theta**2))
            return self._loss(theta, self._problem) + penalty
        return self._loss(theta, self._judge)

    def _loss(self, theta: Array, problem: Problem) -> float:
        return float(_losses(predicted(theta, problem), problem.Y, self._config.loss)[0].mean())

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
        if self._progress is not None:
            self._progress(self.n_iterations, self._loss(theta, self._problem), judged)


class _Stop(Exception):
    """Ends the optimiser from its callback."""


def _losses(F: Array, Y: Array, loss: str) -> tuple[Array, Array]:
    """Return the loss of each prediction and its derivative by F.  (K,), (K, 6, 6)."""
    L = np.linalg.cholesky(F)
    log_det = 2.0 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
    L_inverse = np.linalg.inv(L)
    F_inverse = np.swapaxes(L_inverse, 1, 2) @ L_inverse
    fit = np.einsum("kij,kij->k", F_inverse, Y)
    spread = F_inverse @ Y @ F_inverse
    if loss == "paper":
        det = np.exp(log_det)
        return det + fit, det[:, None, None] * F_inverse - spread
    return log_det + fit, F_inverse - spread


def _weights(P: Array, P_examples: Array, problem: Problem, block: slice) -> Array:
    """Return s: (targets of the block, M), zero within the group, rows sum to 1."""
    # |p_k|^2 is the same for every example: it drops out of the weights
    rho = np.einsum("jr,jr->j", P_examples, P_examples) - 2.0 * (P @ P_examples.T)
    rho[problem.groups[block, None] == problem.groups_examples] = np.inf
    s = np.exp(rho.min(axis=1, keepdims=True) - rho)
    return np.asarray(s / s.sum(axis=1, keepdims=True))


def _mixed(s: Array, problem: Problem, block: slice) -> Array:
    """Return F of the targets of a block from their weights."""
    w = problem.mean_weight
    return _unpacked((1.0 - w) * (s @ problem.packed_examples) + w * problem.means[block])


def _projected(X: Array, theta: Array) -> Array:
    return np.asarray(X * theta if theta.ndim == 1 else X @ theta.T)


def _outer(A: Array, X: Array, theta: Array) -> Array:
    """Return ``A^T X``, or its diagonal where Theta is one."""
    return np.asarray(np.einsum("kd,kd->d", A, X) if theta.ndim == 1 else A.T @ X)


def _blocks(n: int) -> list[slice]:
    return [slice(start, start + _BLOCK) for start in range(0, n, _BLOCK)]


def _median_rho(problem: Problem, theta: Array) -> float:
    """Return the median distance of targets to examples of other groups, some of each."""
    some, few = (
        np.linspace(0, n - 1, min(n, 500), dtype=np.intp)
        for n in (len(problem.X), len(problem.X_examples))
    )
    P, Q = _projected(problem.X[some], theta), _projected(problem.X_examples[few], theta)
    rho = (P**2).sum(axis=1)[:, None] + (Q**2).sum(axis=1) - 2.0 * P @ Q.T
    others = problem.groups[some, None] != problem.groups_examples[few]
    return float(np.median(rho[others])) if others.any() else 0.0


def _packed(Y: Array) -> Array:
    """Return the upper triangles.  (..., 6, 6) -> (..., 21)."""
    return np.ascontiguousarray(Y[..., _ROWS, _COLUMNS])


def _unpacked(packed: Array) -> Array:
    Y = np.empty((*packed.shape[:-1], 6, 6))
    Y[..., _ROWS, _COLUMNS] = packed
    Y[..., _COLUMNS, _ROWS] = packed
    return Y


def _relative(examples: Examples, shape: str) -> Array:
    """Return ``S^-1/2 Y S^-1/2`` of every pair, or Y if the shape is none."""
    if shape == "none":
        return examples.covariances
    try:
        root = matrix_inverse_sqrt(examples.shapes[shape])
    except np.linalg.LinAlgError:
        raise DatasetError(f"the {shape} of a pair is singular to rounding") from None
    except KeyError:
        raise DatasetError(f"the dataset does not hold the {shape} of each pair") from None
    return symmetrized(root @ examples.covariances @ root)


def _turned(Y: Array, rotations_rad: Array) -> Array:
    """Return ``Ad_R Y Ad_R^T`` for each turn R about z of the reading frame.

    A shape turns with its covariance, so what is relative turns the same way.
    (N, 6, 6), (R,) -> (N R, 6, 6), the turns of a pair side by side.
    """
    xi = np.zeros((len(rotations_rad), 6))
    xi[:, 5] = rotations_rad
    Ad = adjoint(exp(xi))
    return symmetrized(Ad @ Y[:, None] @ np.swapaxes(Ad, 1, 2)).reshape(-1, 6, 6)


def _flat(examples: Examples) -> Array:
    """Return the features of every pair and turn.  (N n_rotations, D) in float64."""
    return examples.features.reshape(-1, examples.features.shape[-1]).astype(np.float64)


def _unturned(examples: Examples) -> slice:
    """Return which rows of ``_flat`` are pairs as they were recorded."""
    turns = np.flatnonzero(examples.rotations_rad == 0.0)
    if len(turns) == 0:
        raise DatasetError("the dataset holds turned descriptors only, none at 0 rad")
    return slice(int(turns[0]), None, len(examples.rotations_rad))


def _scaler(examples: Examples) -> tuple[Array, Array, Indices]:
    """Return mean and scale (1 for constants) of the features, and which of them vary."""
    X = _flat(examples)
    mean, std = X.mean(axis=0), X.std(axis=0)
    varies = std > 1e-6 * (np.abs(mean) + 1e-6)
    return mean, np.where(varies, std, 1.0), np.flatnonzero(varies)


def _selected(problem: Problem, active: Indices) -> Problem:
    """Return the problem over some of the features."""
    return dataclasses.replace(
        problem,
        X=np.ascontiguousarray(problem.X[:, active]),
        X_examples=np.ascontiguousarray(problem.X_examples[:, active]),
    )


def _expanded(theta: Array, active: Indices, n_features: int) -> Array:
    """Return Theta (r, D) over all features; a triangular one goes without its empty rows."""
    if theta.ndim == 1:
        theta = np.diag(theta)
    full = np.zeros((len(theta), n_features))
    full[:, active] = theta
    return full


def _validation_problem(
    problem: Problem, validation: Examples, config: TrainingConfig, mean: Array, scale: Array
) -> Problem:
    """Return the problem of predicting other recordings from all examples of ``problem``."""
    Y = _relative(validation, config.shape)
    return dataclasses.replace(
        problem,
        X=((_flat(validation) - mean) / scale)[_unturned(validation)],
        Y=Y,
        groups=np.full(len(Y), -1),
        means=np.tile(problem.packed_examples.mean(axis=0), (len(Y), 1)),
    )


def _figures(
    problem: Problem, theta: Array, examples: Examples, targets: Examples, config: TrainingConfig
) -> Figures:
    """Judge the model and two constants on the targets of ``problem``.

    mean_covariance is the mean of the absolute covariances (the paper's baseline), of other
    recordings as they were recorded; constant_relative is that of the relative ones.
    """
    relative = _relative(examples, config.shape)
    names = np.unique(targets.groups)
    absolute_means, relative_means = (
        {name: Y[examples.groups != name].mean(axis=0) for name in names}
        for Y in (examples.covariances, relative)
    )
    constant = np.array([relative_means[name] for name in targets.groups])
    F = {
        "model": _absolute(predicted(theta, problem), targets, config.shape),
        "mean_covariance": np.array([absolute_means[name] for name in targets.groups]),
        "constant_relative": _absolute(constant, targets, config.shape),
    }
    return {name: _measures(Fs, targets) for name, Fs in F.items()}


def _absolute(relative: Array, examples: Examples, shape: str) -> Array:
    if shape == "none":
        return relative
    root = matrix_sqrt(examples.shapes[shape])
    return symmetrized(root @ relative @ root)


def _measures(F: Array, targets: Examples) -> dict[str, float]:
    """Return what to report: KL says how far off, D_M^2 / 6 and coverage in which direction.

    kl_trimmed_mean is without the worst 10 % of the pairs.  mahalanobis2_over_6 is the mean of
    tr(F^-1 Y) / 6, 1 if F is right on average; coverage_95 the share of sampled errors within the
    95 % ellipsoid.
    """
    divergence = np.sort(kl(targets.covariances, F))
    fit = np.trace(np.linalg.solve(F, targets.covariances), axis1=1, axis2=2)
    measures = {
        "n_pairs": float(len(F)),
        "kl_mean": float(divergence.mean()),
        "kl_median": float(np.median(divergence)),
        "kl_trimmed_mean": float(divergence[: max(1, int(0.9 * len(F)))].mean()),
        "mahalanobis2_over_6": float(fit.mean() / 6.0),
    }
    if targets.xi:
        limit = np.sqrt(chdtri(6, 0.05))  # chi-square with 6 degrees of freedom
        pairs = zip(targets.xi, F, strict=True)
        inside = [np.mean(mahalanobis(xi, F_k) <= limit) for xi, F_k in pairs]
        measures["coverage_95"] = float(np.mean(inside))
    return measures


def _check_alike(ours: Dataset, theirs: Dataset) -> None:
    """Raise DatasetError naming the first setting in which two datasets differ."""
    found = differences(theirs.pipeline, ours.pipeline)
    a, b = dataclasses.asdict(theirs.sampling), dataclasses.asdict(ours.sampling)
    found += [
        f"sampling.{name} is {value}, not {b[name]}"
        for name, value in a.items()
        if value != b[name] and name not in _FREE
    ]
    if found:
        raise DatasetError(f"{theirs.path} does not go with {ours.path}: {found[0]}")


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


def _slim(record: PairRecord) -> PairRecord:
    """Return the record with at most 200 errors, evenly spaced, of those that were kept."""
    kept = record.xi[record.kept]
    return dataclasses.replace(record, xi=kept[:: -(-len(kept) // _MAX_SAMPLES) or 1])


def _stacked(records: list[PairRecord], dataset: Dataset) -> Examples:
    """Return the accepted of some records of datasets with the settings of ``dataset``."""
    accepted = [record for record in records if record.accepted]
    if not accepted:
        raise DatasetError(f"{dataset.path}: no accepted pair among {len(records)}")
    first = accepted[0]
    for record in accepted:
        same_turns = np.array_equal(record.rotations_rad, first.rotations_rad)
        if record.descriptors.shape != first.descriptors.shape or not same_turns:
            raise DatasetError(f"pairs {first.key} and {record.key} have unlike descriptors")
    names = set.intersection(*(set(record.shapes) for record in accepted))
    return Examples(
        features=np.array([record.descriptors for record in accepted]),
        covariances=np.array([record.covariance for record in accepted]),
        groups=np.array([record.recording for record in accepted]),
        shapes={n: np.array([record.shapes[n] for record in accepted]) for n in sorted(names)},
        rotations_rad=first.rotations_rad,
        xi=tuple(record.xi for record in accepted),
        rejected=dict(sorted(Counter(r.reason for r in records if not r.accepted).items())),
        pipeline=dataset.pipeline,
        sampling=dataset.sampling,
    )
