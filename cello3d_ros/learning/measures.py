"""How good predicted covariances are, beside constants."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cello3d_ros.config import TrainingConfig
from cello3d_ros.covariance.heading import blended
from cello3d_ros.geometry.gaussian import kl, mahalanobis
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.examples import Examples, targets_of, to_absolute
from cello3d_ros.learning.loss import Problem, predicted

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
_PARTS = {"translation": slice(0, 3), "rotation": slice(3, 6)}
_TOO_SMALL, _TOO_LARGE = 1.3, 0.8  # D_M^2 / 6 beyond which a covariance has a wrong size

#: A pair whose converged registrations are off by more than both is suspected of a wrong pose.
FLAG_OFFSET_M, FLAG_OFFSET_RAD, FLAG_SIGMAS = 0.05, 0.02, 3.0


@dataclass(frozen=True, kw_only=True)
class Marginal:
    """How the translation or the rotation of a method's covariances fits: as in ``Figures``."""

    dm2_over_3: float
    coverage_95: float | None = None


@dataclass(frozen=True, kw_only=True)
class Figures:
    """How good one method's covariances are over pairs; None where there is nothing to say.

    kl_mean, kl_median, kl_trimmed_mean (without the worst 10 % of the pairs), kl_90 (the 90 %
    quantile): divergence from the sampled covariance; kl_ratio, kl_median_ratio,
    kl_trimmed_ratio: over that of the baseline on the same pairs.
    dm2_over_6: mean of tr(F^-1 Y) / 6, 1 if F is right on average, above if F is too small, which
    ``verdict`` says in words.
    coverage_95: share of sampled errors within the 95 % ellipsoid; coverage: at ``LEVELS``.
    n_failed: pairs without an answer; ms_per_pair: processor time; icp_runs: extra registrations
    of a pair; scale: what a method with ``_scaled`` in its name was multiplied by.
    """

    n_pairs: int
    kl_mean: float | None = None
    kl_median: float | None = None
    kl_trimmed_mean: float | None = None
    kl_90: float | None = None
    kl_ratio: float | None = None
    kl_median_ratio: float | None = None
    kl_trimmed_ratio: float | None = None
    dm2_over_6: float | None = None
    verdict: str = ""
    coverage_95: float | None = None
    coverage: list[float] = dataclasses.field(default_factory=list)
    translation: Marginal | None = None
    rotation: Marginal | None = None
    n_failed: int = 0
    ms_per_pair: float | None = None
    icp_runs: int = 0
    scale: float | None = None


@dataclass(frozen=True, kw_only=True)
class PoseCheck:
    """The offset of a pair's registrations from ground truth beside their scatter."""

    offset_m: float
    scatter_m: float
    offset_rad: float
    scatter_rad: float
    flagged: bool


def verdict(ratio: float) -> str:
    """Say in words what a mean of squared errors over those that were claimed means."""
    if ratio > _TOO_SMALL:
        return f"too small: multiply by {ratio:.2g}"
    return f"too large: multiply by {ratio:.2g}" if ratio < _TOO_LARGE else "about right"


def evaluate(
    problem: Problem, theta: Array, examples: Examples, targets: Examples, config: TrainingConfig
) -> dict[str, Figures]:
    """Judge the model and two constants on the targets of ``problem``.

    mean_covariance is the mean of the absolute covariances (the paper's baseline), of other
    recordings as they were recorded; constant is that of the relative ones.
    """
    relative = targets_of(examples, config.shape, config.frame)
    names = np.unique(targets.groups)
    absolute_means, relative_means = (
        {name: Y[examples.groups != name].mean(axis=0) for name in names}
        for Y in (examples.covariances, relative)
    )
    constant = np.array([relative_means[name] for name in targets.groups])
    kind = config.shape, config.frame
    if problem.motions is not None:
        constant = blended(constant, problem.motions)
    F = {
        "cello3d": to_absolute(config.margin * predicted(theta, problem), targets, *kind),
        "mean_covariance": np.array([absolute_means[name] for name in targets.groups]),
        "constant": to_absolute(constant, targets, *kind),
    }
    return {name: figures(Fs, targets) for name, Fs in F.items()}


def figures(F: Array, targets: Examples, baseline: Array | None = None) -> Figures:
    """Return what there is to say of one method on the same pairs as the others.

    F: (N, 6, 6), NaN where the method has no answer: those pairs enter no figure.
    baseline: (N, 6, 6), to whose KL on the pairs that the method answered it is compared.
    """
    has = np.isfinite(F).all(axis=(1, 2))
    if not has.any():
        return Figures(n_pairs=0)
    Y, F = targets.covariances[has], F[has]
    xi = [targets.xi[k] for k in np.flatnonzero(has)] if targets.xi else []
    ours = _summary(kl(Y, F))
    ratios: dict[str, Any] = {}
    if baseline is not None:
        theirs = _summary(kl(Y, baseline[has]))
        for name in ("kl", "kl_median", "kl_trimmed"):
            key = name if name == "kl_median" else f"{name}_mean"
            ratios[f"{name}_ratio"] = ours[key] / theirs[key]
    dm2 = float(_normalized(F, Y).mean())
    translation, rotation = (
        Marginal(
            dm2_over_3=float(_normalized(F[:, axes, axes], Y[:, axes, axes]).mean()),
            coverage_95=_coverage_95(F[:, axes, axes], [x[:, axes] for x in xi]),
        )
        for axes in _PARTS.values()
    )
    return Figures(
        n_pairs=len(F),
        **ours,
        **ratios,
        dm2_over_6=dm2,
        verdict=verdict(dm2),
        coverage_95=_coverage_95(F, xi),
        coverage=_coverages(F, xi, LEVELS) if xi else [],
        translation=translation,
        rotation=rotation,
    )


def best_scale(F: Array, targets: Examples) -> float:
    """Return the c with the least mean KL of ``c F`` on these very pairs: mean tr(F^-1 Y) / 6.

    It is fitted to the answers, hence more than the method could know.
    """
    has = np.isfinite(F).all(axis=(1, 2))
    if not has.any():
        return 1.0
    return float(_normalized(F[has], targets.covariances[has]).mean())


def pose_check(xi: Array) -> PoseCheck:
    """Compare the offset of a pair's converged registrations from ground truth to their scatter.

    xi: (n, 6), errors about ground truth.  offset_m, offset_rad: norms of their mean; scatter_m,
    scatter_rad: roots of the traces of their covariance about it.  The rule: ``flagged`` where
    the offset is above 0.05 m and 3 scatters in translation, or above 0.02 rad and 3 scatters in
    rotation.  Registrations that agree with each other but not with the pose, by more than a
    reference pose may be off, are evidence against the pose where poses come from a survey or
    SLAM; where they are exact (simulation) they are ICP's own bias, and nothing is to be flagged.
    """
    mean, spread = xi.mean(axis=0), xi.std(axis=0, ddof=1)
    offset_m, offset_rad = (float(np.linalg.norm(mean[part])) for part in _PARTS.values())
    scatter_m, scatter_rad = (float(np.linalg.norm(spread[part])) for part in _PARTS.values())
    return PoseCheck(
        offset_m=offset_m,
        scatter_m=scatter_m,
        offset_rad=offset_rad,
        scatter_rad=scatter_rad,
        flagged=offset_m > max(FLAG_OFFSET_M, FLAG_SIGMAS * scatter_m)
        or offset_rad > max(FLAG_OFFSET_RAD, FLAG_SIGMAS * scatter_rad),
    )


def select(examples: Examples, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Examples:
    """Return some of the pairs.  keep: (N,) whether to keep each, or the numbers of some."""
    rows = np.arange(len(examples.groups))[keep]

    def some(known: NDArray[Any]) -> NDArray[Any]:  # of what is known of all pairs or of none
        return known[rows] if len(known) else known

    return dataclasses.replace(
        examples,
        features=examples.features[rows],
        global_features=some(examples.global_features),
        motions=examples.motions[rows],
        covariances=examples.covariances[rows],
        groups=examples.groups[rows],
        shapes={name: S[rows] for name, S in examples.shapes.items()},
        scans=some(examples.scans),
        T_mean=some(examples.T_mean),
        xi=tuple(examples.xi[k] for k in rows) if examples.xi else (),
    )


def _summary(divergence: Array) -> dict[str, Any]:
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


def _coverage_95(F: Array, xi: Sequence[Array]) -> float | None:
    return _coverages(F, xi, (0.95,))[0] if xi else None


def _coverages(F: Array, xi: Sequence[Array], levels: Sequence[float]) -> list[float]:
    """Return the mean share of each pair's errors within the ellipsoid of each level."""
    limits = np.sqrt(chdtri(F.shape[-1], 1.0 - np.array(levels)))
    inside = [
        (mahalanobis(x, F_k)[:, None] <= limits).mean(axis=0) for x, F_k in zip(xi, F, strict=True)
    ]
    return [float(share) for share in np.mean(inside, axis=0)]
