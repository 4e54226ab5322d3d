"""What a Dask cluster is given to do: the steps of sampling a pair, as pure functions.

Each takes a ``Job`` and what earlier tasks gave back, so that one lost with its worker is done
again elsewhere and gives what it would have given.
"""

from __future__ import annotations

import threading
import uuid
from dataclasses import dataclass, field
from functools import cache, lru_cache

import numpy as np
from threadpoolctl import threadpool_limits

from cello3d_ros.clouds.neighbors import KdTree
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline, SamplingConfig
from cello3d_ros.errors import Cello3dError, CloudError
from cello3d_ros.learning.dataset import PairRecord, package_versions
from cello3d_ros.learning.sampling import (
    PENDING,
    Block,
    Pair,
    Prepared,
    check_complete,
    describe_pair,
    finish_pair,
    pair_of,
    prepare_scan,
    register_block,
    sample_pair,
)
from cello3d_ros.recordings import open_recording
from cello3d_ros.recordings.deskew import without_motion
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.simulation.rescan import rescannable
from cello3d_ros.simulation.scanner import Echoes

_REMEMBERED = 8  # scans that a worker keeps behind the one it has read last


class ClusterError(Cello3dError):
    """The cluster cannot be reached or lost something that it cannot make again."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What all tasks of one recording share.

    run: unlike in any other run, part of every key; path: where the workers find the recording;
    versions: of the client's packages, which the workers must have too; block: registrations of
    one task; ship_clouds: whether the client reads the recording and sends each scan.
    """

    name: str
    path: str
    pipeline: Pipeline
    sampling: SamplingConfig
    block: int = 1000
    ship_clouds: bool = False
    run: str = field(default_factory=lambda: uuid.uuid4().hex[:12])
    versions: tuple[tuple[str, str], ...] = field(
        default_factory=lambda: tuple(package_versions().items())
    )


def prepared(job: Job, index: int, scan: Scan | None) -> Prepared:
    """Task: prepare a scan, read here unless it was sent."""
    _one_blas_thread()
    _check_versions(job.versions)
    scan = _read(job, index) if scan is None else scan
    return prepare_scan(scan, job.name, index, job.pipeline, job.sampling)


def described(job: Job, i: int, j: int, reference: Prepared, reading: Prepared) -> PairRecord:
    """Task: all of a record but the samples."""
    _one_blas_thread()
    return describe_pair(_pair(job, i, j, reference, reading), job.pipeline, job.sampling)


def registered(
    job: Job, record: PairRecord, reference: Prepared, reading: Prepared, start: int, stop: int
) -> Block | None:
    """Task: some registrations of a pair, none of a pair that is rejected already."""
    _one_blas_thread()
    _check_versions(job.versions)
    if record.reason != PENDING:
        return None
    pair = _pair(job, record.i, record.j, reference, reading)
    pair = pair._replace(T_mean=np.array(record.T_mean, order="C"))
    return register_block(pair, job.pipeline, job.sampling, start, stop)


def finished_pair(job: Job, record: PairRecord, blocks: list[Block | None]) -> PairRecord:
    """Task: the record with its samples."""
    _one_blas_thread()
    done = [block for block in blocks if block is not None]
    return finish_pair(record, done, job.sampling) if done else record


def whole_pair(job: Job, i: int, j: int, reference: Prepared, reading: Prepared) -> PairRecord:
    """Task: all of a pair whose number of registrations is not known beforehand."""
    _one_blas_thread()
    _check_versions(job.versions)
    return sample_pair(_pair(job, i, j, reference, reading), job.pipeline, job.sampling)


def _pair(job: Job, i: int, j: int, reference: Prepared, reading: Prepared) -> Pair:
    return pair_of(job.name, i, j, _owned(reference), _owned(reading))


def _owned(scan: Prepared) -> Prepared:
    """Return the same with arrays of its own where they came over the network.

    Those are read-only views of a message, aligned to no multiple of anything: every kernel would
    be compiled again for them, and numpy multiplies them in another way, to other last bits.
    """
    cloud, T_world_sensor, echoes, _ = scan
    if isinstance(cloud, CloudError) or cloud.points.flags.writeable:
        return scan
    tree = KdTree._make(np.array(array) for array in cloud.tree)
    arrays = {name: np.array(getattr(cloud, name)) for name in Cloud._fields if name != "tree"}
    if echoes is not None:
        echoes = Echoes._make(np.array(v) if isinstance(v, np.ndarray) else v for v in echoes)
    cloud = cloud._replace(tree=tree, **arrays)
    return Prepared(cloud, np.array(T_world_sensor, order="C"), echoes)


class _Reader:
    """One pass over a recording that goes on where it stopped, and remembers a few scans.

    Tasks come to a worker nearly in the order of the scans; one that asks for an older scan, as
    after the death of another worker, starts over.
    """

    def __init__(self, path: str, rescan: bool = False) -> None:
        found = rescannable(path) if rescan else open_recording(path)
        self._recording = without_motion(found)
        self._scans = iter(self._recording)
        self._n_read = 0
        self._recent: dict[int, Scan] = {}

    def scan(self, index: int) -> Scan:
        """Return scan ``index``.  Raises RecordingError when there is none."""
        if index < self._n_read and index not in self._recent:
            self._scans, self._n_read = iter(self._recording), 0
        for k in range(self._n_read, index + 1):
            scan = next(self._scans, None)
            if scan is None:
                check_complete(self._recording.name, k, {index})
                raise AssertionError("unreachable")
            self._n_read = k + 1
            self._recent[k] = scan
            self._recent.pop(k - _REMEMBERED, None)
        return self._recent[index]


_readers: dict[tuple[str, str], _Reader] = {}
_reading = threading.Lock()


def _read(job: Job, index: int) -> Scan:
    """Return a scan of the recording that this worker has open, which is one at a time."""
    key = (job.run, job.path)
    with _reading:
        reader = _readers.pop(key, None) or _Reader(job.path, job.sampling.noise_m > 0.0)
        scan = reader.scan(index)  # a reader that fails is not kept
        _readers.clear()
        _readers[key] = reader
    return scan


@cache
def _one_blas_thread() -> None:
    """Keep BLAS of this process to one thread: its waiting ones take the kernels' cores."""
    threadpool_limits(1, user_api="blas")


@lru_cache(maxsize=4)
def _check_versions(versions: tuple[tuple[str, str], ...]) -> None:
    """Raise ClusterError where this worker would compute with other packages than the client."""
    ours = package_versions()
    for name, version in versions:
        if ours.get(name) != version:
            raise ClusterError(
                f"a worker has {name} {ours.get(name)}, this machine {version}: results would not "
                "be the same"
            )
