"""The covariance of ICP over sensor noise: sampled, and by Censi's closed form."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cello3d_ros.config import SamplingConfig
from cello3d_ros.evaluation.online import prepared
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.sampling import sample_recording
from cello3d_ros.reproduction import drawing
from cello3d_ros.reproduction.datasets import PAPER
from cello3d_ros.reproduction.result import Result, markdown_table
from cello3d_ros.reproduction.scenes import censi_of, cube, errors
from cello3d_ros.reproduction.sequences import counterpart

SIGMAS_M = (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05)
_N_POINTS = 1000
_SCENES = {"cube": "1 m cube", "apartment": "simulated apartment"}


def make(n_samples: int, n_threads: int, seed: int) -> Result:
    """Sample a cube and a pair of an apartment at each noise."""
    measured = {
        "cube": [_cube(sigma, n_samples, n_threads, seed) for sigma in SIGMAS_M],
        "apartment": [_apartment(sigma, n_samples, n_threads, seed) for sigma in SIGMAS_M],
    }
    rows: list[list[Any]] = [["scene", "sigma_m", "block", "sampled", "censi"]]
    for scene, pairs in measured.items():
        for sigma, (Y, C) in zip(SIGMAS_M, pairs, strict=True):
            for block, part in (("u_m2", slice(0, 3)), ("omega_rad2", slice(3, 6))):
                traces = [float(np.trace(M[part, part])) for M in (Y, C)]
                rows.append([scene, sigma, block, *traces])
    data = {"n_samples": n_samples, "rows": [dict(zip(rows[0], row)) for row in rows[1:]]}
    text = (
        "Trace of the covariance of the translation. Cube: points and noise of every "
        "registration are drawn anew, on each axis. Apartment: one pair of simulated scans with "
        "range noise, registered from scattered starts with subsamples drawn anew; sampled "
        "covariances are about the truth.\n\n" + markdown_table(_table(rows))
    )
    title = "Covariance over sensor noise"
    return Result("fig-noise", title, text, data, rows, _figure(measured))


def _cube(sigma_m: float, n_samples: int, n_threads: int, seed: int) -> tuple[Array, Array]:
    found = []
    for k in range(n_samples):
        rng = np.random.default_rng([seed, 3, k])  # the same points and starts at each noise
        reading, reference = (cube(rng, _N_POINTS, sigma_m) for _ in range(2))
        start = rng.normal(scale=0.05, size=(1, 6))
        found.append(errors(reading, reference, start, PAPER, n_threads, seed))
    C = censi_of(reading, reference, np.eye(4), PAPER, sigma_m)
    return sampled_covariance(np.concatenate(found)), C


def _apartment(sigma_m: float, n_samples: int, n_threads: int, seed: int) -> tuple[Array, Array]:
    recording = counterpart("apartment", 0, 2)
    recording = replace(recording, scanner=replace(recording.scanner, range_noise_m=sigma_m))
    sampling = SamplingConfig(n_samples=n_samples, seed=seed)
    (record,) = sample_recording(recording, [(0, 1)], PAPER, sampling, n_threads)
    clouds, _ = prepared(recording, PAPER, [0, 1], seed)
    C = censi_of(clouds[1], clouds[0], record.T_mean, PAPER, sigma_m)
    return sampled_covariance(record.xi[record.kept]), C


def _table(rows: list[list[Any]]) -> list[list[str]]:
    found = {(r[0], r[1]): r[3:] for r in rows[1:] if r[2] == "u_m2"}
    heading = ["noise (m)"]
    for name in _SCENES.values():
        heading += [f"{name}: sampled (m²)", "Censi (m²)", "ratio"]
    table = [heading]
    for sigma in SIGMAS_M:
        row = [f"{sigma:g}"]
        for scene in _SCENES:
            sampled, closed = found[scene, sigma]
            row += [f"{sampled:.2g}", f"{closed:.2g}", f"{sampled / closed:.2g}"]
        table.append(row)
    return table


def _figure(measured: dict[str, list[tuple[Array, Array]]]) -> Any:
    figure = drawing.figure(10.0, 4.2)
    first = None
    for k, (scene, pairs) in enumerate(measured.items()):
        axes = figure.add_subplot(1, 2, k + 1, sharey=first)
        first = first or axes
        for which, label, color, marker in (
            (0, "sampled", drawing.BLUE, "o"),
            (1, "Censi", drawing.RED, "s"),
        ):
            traces = [np.trace(pair[which][:3, :3]) for pair in pairs]
            axes.loglog(SIGMAS_M, traces, marker=marker, color=color, label=label)
        axes.set(title=_SCENES[scene], xlabel="sensor noise σ in m")
        axes.set_xticks(SIGMAS_M, [f"{s:g}" for s in SIGMAS_M])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        if k == 0:
            axes.set_ylabel("trace of the covariance of u in m²")
            axes.legend()
    return figure
