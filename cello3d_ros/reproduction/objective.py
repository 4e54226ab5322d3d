"""The objective of point-to-plane ICP around the truth, from afar and from very near."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cello3d_ros.clouds.neighbors import nearest
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig, Pipeline
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import PAPER
from cello3d_ros.reproduction.result import Result
from cello3d_ros.reproduction.scenes import censi_of, cube, errors

SIGMA_M = 0.01
_N_POINTS = 1000
_HALF_WIDTHS_M = (0.5, 0.008, 0.0004)
_N_GRID = 81


def make(n_samples: int, n_threads: int, seed: int) -> Result:
    """Evaluate the objective on three grids and sample ICP with new noise each time."""
    icp = replace(PAPER.icp, n_reading_points=_N_POINTS, n_reference_points=_N_POINTS)
    pipeline = replace(PAPER, icp=icp)
    rng = np.random.default_rng([seed, 1])
    reading, reference = (cube(rng, _N_POINTS, SIGMA_M) for _ in range(2))
    xi = _sampled(n_samples, pipeline, n_threads, seed)
    Y = sampled_covariance(xi)
    C = censi_of(reading, reference, np.eye(4), pipeline, SIGMA_M)
    grids = [_grid(reading, reference, pipeline.icp, half) for half in _HALF_WIDTHS_M]
    data = {
        "sigma_m": SIGMA_M,
        "n_points": _N_POINTS,
        "n_samples": len(xi),
        "half_widths_m": list(_HALF_WIDTHS_M),
        "objective_m2": [np.round(J, 12).tolist() for J in grids],
        "xi": np.round(xi, 7).tolist(),
        "sampled_covariance": Y.tolist(),
        "censi_covariance": C.tolist(),
    }
    deviations = [f"{1e3 * np.sqrt(np.trace(M[:2, :2]) / 2):.2f} mm" for M in (Y, C)]
    text = (
        f"Two clouds of {_N_POINTS} points on a 1 m cube, noise of {SIGMA_M:g} m on each axis; "
        f"the objective J is the mean squared point-to-plane error of the associations that the "
        f"trim keeps, over translations in x and y. From afar it is one basin. Within "
        f"{1e3 * _HALF_WIDTHS_M[2]:g} mm it is plateaus: on each the associations are the same, "
        f"each border is a reassociation. Dots are {len(xi)} registrations, points and noise "
        f"drawn anew for each: deviation {deviations[0]} along x and y, Censi's closed form says "
        f"{deviations[1]}."
    )
    rows = [["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"], *np.round(xi, 7).tolist()]
    title = "Objective of point-to-plane ICP on a cube"
    return Result("fig-objective", title, text, data, rows, _figure(grids, xi, Y, C))


def _grid(reading: Cloud, reference: Cloud, config: IcpConfig, half_width_m: float) -> Array:
    """Return the objective over translations in x and y."""
    steps = np.linspace(-half_width_m, half_width_m, _N_GRID)
    shifts = np.stack([*np.meshgrid(steps, steps, indexing="xy"), np.zeros((_N_GRID,) * 2)], -1)
    J = [objective(reading.points + t, reference, config) for t in shifts.reshape(-1, 3)]
    return np.reshape(J, (_N_GRID, _N_GRID))


def objective(moved: Array, reference: Cloud, config: IcpConfig) -> float:
    """Return the mean squared point-to-plane error of the kept associations, as ICP has it."""
    distances2, indices = nearest(reference.tree, moved, config.n_neighbors)
    rank = min(int(distances2.size * config.trim_ratio), distances2.size - 1)
    kept = distances2 <= np.partition(distances2, rank, axis=None)[rank]
    offsets = moved[:, None] - reference.points[indices]
    r = np.einsum("nki,nki->nk", offsets, reference.normals[indices])
    return float(np.mean(r[kept] ** 2))


def _sampled(n_samples: int, pipeline: Pipeline, n_threads: int, seed: int) -> Array:
    found = []
    for k in range(n_samples):
        rng = np.random.default_rng([seed, 2, k])
        reading, reference = (cube(rng, _N_POINTS, SIGMA_M) for _ in range(2))
        start = rng.normal(scale=np.sqrt(0.05), size=(1, 6))
        found.append(errors(reading, reference, start, pipeline, n_threads, seed))
    xi = np.concatenate(found)
    near = np.linalg.norm(xi[:, :3], axis=1) < 0.25  # a cube fits itself in 24 ways
    return np.asarray(xi[near & (np.linalg.norm(xi[:, 3:], axis=1) < 0.5)])


def _figure(grids: list[Array], xi: Array, Y: Array, C: Array) -> Any:
    figure = drawing.figure(13.0, 4.3)
    units = ((1.0, "m"), (1e3, "mm"), (1e6, "µm"))
    for k, (J, half, (scale, unit)) in enumerate(zip(grids, _HALF_WIDTHS_M, units, strict=True)):
        axes = figure.add_subplot(1, 3, k + 1)
        side = scale * half
        step = 2 * side / (_N_GRID - 1)
        edge = side + step / 2
        J_unit, name = (1e4, "cm²") if k == 0 else (1e6, "mm²")
        image = axes.imshow(
            J_unit * J, origin="lower", extent=(-edge, edge, -edge, edge), cmap="viridis"
        )
        figure.colorbar(image, ax=axes, label=f"J in {name}", shrink=0.85)
        if k < 2:
            x, y = scale * xi[:, 0], scale * xi[:, 1]
            axes.plot(x, y, ".", color="black", markersize=3, alpha=0.6, label="registrations")
            for M, style, label in (
                (Y, {"color": "#5fe05f", "linewidth": 1.8}, "3σ, sampled"),
                (C, {"color": "white", "linewidth": 1.8, "linestyle": "--"}, "3σ, Censi"),
            ):
                drawing.ellipse(axes, (0, 0), scale**2 * M[:2, :2], 3.0, label=label, **style)
        if k == 1:
            axes.legend(loc="upper right", fontsize=8, facecolor="#b8c4cc", framealpha=0.95)
        axes.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal")
        axes.set(xlabel=f"x in {unit}", ylabel=f"y in {unit}", title=f"± {side:g} {unit}")
    return figure
