"""The loss of Theta and its gradient (Sec. IV-B of the paper).

For a target k the model predicts, from the examples j of OTHER recordings only,

    F_k = (1 - w) sum_j s_kj Y_j + w mean_j Y_j,   s_kj proportional to exp(-|Theta (x_k - x_j)|^2)

and the loss is the mean over targets of ``log det F_k + tr(F_k^-1 Y_k)``.  Targets are the pairs
as they were recorded; the examples are those and their copies turned about z, as in the finished
model.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from cello3d_ros.config import TrainingConfig
from cello3d_ros.covariance.heading import blended
from cello3d_ros.covariance.sums import TWICE, pack, unpack
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.examples import (
    Examples,
    Indices,
    examples_of,
    flat_features,
    motions_of,
    targets_of,
    unturned_rows,
)

_BLOCK = 512  # targets at once, bounds memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Targets, and the examples from which each may be predicted: those of another group.

    X: (K, D) standardised features.  Y: (K, 6, 6).  groups: (K,).  The same of the M examples,
    with covariances packed (M, 21).  means: (K, 21), of the examples each target may see.
    motions: (K, 2) along which targets and predictions lie, or None in the frame of the sensor.
    """

    X: Array
    Y: Array
    groups: Indices
    X_examples: Array
    packed_examples: Array
    groups_examples: Indices
    means: Array
    mean_weight: float
    motions: Array | None = None


def leave_out_problem(
    examples: Examples, config: TrainingConfig, mean: Array, scale: Array
) -> Problem:
    """Return the problem of predicting each pair from the other recordings."""
    n_rotations = len(examples.rotations_rad)
    groups = np.unique(examples.groups, return_inverse=True)[1].astype(np.intp)
    packed = pack(examples_of(examples, config.shape, config.frame))
    groups_examples = np.repeat(groups, n_rotations)
    others = [packed[groups_examples != group].mean(axis=0) for group in range(groups.max() + 1)]
    X = (flat_features(examples) - mean) / scale
    return Problem(
        X=X[unturned_rows(examples)],
        Y=targets_of(examples, config.shape, config.frame),
        motions=motions_of(examples, config.frame),
        groups=groups,
        X_examples=X,
        packed_examples=packed,
        groups_examples=groups_examples,
        means=np.array(others)[groups],
        mean_weight=config.mean_weight,
    )


def validation_problem(
    problem: Problem, validation: Examples, config: TrainingConfig, mean: Array, scale: Array
) -> Problem:
    """Return the problem of predicting other recordings from all examples of ``problem``."""
    Y = targets_of(validation, config.shape, config.frame)
    return dataclasses.replace(
        problem,
        X=((flat_features(validation) - mean) / scale)[unturned_rows(validation)],
        Y=Y,
        motions=motions_of(validation, config.frame),
        groups=np.full(len(Y), -1),
        means=np.tile(problem.packed_examples.mean(axis=0), (len(Y), 1)),
    )


def select_features(problem: Problem, active: Indices) -> Problem:
    """Return the problem over some of the features."""
    return dataclasses.replace(
        problem,
        X=np.ascontiguousarray(problem.X[:, active]),
        X_examples=np.ascontiguousarray(problem.X_examples[:, active]),
    )


def select_targets(problem: Problem, rows: Indices) -> Problem:
    """Return the problem of predicting some of the targets, from all examples."""
    chosen = {name: getattr(problem, name)[rows] for name in ("X", "Y", "groups", "means")}
    if problem.motions is not None:
        chosen["motions"] = problem.motions[rows]
    return dataclasses.replace(problem, **chosen)


def expand_features(theta: Array, active: Indices, n_features: int) -> Array:
    """Return Theta (r, D) over all features; a triangular one goes without its empty rows."""
    if theta.ndim == 1:
        theta = np.diag(theta)
    full = np.zeros((len(theta), n_features))
    full[:, active] = theta
    return full


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
        losses, G = pair_losses(_mixed(s, problem, block), problem.Y[block], loss)
        total += losses.sum()
        G = _blended(G, problem, block)
        g = (pack(G) * TWICE) @ problem.packed_examples.T
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


def nearest_rho(theta: Array, problem: Problem) -> Array:
    """Return the rho of each target's nearest example.  (K,)."""
    P_examples = _projected(problem.X_examples, theta)
    nearest = []
    for block in _blocks(len(problem.X)):
        P = _projected(problem.X[block], theta)
        s = _weights(P, P_examples, problem, block)
        offset = P - P_examples[s.argmax(axis=1)]
        nearest.append(np.einsum("kr,kr->k", offset, offset))
    return np.concatenate(nearest)


def pair_losses(F: Array, Y: Array, loss: str) -> tuple[Array, Array]:
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
    F = unpack((1.0 - w) * (s @ problem.packed_examples) + w * problem.means[block])
    return _blended(F, problem, block)


def _blended(A: Array, problem: Problem, block: slice) -> Array:
    """Return what of A is left where targets have little motion; it is its own adjoint."""
    return A if problem.motions is None else blended(A, problem.motions[block])


def _projected(X: Array, theta: Array) -> Array:
    return np.asarray(X * theta if theta.ndim == 1 else X @ theta.T)


def _outer(A: Array, X: Array, theta: Array) -> Array:
    """Return ``A^T X``, or its diagonal where Theta is one."""
    return np.asarray(np.einsum("kd,kd->d", A, X) if theta.ndim == 1 else A.T @ X)


def _blocks(n: int) -> list[slice]:
    return [slice(start, start + _BLOCK) for start in range(0, n, _BLOCK)]


def median_rho(problem: Problem, theta: Array) -> float:
    """Return the median distance of targets to examples of other groups, some of each."""
    some, few = (
        np.linspace(0, n - 1, min(n, 500), dtype=np.intp)
        for n in (len(problem.X), len(problem.X_examples))
    )
    P, Q = _projected(problem.X[some], theta), _projected(problem.X_examples[few], theta)
    rho = (P**2).sum(axis=1)[:, None] + (Q**2).sum(axis=1) - 2.0 * P @ Q.T
    others = problem.groups[some, None] != problem.groups_examples[few]
    return float(np.median(rho[others])) if others.any() else 0.0
