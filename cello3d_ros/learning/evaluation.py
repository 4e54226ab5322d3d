"""How good predicted covariances are, beside constants."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from cello3d_ros.config import TrainingConfig
from cello3d_ros.geometry.gaussian import kl, mahalanobis
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.examples import Examples, to_absolute, to_relative
from cello3d_ros.learning.loss import Problem, predicted

Figures = dict[str, dict[str, float]]  # predictor -> measure -> value


def evaluate(
    problem: Problem, theta: Array, examples: Examples, targets: Examples, config: TrainingConfig
) -> Figures:
    """Judge the model and two constants on the targets of ``problem``.

    mean_covariance is the mean of the absolute covariances (the paper's baseline), of other
    recordings as they were recorded; constant_relative is that of the relative ones.
    """
    relative = to_relative(examples, config.shape)
    names = np.unique(targets.groups)
    absolute_means, relative_means = (
        {name: Y[examples.groups != name].mean(axis=0) for name in names}
        for Y in (examples.covariances, relative)
    )
    constant = np.array([relative_means[name] for name in targets.groups])
    F = {
        "model": to_absolute(predicted(theta, problem), targets, config.shape),
        "mean_covariance": np.array([absolute_means[name] for name in targets.groups]),
        "constant_relative": to_absolute(constant, targets, config.shape),
    }
    return {name: measure(Fs, targets) for name, Fs in F.items()}


def measure(F: Array, targets: Examples) -> dict[str, float]:
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
