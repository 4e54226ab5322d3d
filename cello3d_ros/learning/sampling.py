"""Brute force: the distribution of ICP's results on one pair of clouds (Sec. IV-D)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import Pipeline, SamplingConfig
from cello3d_ros.covariance.estimator import describe
from cello3d_ros.errors import CloudError, NoOverlapError, RecordingError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite, sampled_covariance
from cello3d_ros.geometry.se3 import Array, exp, inverse, log
from cello3d_ros.learning.clustering import nearest_cluster, offset
from cello3d_ros.learning.dataset import PairRecord
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.registration.icp import register, register_many

_FEWEST_KEPT = 12  # twice the dimensions: fewer make no covariance worth learning


def sample_recording(
    recording: Recording,
    todo: list[tuple[int, int]],
    pipeline: Pipeline,
    sampling: SamplingConfig,
    n_threads: int = 1,
) -> Iterator[PairRecord]:
    """Sample pairs (i, j) of a recording, some or all of ``pairs``, in the order of j.

    One pass that remembers ``max_gap`` scans.  Each record follows from the recording, its name
    and the settings alone: which others are done and the number of threads do not matter.
    Raises RecordingError when a scan has no ground truth.
    """
    by_reading = {j: [i for i, reading in todo if reading == j] for _, j in todo}
    needed = {index for ij in todo for index in ij}
    window: dict[int, tuple[Cloud | CloudError, Array]] = {}
    for j, scan in enumerate(recording):
        window.pop(j - sampling.max_gap - 1, None)
        if j not in needed:
            continue
        window[j] = _prepared(scan, recording.name, j, pipeline, sampling)
        for i in by_reading.get(j, []):
            yield _sample_window(recording.name, i, j, window, pipeline, sampling, n_threads)


def sample_pair(
    recording: str,
    i: int,
    j: int,
    reading: Cloud,
    reference: Cloud,
    T_mean: Array,
    pipeline: Pipeline,
    sampling: SamplingConfig,
    n_threads: int = 1,
) -> PairRecord:
    """Register one pair ``n_samples`` times and take the covariance about ground truth.

    T_mean: (4, 4), true T_ref_read.  Each start is ``T_mean exp(xi)``, xi ~ N(0, variance I), and
    each registration draws its own subsamples.  The pair is described where ICP ends when it
    starts from the truth, as it will be online.  Source: Sec. IV-D, V-A.
    """
    seed = [sampling.seed, _name_seed(recording), i, j]
    base = PairRecord(
        recording=recording, i=i, j=j, accepted=False, T_mean=T_mean, reason="not sampled"
    )
    at_truth = register(reading, reference, T_mean, pipeline.icp, np.random.default_rng(seed))
    try:
        pair = describe(reading, reference, at_truth.T_ref_read, pipeline, sampling.n_rotations)
    except NoOverlapError:
        return replace(base, reason="no_overlap")
    except RegistrationError:
        return replace(base, reason="singular")
    starts = np.random.default_rng([*seed, 0]).normal(
        scale=np.sqrt(sampling.variance), size=(sampling.n_samples, 6)
    )
    seeds = [[*seed, 1, k] for k in range(sampling.n_samples)]
    results = register_many(
        reading, reference, T_mean @ exp(starts), seeds, pipeline.icp, n_threads
    )
    answers = [r for r in results if r.reason in ("", "max_iterations")]
    xi = log(inverse(T_mean) @ np.array([r.T_ref_read for r in answers]).reshape(-1, 4, 4))
    record = replace(
        base,
        xi=xi,
        kept=np.zeros(len(xi), np.bool_),
        n_converged=sum(r.converged for r in answers),
        n_failed=len(results) - len(answers),
        overlap_ratio=pair.overlap_ratio,
        descriptors=pair.descriptors.astype(np.float32),
        rotations_rad=2.0 * np.pi * np.arange(sampling.n_rotations) / sampling.n_rotations,
        shapes=pair.shapes,
    )
    return _judged(record, sampling)


def _judged(record: PairRecord, sampling: SamplingConfig) -> PairRecord:
    """Keep the cluster nearest to the truth and take its covariance, or say why not."""
    if len(record.xi) < _FEWEST_KEPT:
        return replace(record, reason="singular")
    translation_m, rotation_rad = offset(record.xi)
    if translation_m > sampling.max_offset_m or rotation_rad > sampling.max_offset_rad:
        return replace(record, reason="offset")
    kept = nearest_cluster(
        record.xi,
        sampling.cluster_scale_m,
        sampling.cluster_scale_rad,
        sampling.cluster_min_share,
    )
    if kept.sum() < _FEWEST_KEPT:
        return replace(record, kept=kept, reason="no_cluster")
    Y = sampled_covariance(record.xi[kept])
    if not all(is_positive_definite(matrix) for matrix in (Y, *record.shapes.values())):
        return replace(record, kept=kept, reason="singular")
    return replace(record, kept=kept, covariance=Y, accepted=True, reason="")


def _sample_window(
    name: str,
    i: int,
    j: int,
    window: dict[int, tuple[Cloud | CloudError, Array]],
    pipeline: Pipeline,
    sampling: SamplingConfig,
    n_threads: int,
) -> PairRecord:
    (reference, T_i), (reading, T_j) = window[i], window[j]
    T_mean = inverse(T_i) @ T_j
    if isinstance(reference, CloudError) or isinstance(reading, CloudError):
        return PairRecord(
            recording=name, i=i, j=j, accepted=False, T_mean=T_mean, reason="too_few_points"
        )
    return sample_pair(name, i, j, reading, reference, T_mean, pipeline, sampling, n_threads)


def _prepared(
    scan: Scan, name: str, index: int, pipeline: Pipeline, sampling: SamplingConfig
) -> tuple[Cloud | CloudError, Array]:
    """Return the scan's cloud, or why it has none, and its true pose."""
    if scan.T_world_sensor is None:
        raise RecordingError(f"{name}: scan {index} has no ground truth, sampling needs it")
    rng = np.random.default_rng([sampling.seed, _name_seed(name), index])
    try:
        return prepare(scan.points, pipeline.cloud, rng), scan.T_world_sensor
    except CloudError as error:
        return error, scan.T_world_sensor


def _name_seed(name: str) -> int:
    """Return a number that tells recordings apart, the same on every machine."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")
