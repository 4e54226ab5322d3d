"""ICP odometry over a recording, and whether its compounded covariance holds (Sec. V-C, VI-B)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.covariance.case import DEFAULTS
from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import RegistrationError
from cello3d_ros.evaluation.result import Consistency, Distances, Paths
from cello3d_ros.geometry.gaussian import (
    INDEPENDENT,
    Bias,
    Chained,
    GaussianPose,
    extended,
    mahalanobis,
)
from cello3d_ros.geometry.se3 import Array, exp, inverse, log
from cello3d_ros.learning.clustering import far_from_truth
from cello3d_ros.learning.measures import verdict

_MOST_SHOWN = 20  # runs of a trajectory that are drawn


class Runs(NamedTuple):
    """Final errors of odometry over one recording and the covariances that it claims.

    xi: (n, 6), ``log(T_true^-1 T_final)``; Y: (n, 6, 6), right; lost: (n,), whether a registration
    of the run ended in another minimum; told: (n,), whether the model said so of one; n_failed:
    runs in which one had no answer.
    paths: for each of the n, the pose at every scan but the first, in the frame of the first.
    """

    xi: Array
    Y: Array
    lost: NDArray[np.bool_]
    told: NDArray[np.bool_]
    n_failed: int
    paths: tuple[list[GaussianPose], ...] = ()


class _Run(NamedTuple):
    """The steps of one odometry, whether it got lost and whether the model said so."""

    steps: list[GaussianPose]
    is_lost: bool
    is_told: bool


def odometry_runs(
    clouds: Sequence[Cloud],
    T_world_sensor: Array,
    model: Model,
    n_runs: int,
    seed: int = 0,
    n_threads: int = 1,
) -> Runs:
    """Register consecutive scans from the first to the last, n_runs times.

    T_world_sensor: (L, 4, 4) ground truth.  Each registration of each run starts from
    ``T_mean exp(xi)``, xi ~ N(0, model.sampling.variance I), draws its own subsamples and has its
    own covariance predicted.  A run does not depend on the others or on the threads.  Covariances
    are compounded with the bias that neighbouring steps share.
    """
    runs = _runs(clouds, T_world_sensor, [model], n_runs, seed, n_threads)
    return _stacked(runs, 0, T_world_sensor, model.bias)


def runs_of_models(
    clouds: Sequence[Cloud],
    T_world_sensor: Array,
    models: Sequence[Model],
    n_runs: int,
    seed: int = 0,
    n_threads: int = 1,
) -> list[Runs]:
    """Return the same runs judged by each of some models that have one pipeline.

    Starts scatter as in the sampling of the first.  Each compounds steps with its own bias.
    """
    runs = _runs(clouds, T_world_sensor, models, n_runs, seed, n_threads)
    return [_stacked(runs, k, T_world_sensor, model.bias) for k, model in enumerate(models)]


def _runs(
    clouds: Sequence[Cloud],
    T_world_sensor: Array,
    models: Sequence[Model],
    n_runs: int,
    seed: int,
    n_threads: int,
) -> list[list[_Run] | None]:
    """Return for each run what each model makes of it, None without an answer."""

    def one(run: int) -> list[_Run] | None:
        return _run(clouds, T_world_sensor, models, np.random.default_rng([seed, run]))

    if n_threads <= 1:
        return [one(run) for run in range(n_runs)]
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(one, range(n_runs)))


def _stacked(
    runs: Sequence[list[_Run] | None],
    k: int,
    T_world_sensor: Array,
    bias: Bias,
) -> Runs:
    """Return what the k-th model makes of the runs."""
    reached = [run[k] for run in runs if run is not None]
    paths = tuple(compound_path(run.steps, bias) for run in reached)
    T_true = inverse(T_world_sensor[0]) @ T_world_sensor[-1]
    xi = log(inverse(T_true) @ np.array([path[-1].T for path in paths]).reshape(-1, 4, 4))
    Y = np.array([path[-1].Y for path in paths]).reshape(-1, 6, 6)
    lost = np.array([run.is_lost for run in reached], np.bool_)
    told = np.array([run.is_told for run in reached], np.bool_)
    return Runs(xi, Y, lost, told, len(runs) - len(reached), paths)


def compound_path(steps: Sequence[GaussianPose], bias: Bias = INDEPENDENT) -> list[GaussianPose]:
    """Return the pose after each step, right covariance, with the bias that steps share."""
    chain, path = Chained.start(np.eye(4)), []
    for step in steps:
        chain = extended(chain, step, bias)
        path.append(chain.pose)
    return path


def consistency(runs: Runs) -> Consistency:
    """Judge the final poses of runs by the covariances that they claim.

    Translation and rotation are judged by their own blocks.  A run is lost where a registration
    ended more than 3 clustering scales from the truth (0.3 m or 0.15 rad): no covariance of one
    minimum covers that.
    Source: Table II of the paper, which has all runs.
    """
    near = _distances(runs.xi[~runs.lost], runs.Y[~runs.lost])
    return Consistency(
        n_runs=len(runs.xi),
        n_failed=runs.n_failed,
        n_lost=int(runs.lost.sum()),
        n_told=int(runs.told.sum()),
        n_lost_told=int((runs.lost & runs.told).sum()),
        without_lost=near,
        **vars(_distances(runs.xi, runs.Y)),
    )


def _distances(xi: Array, Y: Array) -> Distances:
    if len(xi) == 0:
        return Distances()
    joint = mahalanobis(xi, Y)
    nees_over_6 = float(np.mean(joint**2)) / 6.0
    return Distances(
        dm_6dof=float(joint.mean()),
        dm_translation=float(mahalanobis(xi[:, :3], Y[:, :3, :3]).mean()),
        dm_rotation=float(mahalanobis(xi[:, 3:], Y[:, 3:, 3:]).mean()),
        dm_6dof_median=float(np.median(joint)),
        nees_over_6=nees_over_6,
        verdict=verdict(nees_over_6),
        coverage_95=float(np.mean(joint**2 <= chdtri(6, 0.05))),
        error_m=float(np.linalg.norm(xi[:, :3], axis=1).mean()),
        error_rad=float(np.linalg.norm(xi[:, 3:], axis=1).mean()),
    )


def shown(T_world_sensor: Array, runs: Runs) -> Paths:
    """Return the true path and some of the runs as they can be drawn.  (L, 4, 4)."""
    truth = (inverse(T_world_sensor[0]) @ T_world_sensor)[:, :3, 3]
    some = runs.paths[:_MOST_SHOWN]
    T = np.array([[pose.T for pose in path] for path in some]).reshape(-1, len(truth) - 1, 4, 4)
    Y = np.array([[pose.Y for pose in path] for path in some]).reshape(-1, len(truth) - 1, 6, 6)
    R = T[..., :3, :3]
    return Paths(
        truth=np.round(truth, 5),
        positions=np.round(T[..., :3, 3], 5),
        covariances=R @ Y[..., :3, :3] @ np.swapaxes(R, -1, -2),
    )


def length_m(T_world_sensor: Array) -> float:
    """Return the length of the path.  (L, 4, 4)."""
    return float(np.linalg.norm(np.diff(T_world_sensor[:, :3, 3], axis=0), axis=1).sum())


def _run(
    clouds: Sequence[Cloud],
    T_world_sensor: Array,
    models: Sequence[Model],
    rng: np.random.Generator,
) -> list[_Run] | None:
    """Return one odometry by each model; None without an answer."""
    sampling = models[0].sampling
    settings = DEFAULTS._replace(widen_unknown=False)
    estimators = [Estimator(model, settings=settings) for model in models]
    steps: list[list[GaussianPose]] = [[] for _ in models]
    is_told = [False] * len(models)
    is_lost = False
    for k in range(1, len(clouds)):
        pair = clouds[k], clouds[k - 1]
        T_mean = inverse(T_world_sensor[k - 1]) @ T_world_sensor[k]
        T_init = T_mean @ exp(rng.normal(scale=np.sqrt(sampling.variance), size=6))
        try:
            answers = [estimators[0].register(*pair, T_init, rng)]
            found = answers[0].registration
            answers += [other.judge(*pair, found, rng) for other in estimators[1:]]
        except RegistrationError:
            return None
        for m, answer in enumerate(answers):
            steps[m].append(GaussianPose(found.T_ref_read, answer.covariance))
            is_told[m] |= answer.is_lost
        xi = log(inverse(T_mean) @ found.T_ref_read)
        is_lost |= bool(far_from_truth(xi, sampling.cluster_scale_m, sampling.cluster_scale_rad))
    return [_Run(steps_of, is_lost, told) for steps_of, told in zip(steps, is_told, strict=True)]
