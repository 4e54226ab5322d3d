"""What a Dask task costs: ``python benchmarks/cluster.py [--json FILE] [--tasks N]``.

A scheduler and 1, then 2 workers are started on loopback, as processes with one thread each.
Tasks carry what a block of registrations carries (the settings, a record, two clouds' keys) and
give back what it gives back, but sleep instead of registering, so that the machine's cores do not
matter.  Overhead of a worker per task = (wall time x workers - time slept) / tasks.  The CPU time
of the scheduler and of the client per task bounds the tasks a second of any number of workers:
each is one thread.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import psutil

from cello3d_ros.config import Pipeline, SamplingConfig
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.learning.cluster import Job, connected
from cello3d_ros.learning.dataset import PairRecord
from cello3d_ros.learning.sampling import Block


@contextmanager
def dask(*arguments: str, until: str):
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments, "--no-dashboard"],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        line = next(line for line in process.stderr if until in line)
        yield line.split()[-1], psutil.Process(process.pid)
    finally:
        process.kill()
        process.wait()


def block(job: Job, record: PairRecord, start: int, stop: int, sleep_s: float) -> Block:
    time.sleep(sleep_s)
    return Block(np.zeros((stop - start, 6)), stop - start, 0)


def seconds(client, n_tasks: int, n_samples: int, sleep_s: float) -> float:
    """Return the wall time of so many tasks, 32 under way for each worker, results gathered."""
    from distributed import as_completed

    job = Job(name="room", path="/data/room", pipeline=Pipeline(), sampling=SamplingConfig())
    record = client.submit(
        PairRecord,
        recording="room",
        i=0,
        j=1,
        accepted=False,
        T_mean=np.eye(4),
        descriptors=np.zeros((4, 704), np.float32),
        features=np.zeros(len(FEATURES)),
    )
    key = 0

    def submit():
        nonlocal key
        key += 1
        a = n_samples * key
        return client.submit(
            block, job, record, a, a + n_samples, sleep_s, key=f"block-{job.run}-{key}"
        )

    begin = time.perf_counter()
    n_first = min(n_tasks, 32 * len(client.nthreads()))
    running = as_completed([submit() for _ in range(n_first)], loop=client.loop)
    for batch in running.batches():
        client.gather(batch)
        for _ in range(min(len(batch), n_tasks - key)):
            running.add(submit())
    return time.perf_counter() - begin


def cpu_seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tasks", type=int, default=1000)
    arguments = parser.parse_args()
    report: dict[str, object] = {"n_tasks": arguments.tasks, "n_samples_per_task": 1000}
    for n_workers in (1, 2):
        with ExitStack() as stack:
            start = ("scheduler", "--host", "127.0.0.1", "--port", "0")
            address, scheduler = stack.enter_context(dask(*start, until="Scheduler at:"))
            for _ in range(n_workers):
                flags = ("--nworkers", "1", "--nthreads", "1", "--no-nanny")
                stack.enter_context(dask("worker", address, *flags, until="Registered to:"))
            client = stack.enter_context(connected(address))
            seconds(client, 50, 10, 0.0)
            n, n_slept = arguments.tasks, arguments.tasks // 4
            cpu = [cpu_seconds(scheduler), cpu_seconds(psutil.Process())]
            empty = seconds(client, n, 1000, 0.0)
            cpu = [cpu_seconds(scheduler) - cpu[0], cpu_seconds(psutil.Process()) - cpu[1]]
            slept = seconds(client, n_slept, 1000, 0.1)
            report[f"workers_{n_workers}"] = {
                "scheduler_cpu_ms_per_task": round(1e3 * cpu[0] / n, 3),
                "client_cpu_ms_per_task": round(1e3 * cpu[1] / n, 3),
                "empty_task_wall_ms": round(1e3 * empty / n, 3),
                "worker_overhead_ms": round(1e3 * (slept * n_workers / n_slept - 0.1), 3),
            }
    print(json.dumps(report, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
