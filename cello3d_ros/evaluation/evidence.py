"""What an evaluation keeps beside its figures, for people to look at: ``cello3d report``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.evaluation.comparison import Predictions
from cello3d_ros.evaluation.trajectories import Runs
from cello3d_ros.geometry.gaussian import mahalanobis
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.learning.dataset import PairRecord
from cello3d_ros.learning.examples import Examples

#: At which quantiles of D_M^2 the sampled errors are compared with chi-square.
PROBABILITIES = (0.01, *(round(0.05 * k, 2) for k in range(1, 20)), 0.975, 0.99, 0.995)

N_WORST = 6  # pairs shown
_MOST_SAMPLES = 500  # of a pair shown
_MOST_RUNS = 20  # of a trajectory shown


def calibration(
    predictions: Predictions, examples: Examples, keep: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return quantiles of D_M^2 of the sampled errors of all pairs to keep, by method.

    They are those of chi-square with 6 degrees of freedom where covariances hold.
    """
    methods = {}
    for name, F in predictions.covariances.items():
        answered = np.flatnonzero(keep & np.isfinite(F).all(axis=(1, 2)))
        if len(answered):
            dm2 = np.concatenate([mahalanobis(examples.xi[k], F[k]) ** 2 for k in answered])
            methods[name] = [float(q) for q in np.quantile(dm2, PROBABILITIES)]
    return {"probabilities": list(PROBABILITIES), "dm2": methods}


def fits(predictions: Predictions, examples: Examples, pair: int) -> dict[str, float]:
    """Return ``tr(F^-1 Y) / 6`` of one pair by every method that has an answer."""
    Y = examples.covariances[pair]
    return {
        name: float(np.trace(np.linalg.solve(F[pair], Y)) / 6.0)
        for name, F in predictions.covariances.items()
        if np.isfinite(F[pair]).all()
    }


def seen(record: PairRecord, predicted: Array) -> dict[str, Any]:
    """Return a pair as it can be drawn: its samples, which were kept, and both covariances."""
    few = np.linspace(0, len(record.xi) - 1, min(len(record.xi), _MOST_SAMPLES)).astype(int)
    return {
        "recording": record.recording,
        "i": record.i,
        "j": record.j,
        "T_mean": record.T_mean.tolist(),
        "covariance": record.covariance.tolist(),
        "predicted": predicted.tolist(),
        "xi": np.round(record.xi[few], 7).tolist(),
        "kept": record.kept[few].astype(int).tolist(),
    }


def drawn(T_world_sensor: Array, runs: Runs) -> dict[str, Any]:
    """Return the true path and some of the runs, in the frame of the first scan.

    truth: (L, 3) positions.  positions: runs x (L - 1, 3).  covariances: runs x (L - 1, 3, 3) of
    the position along the axes of that frame, m^2.
    """
    truth = (inverse(T_world_sensor[0]) @ T_world_sensor)[:, :3, 3]
    some = runs.paths[:_MOST_RUNS]
    return {
        "truth": np.round(truth, 5).tolist(),
        "positions": [[np.round(pose.T[:3, 3], 5).tolist() for pose in path] for path in some],
        "covariances": [
            [(pose.T[:3, :3] @ pose.Y[:3, :3] @ pose.T[:3, :3].T).tolist() for pose in path]
            for path in some
        ],
    }
