"""Methods that need clouds, run on the pairs of a recording as a robot would run them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.case import Case, MethodSettings
from cello3d_ros.covariance.description import describe
from cello3d_ros.covariance.methods import METHODS
from cello3d_ros.covariance.model import Model
from cello3d_ros.errors import CloudError, ModelError, RecordingError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.recordings.recording import Recording
from cello3d_ros.registration.backends import register


class Answer(NamedTuple):
    """What one method said of one pair.

    covariance: (6, 6), NaN where there is no answer; cpu_ms: processor time, on top of the
    registration that is judged, with the description of the pair, which methods share.
    """

    covariance: Array
    cpu_ms: float


def prepared(
    recording: Recording, pipeline: Pipeline, needed: Sequence[int], seed: int = 0
) -> tuple[dict[int, Cloud], dict[int, Array]]:
    """Return the clouds and the true poses of some scans, by number.

    Raises RecordingError for a scan that is missing, too poor or has no ground truth.
    """
    clouds: dict[int, Cloud] = {}
    poses: dict[int, Array] = {}
    wanted = set(needed)
    for k, scan in enumerate(recording):
        if k not in wanted:
            continue
        if scan.T_world_sensor is None:
            raise RecordingError(f"{recording.name}: scan {k} has no ground truth")
        try:
            clouds[k] = prepare(scan.points, pipeline.cloud, np.random.default_rng([seed, k]))
        except CloudError as error:
            raise RecordingError(f"{recording.name}: scan {k}: {error}") from None
        poses[k] = scan.T_world_sensor
    if missing := sorted(wanted - set(clouds)):
        raise RecordingError(f"{recording.name} has {len(recording)} scans, no scan {missing[0]}")
    return clouds, poses


def answers(
    recording: Recording,
    pairs: Sequence[tuple[int, int]],
    model: Model,
    settings: MethodSettings,
    seed: int = 0,
) -> Iterator[dict[str, Answer]]:
    """Yield, for each pair (i, j) of scans, what every method says of it.

    The registration that is judged starts from the truth, where pairs of a dataset are described
    too, so that methods with and without clouds judge the same one.
    """
    needed = sorted({k for pair in pairs for k in pair})
    clouds, poses = prepared(recording, model.pipeline, needed, seed)

    def every(i: int, j: int) -> dict[str, Answer]:
        rng = np.random.default_rng([seed, i, j])
        T_mean = inverse(poses[i]) @ poses[j]
        found = register(clouds[j], clouds[i], T_mean, model.pipeline.icp, rng)
        start = time.process_time()
        try:
            description = describe(clouds[j], clouds[i], found.T_ref_read, model.pipeline)
        except RegistrationError:
            return {name: Answer(np.full((6, 6), np.nan), np.nan) for name in METHODS}
        case = Case(clouds[j], clouds[i], found, description, model.pipeline, model, rng, settings)
        ms = 1e3 * (time.process_time() - start)
        return {name: _answer(name, case, ms) for name in METHODS}

    for ij in pairs[:1]:
        every(*ij)  # compiles what there is to compile, so that the times below are without it
    for ij in pairs:
        yield every(*ij)


def _answer(name: str, case: Case, described_ms: float) -> Answer:
    start = time.process_time()
    try:
        Y = METHODS[name](case)
    except (RegistrationError, ModelError):
        Y = np.full((6, 6), np.nan)
    cpu_ms = described_ms + 1e3 * (time.process_time() - start)
    return Answer(Y if is_positive_definite(Y) else np.full((6, 6), np.nan), cpu_ms)
