"""Two cylinders: what ICP makes of scattered starts, and which of it is kept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import Array, exp, transform
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import PAPER
from cello3d_ros.reproduction.result import Result, listing
from cello3d_ros.reproduction.scenes import cylinder, errors, kept_of

_DEVIATIONS = np.repeat([0.5, 0.9], 3)  # of the starts: m, rad
_UPSIDE_DOWN_RAD = 3.0


def make(n_samples: int, n_threads: int, seed: int) -> Result:
    """Register from starts wide enough to turn the cylinder over, and cluster the results."""
    icp = replace(PAPER.icp, n_reading_points=500, n_reference_points=1500)
    pipeline = replace(PAPER, icp=icp)
    rng = np.random.default_rng([seed, 4])
    reading, reference = (cylinder(rng, 10_000, 0.01) for _ in range(2))
    starts = rng.normal(size=(n_samples, 6)) * _DEVIATIONS
    xi = errors(reading, reference, starts, pipeline, n_threads, seed)
    kept = kept_of(xi)
    Y = sampled_covariance(xi[kept])
    tilt = np.linalg.norm(xi[:, 3:5], axis=1)
    ring = np.linalg.norm(xi[:, 3:], axis=1) > _UPSIDE_DOWN_RAD
    ring &= tilt > 0.1
    spread = np.sqrt(np.diag(Y))
    data = {
        "n_upside_down": int(ring.sum()),
        "n_upside_down_kept": int((ring & kept).sum()),
        "covariance": Y.tolist(),
        "starts": np.round(starts, 5).tolist(),
    }
    text = (
        f"{len(xi)} registrations of two cylinders of 1 m by 2 m, from starts of "
        f"{_DEVIATIONS[0]:g} m and {_DEVIATIONS[3]:g} rad. {ring.sum()} end upside down, on the "
        f"outer ring: {(ring & kept).sum()} of them are kept. The cluster nearest to the truth "
        f"keeps {kept.sum()} with the free turn about the axis, {spread[5]:.2f} rad, while the "
        f"other angles spread by {1e3 * np.hypot(*spread[3:5]):.1f} mrad and the position by "
        f"{1e3 * np.linalg.norm(spread[:3]):.1f} mm."
    )
    figure = _figure(reading, reference, starts, xi, kept)
    title = "Cylinders: clusters kept and dropped"
    listed, rows = listing(xi, kept)
    return Result("fig-cylinder", title, text, data | listed, rows, figure)


def _figure(
    reading: Cloud, reference: Cloud, starts: Array, xi: Array, kept: NDArray[np.bool_]
) -> Any:
    figure = drawing.figure(8.5, 12.0)
    wrong = np.argmax(np.linalg.norm(starts[:, 3:5], axis=1) * (np.abs(starts[:, 5]) < 0.5))
    thin = slice(None, None, 8)
    for column, (twist, title) in enumerate(
        ((starts[wrong], "a start"), (xi[np.argmax(kept)], "a registration"))
    ):
        axes = figure.add_subplot(3, 2, column + 1, projection="3d")
        for points, color, label in (
            (reference.points, drawing.BLUE, "reference"),
            (transform(exp(twist), reading.points), drawing.RED, "reading"),
        ):
            axes.scatter(*points[thin].T, s=1.5, color=color, alpha=0.5, label=label)
        _style(axes, title, ("x in m", "y in m", "z in m"), 1.5)
        if column == 0:
            axes.legend(loc="upper left", fontsize=8, markerscale=6)
    for row, (part, name, unit, half) in enumerate(
        ((slice(0, 3), "u", "m", 1.5), (slice(3, 6), "ω", "rad", np.pi)), start=1
    ):
        labels = tuple(f"{name}{axis} in {unit}" for axis in "xyz")
        axes = figure.add_subplot(3, 2, 2 * row + 1, projection="3d")
        shown = starts[(np.abs(starts[:, part]) <= half).all(axis=1)][:, part]
        axes.scatter(*shown.T, s=2, color=drawing.GREY, alpha=0.4)
        _style(axes, f"{name} before ICP", labels, half)
        axes = figure.add_subplot(3, 2, 2 * row + 2, projection="3d")
        for mask, color, size, label in (
            (~kept, drawing.ORANGE, 4, f"dropped ({(~kept).sum()})"),
            (kept, drawing.GREEN, 12, f"kept ({kept.sum()})"),
        ):
            shown = xi[mask & (np.abs(xi[:, part]) <= half).all(axis=1)][:, part]
            axes.scatter(*shown.T, s=size, color=color, alpha=0.5, label=label)
        _style(axes, f"{name} after ICP", labels, half)
        axes.legend(loc="upper left", fontsize=8, markerscale=3)
    return figure


def _style(axes: Any, title: str, labels: tuple[str, ...], half: float) -> None:
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-half, half), title=title)
    axes.set(xlabel=labels[0], ylabel=labels[1], zlabel=labels[2])
    ticks = (-1, 0, 1) if half < 2 else (-3, 0, 3)
    axes.set(xticks=ticks, yticks=ticks, zticks=ticks)
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=22, azim=-60)
