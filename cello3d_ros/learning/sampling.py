"""Brute force: the distribution of ICP's results on one pair of clouds (Sec. IV-D).

A pair is worked on in three steps, each a pure function, so that they may run anywhere and give
the same bits: ``describe_pair``, ``register_block`` for each range of its registrations, and
``finish_pair``.  Registration k of a pair has a start and a seed of its own, whatever the blocks.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import Pipeline, SamplingConfig
from cello3d_ros.covariance.description import describe
from cello3d_ros.errors import CloudError, NoOverlapError, RecordingError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite, sampled_covariance
from cello3d_ros.geometry.se3 import Array, exp, inverse, log
from cello3d_ros.learning.clustering import nearest_cluster, offset
from cello3d_ros.learning.dataset import PairRecord
from cello3d_ros.learning.noise import Look, register_noisy, register_rescanned, seen_from
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.registration.backends import register, register_many
from cello3d_ros.registration.icp import Registration
from cello3d_ros.simulation.scanner import Echoes
from cello3d_ros.threads import in_threads

PENDING = "not_sampled"  # the reason of a record that is described and no more
BLOCK = 500  # registrations between two reports of progress
_GROWTH = 1.25  # of the number of samples from one look at the precision to the next
_FEWEST_KEPT = 12  # twice the dimensions: fewer make no covariance worth learning

Progress = Callable[[int], None]  # told how many registrations were done since the last call


class NoTruthError(CloudError):
    """A scan has no ground truth: nothing can be sampled of it."""

    reason = "no_ground_truth"


class Prepared(NamedTuple):
    """A scan's cloud, or why it has none; its true pose; if wanted, how to scan it again.

    echoes: from where it was; look: from elsewhere.
    """

    cloud: Cloud | CloudError
    T_world_sensor: Array
    echoes: Echoes | None = None
    look: Look | None = None


class Pair(NamedTuple):
    """Scans j, the reading, and i, the reference, of a recording.  T_mean: true T_ref_read."""

    recording: str
    i: int
    j: int
    reading: Prepared
    reference: Prepared
    T_mean: Array

    def clouds(self) -> tuple[Cloud, Cloud]:
        """Return reading and reference.  Raises CloudError where one has no cloud."""
        P, Q = self.reading.cloud, self.reference.cloud
        if isinstance(P, CloudError):
            raise P
        if isinstance(Q, CloudError):
            raise Q
        return P, Q

    def echoes(self) -> tuple[Echoes, Echoes] | None:
        """Return those of reading and reference, or None where one cannot be scanned again."""
        if self.reading.echoes is None or self.reference.echoes is None:
            return None
        return self.reading.echoes, self.reference.echoes


def pair_of(recording: str, i: int, j: int, reference: Prepared, reading: Prepared) -> Pair:
    """Return a pair of prepared scans."""
    T_mean = np.ascontiguousarray(inverse(reference.T_world_sensor) @ reading.T_world_sensor)
    return Pair(recording, i, j, reading, reference, T_mean)


class Block(NamedTuple):
    """What some of a pair's registrations found.

    xi: (n, 6) errors about ground truth of those with an answer, in the order of their numbers.
    """

    xi: Array
    n_converged: int
    n_failed: int


def pairs(n_scans: int, max_gap: int) -> list[tuple[int, int]]:
    """Return every (i, j) with ``0 <= i < j < n_scans`` and ``j - i <= max_gap``.

    Scan j is the reading, scan i the reference.  Ordered by j, then i: one pass over a recording
    that remembers its last ``max_gap`` scans meets every pair.
    Source: Sec. V-A.
    """
    return [(i, j) for j in range(1, n_scans) for i in range(max(0, j - max_gap), j)]


def sample_recording(
    recording: Recording,
    todo: list[tuple[int, int]],
    pipeline: Pipeline,
    sampling: SamplingConfig,
    n_threads: int = 1,
    progress: Progress = lambda n: None,
) -> Iterator[PairRecord]:
    """Sample pairs (i, j) of a recording, some or all of ``pairs``, in the order of j.

    One pass that remembers ``max_gap`` scans.  Each record follows from the recording, its name
    and the settings alone: which others are done and the number of threads do not matter.
    Raises RecordingError when the recording ends before the last pair; what was yielded before
    stands.
    """
    by_reading = {j: [i for i, reading in todo if reading == j] for _, j in todo}
    needed = {index for ij in todo for index in ij}
    window: dict[int, Prepared] = {}
    n_read = 0
    for j, scan in enumerate(islice(recording, max(needed, default=-1) + 1)):
        n_read = j + 1
        window.pop(j - sampling.max_gap - 1, None)
        if j not in needed:
            continue
        window[j] = prepare_scan(scan, recording.name, j, pipeline, sampling)
        for i in by_reading.get(j, []):
            pair = pair_of(recording.name, i, j, window[i], window[j])
            yield sample_pair(pair, pipeline, sampling, n_threads, progress)
    check_complete(recording.name, n_read, needed)


def sample_pair(
    pair: Pair,
    pipeline: Pipeline,
    sampling: SamplingConfig,
    n_threads: int = 1,
    progress: Progress = lambda n: None,
) -> PairRecord:
    """Register one pair many times and take the covariance about ground truth.

    Each start is ``T_mean exp(xi)``, xi ~ N(0, variance I), and
    each registration draws its own subsamples; with ``noise_m`` also noise, or where there are
    echoes, two new scans.  With ``n_views`` the k-th sees the pair from place k modulo n_views,
    where the scans can be looked at from elsewhere.  There are ``n_samples`` of them, or fewer
    where ``precision`` is reached before: the record is then that of the smaller ``n_samples``.
    Source: Sec. IV-D, V-A.
    """
    record = describe_pair(pair, pipeline, sampling)
    if record.reason != PENDING:
        return record
    blocks: list[Block] = []
    for start, stop in pairwise([0, *stops(sampling)]):
        blocks.append(register_block(pair, pipeline, sampling, start, stop, n_threads))
        progress(stop - start)
        if sampling.precision > 0.0 and stop < sampling.n_samples:
            finished = finish_pair(record, blocks, sampling)
            if is_precise(finished, sampling.precision):
                return finished
    return finish_pair(record, blocks, sampling)


def stops(sampling: SamplingConfig) -> list[int]:
    """Return after how many registrations of a pair to report or, with ``precision``, to look."""
    if sampling.precision <= 0.0:
        return [*range(BLOCK, sampling.n_samples, BLOCK), sampling.n_samples]
    found = [min(sampling.min_samples, sampling.n_samples)]
    while found[-1] < sampling.n_samples:
        found.append(min(math.ceil(_GROWTH * found[-1]), sampling.n_samples))
    return found


def describe_pair(pair: Pair, pipeline: Pipeline, sampling: SamplingConfig) -> PairRecord:
    """Return a record with everything but samples, its reason PENDING; or a rejected one.

    The pair is described where ICP ends when it starts from the truth, as it will be online.
    """
    base = PairRecord(
        recording=pair.recording,
        i=pair.i,
        j=pair.j,
        accepted=False,
        T_mean=pair.T_mean,
        reason=PENDING,
    )
    rng = np.random.default_rng(_pair_seed(pair, sampling))
    try:
        reading, reference = pair.clouds()
        at_truth = register(reading, reference, pair.T_mean, pipeline.icp, rng)
        described = describe(
            reading, reference, at_truth.T_ref_read, pipeline, sampling.n_rotations
        )
    except CloudError as error:
        return replace(base, reason=error.reason)
    except NoOverlapError:
        return replace(base, reason="no_overlap")
    except RegistrationError:
        return replace(base, reason="singular")
    return replace(
        base,
        overlap_ratio=described.overlap_ratio,
        descriptors=described.descriptors.astype(np.float32),
        features=described.features,
        rotations_rad=2.0 * np.pi * np.arange(sampling.n_rotations) / sampling.n_rotations,
        shapes=described.shapes,
    )


def register_block(
    pair: Pair,
    pipeline: Pipeline,
    sampling: SamplingConfig,
    start: int,
    stop: int,
    n_threads: int = 1,
) -> Block:
    """Do the registrations ``start`` to ``stop - 1`` of a pair that has been described.

    A registration without an answer, or with one that is not finite, is counted and left out.
    """
    seed = _pair_seed(pair, sampling)
    starts = np.random.default_rng([*seed, 0]).normal(
        scale=np.sqrt(sampling.variance), size=(stop, 6)
    )[start:]
    seeds = [[*seed, 1, k] for k in range(start, stop)]
    T_inits = pair.T_mean @ exp(starts)
    if sampling.n_views > 1 and pair.reading.look and pair.reference.look:
        results = _from_views(pair, pipeline, sampling, T_inits, seeds, n_threads)
    else:
        results = _registrations(pair, pipeline, sampling.noise_m, T_inits, seeds, n_threads)
    answers = [
        result for result in results if result.has_answer and np.isfinite(result.T_ref_read).all()
    ]
    T_found = np.array([result.T_ref_read for result in answers]).reshape(-1, 4, 4)
    return Block(
        log(inverse(pair.T_mean) @ T_found),
        sum(result.converged for result in answers),
        stop - start - len(answers),
    )


def _registrations(
    pair: Pair,
    pipeline: Pipeline,
    noise_m: float,
    T_inits: Array,
    seeds: list[list[int]],
    n_threads: int,
) -> list[Registration]:
    """Register from many starts, each with a seed of its own, and with noise if that is wanted."""
    reading, reference = pair.clouds()
    if noise_m <= 0.0:
        return register_many(reading, reference, T_inits, seeds, pipeline.icp, n_threads)
    echoes = pair.echoes()

    def one(k: int) -> Registration:
        rng = np.random.default_rng(seeds[k])
        if echoes is not None:
            return register_rescanned(*echoes, T_inits[k], pipeline, noise_m, rng)
        return register_noisy(reading, reference, T_inits[k], pipeline.icp, noise_m, rng)

    return in_threads(one, range(len(T_inits)), n_threads)


def _from_views(
    pair: Pair,
    pipeline: Pipeline,
    sampling: SamplingConfig,
    T_inits: Array,
    seeds: list[list[int]],
    n_threads: int,
) -> list[Registration]:
    """Register from many starts, number k in view k modulo ``n_views``.

    Those that end where a direction is free have no answer, as online.
    """
    assert pair.reading.look is not None
    assert pair.reference.look is not None
    looks = pair.reading.look, pair.reference.look
    T_world = pair.reading.T_world_sensor, pair.reference.T_world_sensor
    of_view = np.array([seed[-1] % sampling.n_views for seed in seeds])
    views = np.unique(of_view).tolist()
    found: list[Registration] = [
        Registration(T, 0, False, "too_few_points", np.inf, 0) for T in T_inits
    ]

    def one(n: int) -> None:
        rows = np.flatnonzero(of_view == views[n])
        rng = np.random.default_rng([*_pair_seed(pair, sampling), 2, views[n]])
        try:
            P, Q = seen_from(looks, T_world, pipeline, rng)
        except CloudError:
            return
        own = [seeds[row] for row in rows]
        results = register_many(P, Q, T_inits[rows], own, pipeline.icp)
        for row, result in zip(rows, results, strict=True):
            if _is_held(P, Q, result, pipeline):
                found[row] = result

    in_threads(one, range(len(views)), n_threads)
    return found


def _is_held(reading: Cloud, reference: Cloud, result: Registration, pipeline: Pipeline) -> bool:
    """Return whether planes hold a registration in every direction, where it has an answer."""
    if not result.has_answer:
        return False
    try:
        return not describe(reading, reference, result.T_ref_read, pipeline, 0).free
    except RegistrationError:
        return False


def finish_pair(
    record: PairRecord, blocks: Sequence[Block], sampling: SamplingConfig
) -> PairRecord:
    """Return the described pair with its samples: accepted, or the reason why not."""
    xi = np.concatenate([block.xi for block in blocks])
    record = replace(
        record,
        xi=xi,
        kept=np.zeros(len(xi), np.bool_),
        n_converged=sum(block.n_converged for block in blocks),
        n_failed=sum(block.n_failed for block in blocks),
    )
    return _judged(record, sampling)


def is_precise(record: PairRecord, precision: float) -> bool:
    """Return whether each eigenvalue of the covariance has at most this relative error."""
    return record.accepted and bool((eigenvalue_errors(record.xi[record.kept]) <= precision).all())


def eigenvalue_errors(xi: Array) -> Array:
    """Return the relative standard errors (6,) of the eigenvalues of Y, in increasing order.

    xi: (n, 6) errors about ground truth, whose covariance about zero is Y.  Along an eigenvector
    v of Y, the eigenvalue is the mean of ``(v^T xi)^2``, so to first order its standard error is
    that of a mean: ``std((v^T xi)^2) / sqrt(n)``.  For Gaussian errors the ratio to the
    eigenvalue is ``sqrt(2 / n)``; heavy tails need more samples, an offset from the truth that
    outweighs the scatter needs fewer.
    Source: Anderson, Asymptotic Theory for Principal Component Analysis, 1963, with the fourth
    moments taken from the samples.
    """
    values, vectors = np.linalg.eigh(sampled_covariance(xi))
    squares = (xi @ vectors) ** 2
    return np.asarray(squares.std(axis=0, ddof=1) / np.sqrt(len(xi)) / values)


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


def prepare_scan(
    scan: Scan, name: str, index: int, pipeline: Pipeline, sampling: SamplingConfig
) -> Prepared:
    """Return the cloud of scan ``index`` of a recording, or why it has none, and its true pose.

    Its echoes are kept where registrations are to scan it again.  A scan without a true pose has
    no cloud and the identity in its place: its pairs are rejected.
    """
    if scan.T_world_sensor is None:
        return Prepared(NoTruthError(f"{name}: scan {index} has no ground truth"), np.eye(4))
    rng = np.random.default_rng([sampling.seed, _name_seed(name), index])
    T_world_sensor = np.array(scan.T_world_sensor, order="C")
    try:
        cloud = prepare(scan.points, pipeline.cloud, rng)
    except CloudError as error:
        return Prepared(error, T_world_sensor)
    echoes = scan.echoes if sampling.noise_m > 0.0 else None
    return Prepared(cloud, T_world_sensor, echoes, scan.look if sampling.n_views > 1 else None)


def check_complete(name: str, n_read: int, needed: set[int]) -> None:
    """Raise RecordingError when a recording ended after n_read scans and more are needed."""
    if needed and n_read <= max(needed):
        raise RecordingError(
            f"{name}: ends early, after {n_read} scans: scan {max(needed)} is missing"
        )


def _pair_seed(pair: Pair, sampling: SamplingConfig) -> list[int]:
    return [sampling.seed, _name_seed(pair.recording), pair.i, pair.j]


def _name_seed(name: str) -> int:
    """Return a number that tells recordings apart, the same on every machine."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")
