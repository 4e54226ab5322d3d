"""How good predicted covariances are, beside constants."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cello3d_ros.config import TrainingConfig
from cello3d_ros.geometry.gaussian import kl, mahalanobis
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.examples import Examples, to_absolute, to_relative
from cello3d_ros.learning.loss import Problem, predicted

Figures = dict[str, dict[str, float]]  # predictor -> measure -> value

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
_PARTS = {"translation": slice(0, 3), "rotation": slice(3, 6)}
_TOO_SMALL, _TOO_LARGE = 1.3, 0.8  # D_M^2 / 6 beyond which a covariance has a wrong size

#: A pair whose converged registrations are off by more than both is suspected of a wrong pose.
FLAG_OFFSET_M, FLAG_OFFSET_RAD, FLAG_SIGMAS = 0.05, 0.02, 3.0


def evaluate(
    problem: Problem, theta: Array, examples: Examples, targets: Examples, config: TrainingConfig
) -> Figures:
    """Judge the model and two constants on the targets of ``problem``.

    mean_covariance is the mean of the absolute covariances (the paper's baseline), of other
    recordings as they were recorded; constant is that of the relative ones.
    """
    relative = to_relative(examples, config.shape)
    names = np.unique(targets.groups)
    absolute_means, relative_means = (
        {name: Y[examples.groups != name].mean(axis=0) for name in names}
        for Y in (examples.covariances, relative)
    )
    constant = np.array([relative_means[name] for name in targets.groups])
    F = {
        "model": to_absolute(config.margin * predicted(theta, problem), targets, config.shape),
        "mean_covariance": np.array([absolute_means[name] for name in targets.groups]),
        "constant": to_absolute(constant, targets, config.shape),
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


def figures(F: Array, targets: Examples, baseline: Array | None = None) -> dict[str, Any]:
    """Return everything to report of one method on the same pairs as the others.

    F: (N, 6, 6), NaN where the method has no answer: those pairs enter no figure.
    baseline: (N, 6, 6); ``kl_ratio``, ``kl_median_ratio`` and ``kl_trimmed_ratio`` compare with
    its KL on the pairs that the method answered.
    dm2_over_6 is the mean of tr(F^-1 Y) / 6, 1 if F is right on average, above if F is too small;
    coverage_95 the share of sampled errors within the 95 % ellipsoid; coverage the same at
    ``LEVELS``; translation and rotation the marginals, dm2_over_3 in place of dm2_over_6.
    """
    has = np.isfinite(F).all(axis=(1, 2))
    if not has.any():
        return {"n_pairs": 0}
    Y, F, xi = targets.covariances[has], F[has], [targets.xi[k] for k in np.flatnonzero(has)]
    divergence = kl(Y, F)
    report: dict[str, Any] = {"n_pairs": len(F), **_summary(divergence), **_calibration(F, Y, xi)}
    report["direction"] = _direction(report["dm2_over_6"])
    report["coverage"] = _coverages(F, xi, LEVELS)
    for name, part in _PARTS.items():
        marginal = [x[:, part] for x in xi]
        report[name] = _calibration(F[:, part, part], Y[:, part, part], marginal)
    if baseline is not None:
        theirs = _summary(kl(Y, baseline[has]))
        report["kl_ratio"] = report["kl_mean"] / theirs["kl_mean"]
        report["kl_median_ratio"] = report["kl_median"] / theirs["kl_median"]
        report["kl_trimmed_ratio"] = report["kl_trimmed_mean"] / theirs["kl_trimmed_mean"]
    return report


def best_scale(F: Array, targets: Examples) -> float:
    """Return the c with the least mean KL of ``c F`` on these very pairs: mean tr(F^-1 Y) / 6.

    It is fitted to the answers, hence more than the method could know.
    """
    has = np.isfinite(F).all(axis=(1, 2))
    if not has.any():
        return 1.0
    return float(_normalized(F[has], targets.covariances[has]).mean())


def pose_check(xi: Array) -> dict[str, Any]:
    """Compare the offset of a pair's converged registrations from ground truth to their scatter.

    xi: (n, 6), errors about ground truth.  offset_m, offset_rad: norms of their mean; scatter_m,
    scatter_rad: roots of the traces of their covariance about it.  The rule: ``flagged`` where
    the offset is above 0.05 m and 3 scatters in translation, or above 0.02 rad and 3 scatters in
    rotation.  Registrations that agree with each other but not with the pose, by more than a
    reference pose may be off, are evidence against the pose where poses come from a survey or
    SLAM; where they are exact (simulation) they are ICP's own bias, and nothing is to be flagged.
    """
    mean, spread = xi.mean(axis=0), xi.std(axis=0, ddof=1)
    check: dict[str, Any] = {"flagged": False}
    for unit, part, limit in (
        ("m", _PARTS["translation"], FLAG_OFFSET_M),
        ("rad", _PARTS["rotation"], FLAG_OFFSET_RAD),
    ):
        offset = float(np.linalg.norm(mean[part]))
        scatter = float(np.linalg.norm(spread[part]))
        check |= {f"offset_{unit}": offset, f"scatter_{unit}": scatter}
        check["flagged"] |= offset > max(limit, FLAG_SIGMAS * scatter)
    return check


def select(examples: Examples, keep: NDArray[np.bool_]) -> Examples:
    """Return some of the pairs.  keep: (N,)."""
    return dataclasses.replace(
        examples,
        features=examples.features[keep],
        global_features=examples.global_features[keep[: len(examples.global_features)]],
        covariances=examples.covariances[keep],
        groups=examples.groups[keep],
        shapes={name: S[keep] for name, S in examples.shapes.items()},
        xi=tuple(xi for xi, kept in zip(examples.xi, keep, strict=True) if kept),
    )


def _summary(divergence: Array) -> dict[str, float]:
    """Return mean, median, mean without the worst 10 %, and 90 % quantile."""
    ordered = np.sort(divergence)
    return {
        "kl_mean": float(ordered.mean()),
        "kl_median": float(np.median(ordered)),
        "kl_trimmed_mean": float(ordered[: max(1, int(0.9 * len(ordered)))].mean()),
        "kl_90": float(np.quantile(ordered, 0.9)),
    }


def _normalized(F: Array, Y: Array) -> Array:
    """Return ``tr(F^-1 Y) / d`` of each pair."""
    return np.asarray(np.trace(np.linalg.solve(F, Y), axis1=1, axis2=2) / F.shape[-1])


def _calibration(F: Array, Y: Array, xi: list[Array]) -> dict[str, float]:
    d = F.shape[-1]
    return {
        f"dm2_over_{d}": float(_normalized(F, Y).mean()),
        "coverage_95": _coverages(F, xi, (0.95,))[0],
    }


def _coverages(F: Array, xi: list[Array], levels: Sequence[float]) -> list[float]:
    """Return the mean share of each pair's errors within the ellipsoid of each level."""
    limits = np.sqrt(chdtri(F.shape[-1], 1.0 - np.array(levels)))
    inside = [
        (mahalanobis(x, F_k)[:, None] <= limits).mean(axis=0) for x, F_k in zip(xi, F, strict=True)
    ]
    return [float(share) for share in np.mean(inside, axis=0)]


def _direction(dm2: float) -> str:
    if dm2 > _TOO_SMALL:
        return "too small"
    return "too large" if dm2 < _TOO_LARGE else "right"
