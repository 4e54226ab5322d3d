"""Sampling on a Dask cluster: the same steps as on one machine, the same bits.

A pair becomes a few tasks: prepare the two scans (once each, wherever), describe the pair,
register blocks of its starts, finish it.  Every task is a pure function of its arguments, so that
one lost with its worker is done again elsewhere and gives what it would have given.  Nothing but
the client writes: what the caller stores is whole and comes once.

Only a bounded number of tasks is under way, so that the scheduler's memory and the scans that the
workers hold do not grow with the recording.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from typing import Any

from cello3d_ros.errors import Cello3dError, ConfigError
from cello3d_ros.learning.cluster_tasks import (
    ClusterError,
    Job,
    described,
    finished_pair,
    prepared,
    registered,
    whole_pair,
)
from cello3d_ros.learning.dataset import PairRecord
from cello3d_ros.learning.sampling import Progress, check_complete
from cello3d_ros.recordings.recording import Recording

__all__ = ["ClusterError", "Job", "connected", "sample_recording_on"]

Client = Any  # distributed.Client
Future = Any  # distributed.Future

CONNECT_TIMEOUT_S = 5.0
_FEWEST_UNDER_WAY = 64  # tasks, while there is no worker yet
_UNDER_WAY_PER_THREAD = 4  # tasks, so that no thread waits for the client


@contextmanager
def connected(address: str, timeout_s: float | None = None) -> Iterator[Client]:
    """Give a client of the scheduler at an address such as ``tcp://host:8786``.

    Raises ClusterError when it cannot be reached, or is lost on the way.
    """
    timeout_s = CONNECT_TIMEOUT_S if timeout_s is None else timeout_s
    try:
        dask, core = import_module("dask"), import_module("distributed.core")
        distributed = import_module("distributed")
    except ImportError as error:
        raise ConfigError(
            f"a scheduler needs dask.distributed: pip install 'cello3d_ros[cluster]' ({error})"
        ) from None

    async def knock() -> None:
        comm = await asyncio.wait_for(core.connect(address, timeout=timeout_s), timeout_s + 0.5)
        comm.abort()

    with dask.config.set({"distributed.comm.timeouts.connect": timeout_s}):
        try:
            asyncio.run(knock())  # a client that fails to connect takes half a minute to go
            client = distributed.Client(address, timeout=timeout_s, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError
            reason = (str(error).splitlines() or [f"silent for {timeout_s:g} s"])[0]
            raise ClusterError(f"no Dask scheduler answers at {address}: {reason}") from None
        try:
            yield client
        finally:
            client.close(timeout=timeout_s)


def sample_recording_on(
    client: Client,
    recording: Recording,
    todo: list[tuple[int, int]],
    job: Job,
    progress: Progress = lambda n: None,
) -> Iterator[PairRecord]:
    """Sample pairs (i, j) of a recording on a cluster; records come in the order of their ends.

    With ``precision`` a pair is one task, as its end depends on what was found.  The workers read
    the recording at ``job.path``; with ``job.ship_clouds`` the client reads it and sends each scan
    to one worker, from which others get its cloud.
    Raises RecordingError as ``sample_recording`` does, and ClusterError: after what is under way
    and can be finished.
    """
    under_way = _UnderWay(client, job)
    finished = import_module("distributed").as_completed(loop=client.loop)
    try:
        for futures in under_way.submitted(recording, todo):
            finished.update(futures)
            while not under_way.error and under_way.n_tasks >= under_way.limit():
                yield from under_way.ended(finished, progress)
            if under_way.error:
                break
        while under_way.n_tasks:
            yield from under_way.ended(finished, progress)
        if under_way.error:
            raise under_way.error
    finally:
        under_way.forget()


class _UnderWay:
    """The tasks that the cluster has been given and that have not come back."""

    def __init__(self, client: Client, job: Job) -> None:
        self.client, self.job = client, job
        self._ends: dict[str, tuple[str, int, bool]] = {}  # key -> pair, registrations, is last
        self._parts: dict[str, list[Future]] = {}  # pair -> tasks to be kept until its last ends
        self._told: Counter[str] = Counter()  # pair -> registrations of which progress knows
        self.error: Cello3dError | None = None  # the first

    @property
    def n_tasks(self) -> int:
        return len(self._ends)

    def limit(self) -> int:
        """Return how many tasks keep the cluster busy, as large as it is now."""
        try:
            n_threads = int(sum(self.client.nthreads().values()))
        except Exception as error:  # whatever a lost connection raises
            raise self._lost(error) from None
        return max(_FEWEST_UNDER_WAY, _UNDER_WAY_PER_THREAD * n_threads)

    def submitted(
        self, recording: Recording, todo: list[tuple[int, int]]
    ) -> Iterator[list[Future]]:
        """Submit pair by pair in the order of j; yield the tasks of each that report an end."""
        by_reading = {j: [i for i, reading in todo if reading == j] for _, j in todo}
        needed = {index for ij in todo for index in ij}
        scans = iter(recording) if self.job.ship_clouds else None
        clouds: dict[int, Future] = {}
        for j in range(max(needed, default=-1) + 1):
            clouds.pop(j - self.job.sampling.max_gap - 1, None)
            try:
                scan = None
                if scans is not None and (scan := next(scans, None)) is None:
                    check_complete(self.job.name, j, needed)
            except Cello3dError as error:
                self.error = error
                return
            if scan is not None:
                scan = replace(scan, look=None)  # the world stays here
            if j in needed:
                clouds[j] = self._submit(f"cloud-{j}", prepared, self.job, j, scan)
            for i in by_reading.get(j, []):
                yield self._pair(i, j, clouds[i], clouds[j])

    def ended(self, finished: Any, progress: Progress) -> Iterator[PairRecord]:
        """Wait for at least one task; report it, and yield the record of a finished pair."""
        last = []
        for future in finished.next_batch(block=True):
            if future.status in ("lost", "pending"):  # ended, its worker died, is made again
                finished.add(future)
                continue
            pair, n, is_last = self._ends.pop(future.key)
            if future.status != "finished":
                self.error = self.error or self._error(pair, future)
            elif is_last:
                last.append((pair, future))
            else:
                self._told[pair] += n
                progress(n)
        try:
            records = self.client.gather([future for _, future in last])
        except Cello3dError:
            raise
        except Exception as error:
            raise self._lost(error) from None
        for (pair, _), record in zip(last, records):
            del self._parts[pair]
            progress(record.n_samples - self._told.pop(pair, 0))
            yield record

    def forget(self) -> None:
        """Give up what is not done: the scheduler drops tasks that nobody waits for."""
        self._ends.clear()
        self._parts.clear()

    def _pair(self, i: int, j: int, reference: Future, reading: Future) -> list[Future]:
        """Submit one pair; return the futures whose ends are to be reported."""
        pair, sampling = f"{i}-{j}", self.job.sampling
        clouds = (reference, reading)
        if sampling.precision > 0.0:
            parts = [self._submit(f"pair-{pair}", whole_pair, self.job, i, j, *clouds)]
            n_done = [0]
        else:
            cuts = [*range(0, sampling.n_samples, self.job.block), sampling.n_samples]
            n_done = [*(b - a for a, b in pairwise(cuts)), 0]
            record = self._submit(f"described-{pair}", described, self.job, i, j, *clouds)
            parts = [
                self._submit(f"block-{pair}-{a}", registered, self.job, record, *clouds, a, b)
                for a, b in pairwise(cuts)
            ]
            parts.append(self._submit(f"pair-{pair}", finished_pair, self.job, record, parts))
        for part, n in zip(parts, n_done):
            self._ends[part.key] = (pair, n, part is parts[-1])
        self._parts[pair] = parts
        return parts

    def _submit(self, key: str, function: Any, *arguments: Any) -> Future:
        name = f"{function.__name__}-{self.job.run}-{self.job.name}-{key}"
        try:
            return self.client.submit(function, *arguments, key=name)
        except Exception as error:
            raise self._lost(error) from None

    def _error(self, pair: str, future: Future) -> Cello3dError:
        """Return why a task did not come back, as one sentence."""
        if future.status != "error":
            return self._lost(None)
        error = future.exception()
        if isinstance(error, Cello3dError):
            return error
        text = " ".join(str(error).split())
        return ClusterError(
            f"{self.job.name}: pair {pair} failed on the cluster: {type(error).__name__}: {text}"
        )

    def _lost(self, error: BaseException | None) -> ClusterError:
        where = getattr(self.client.scheduler, "addr", None) or "?"
        reason = f" ({' '.join(str(error).split())})" if error is not None and str(error) else ""
        return ClusterError(
            f"lost the Dask scheduler at {where}{reason}: pairs that were done are kept, the same "
            "command does the rest"
        )
