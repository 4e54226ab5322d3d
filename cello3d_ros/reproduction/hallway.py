"""A hallway with regular pillars: ICP locks on to the next ones, and clusters arise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import PAPER
from cello3d_ros.reproduction.result import Result, listing
from cello3d_ros.reproduction.scenes import errors, hallway, kept_of

_PITCH_M = 1.0
_DEVIATIONS = np.array([0.55, 0.2, 0.2, 0.1, 0.1, 0.1])  # of the starts: m, rad


def make(n_samples: int, n_threads: int, seed: int) -> Result:
    """Register from starts that scatter over a few pillars."""
    rng = np.random.default_rng([seed, 5])
    reading, reference = (hallway(rng, 6000, 0.01, _PITCH_M) for _ in range(2))
    starts = rng.normal(size=(n_samples, 6)) * _DEVIATIONS
    xi = errors(reading, reference, starts, PAPER, n_threads, seed)
    kept = kept_of(xi)
    Y, Y_kept = sampled_covariance(xi), sampled_covariance(xi[kept])
    pillar = np.round(xi[:, 0] / _PITCH_M).astype(int)
    on_pillar = np.abs(xi[:, 0] - _PITCH_M * pillar) < 0.1 * _PITCH_M
    shares = {str(k): float(np.mean(on_pillar & (pillar == k))) for k in (-2, -1, 0, 1, 2)}
    axis = np.linalg.eigh(Y[:3, :3])[1][:, -1]
    data = {
        "pitch_m": _PITCH_M,
        "share_at_pillar": shares,
        "covariance_all": Y.tolist(),
        "covariance_kept": Y_kept.tolist(),
        "cosine_leading_axis_hallway": float(abs(axis[0])),
    }
    text = (
        f"A hallway with pillars each {_PITCH_M:g} m; starts deviate by {_DEVIATIONS[0]:g} m "
        f"along it. Of {len(xi)} registrations {shares['0']:.0%} end at the truth, "
        f"{shares['-1']:.0%} and {shares['1']:.0%} one pillar off. The covariance of all of them "
        f"points along the hallway (|cos| {abs(axis[0]):.4f}) with "
        f"{np.sqrt(Y[0, 0]):.2f} m; that of the cluster kept for training has "
        f"{1e3 * np.sqrt(Y_kept[0, 0]):.1f} mm."
    )
    figure = _figure(reading, reference, starts, xi, kept, Y)
    title = "Hallway with regular pillars"
    listed, rows = listing(xi, kept)
    return Result("fig-hallway", title, text, data | listed, rows, figure)


def _figure(
    reading: Cloud,
    reference: Cloud,
    starts: Array,
    xi: Array,
    kept: NDArray[np.bool_],
    Y: Array,
) -> Any:
    figure = drawing.figure(10.0, 6.2)
    plan, counts = figure.subplots(2, 1, height_ratios=(1.0, 1.0))
    shifted = reading.points + [0.35, 0.12, 0.0]  # as a start would have it
    for points, color, label in (
        (reference.points, drawing.BLUE, "reference"),
        (shifted, drawing.RED, "reading at a start"),
    ):
        level = np.abs(points[:, 2]) < 1.1  # without floor and ceiling
        plan.plot(*points[level, :2].T, ".", color=color, markersize=1, alpha=0.6, label=label)
    balls, edges = np.histogram(xi[:, 0], np.arange(-4.025, 4.05, 0.05))
    middle = 0.5 * (edges[1:] + edges[:-1])
    some = balls > 0
    size = 350.0 * balls[some] / balls.max() + 4.0
    plan.scatter(middle[some], np.zeros(some.sum()), s=size, color="black", zorder=3)
    plan.plot([], [], "o", color="black", label="registrations, area by number")
    drawing.ellipse(
        plan, (0, 0), Y[:2, :2], 3.0, color=drawing.GREEN, linewidth=2, label="3σ of all", zorder=4
    )
    plan.set(xlim=(-4, 4), aspect="equal", xlabel="x in m", ylabel="y in m", title="from above")
    legend = plan.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.22), fontsize=8, ncols=4, markerscale=1
    )
    for handle in legend.legend_handles[:2]:
        handle.set_markersize(6)
    _draw_counts(counts, starts, xi, kept)
    return figure


def _draw_counts(counts: Any, starts: Array, xi: Array, kept: NDArray[np.bool_]) -> None:
    bins = np.arange(-3.025, 3.05, 0.05)
    counts.hist(starts[:, 0], bins, color="#cccccc", label="starts")
    counts.hist(xi[~kept, 0], bins, color=drawing.ORANGE, label=f"dropped ({(~kept).sum()})")
    counts.hist(xi[kept, 0], bins, color=drawing.GREEN, label=f"kept ({kept.sum()})")
    counts.set(yscale="log", xlim=(-3, 3), xlabel="x in m", ylabel="registrations")
    counts.set_xticks(range(-3, 4))
    counts.grid(alpha=0.3)
    counts.legend(fontsize=8)
