"""Time brute-force sampling: both clouds redrawn for each registration, one thread and two.

A case is a folder of ref_points.npy, ref_normals.npy, reading_points.npy and T0.npy, the filtered
clouds before any draw; without one, two walls and a floor.  Runs of one and two threads alternate
and medians are given, in wall time, since threads are what is measured.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from cello3d_ros.clouds.neighbors import build_tree
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.geometry.se3 import exp
from cello3d_ros.registration.backends import register_many


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--registrations", type=int, default=100)
    parser.add_argument("--samples", type=int, default=5000, help="registrations of one pair")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--start", action="store_true", help="register once, print the seconds")
    arguments = parser.parse_args()
    reading, reference, starts = clouds(arguments.case)
    if arguments.start:
        print(seconds_of(reading, reference, starts[:1], 1))
        return
    result = measure(reading, reference, starts, arguments)
    print(json.dumps(result, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


def clouds(folder: Path | None) -> tuple[Cloud, Cloud, Any]:
    if folder:
        names = ("reading_points", "ref_points", "ref_normals", "T0")
        read, ref, normals, starts = (np.load(folder / f"{name}.npy") for name in names)
    else:
        rng = np.random.default_rng(0)
        normals = np.eye(3)[rng.integers(0, 3, 25000)]
        ref = rng.uniform(0, 8, (25000, 3)) * (1 - normals)
        ref = ref + rng.normal(scale=0.01, size=ref.shape)
        read, starts = ref[::-1] + 0.01, exp(rng.normal(scale=0.05**0.5, size=(200, 6)))
    return in_order(read, np.zeros_like(read)), in_order(ref, normals), starts


def in_order(points: Any, normals: Any) -> Cloud:
    tree = build_tree(points)
    nothing = np.zeros(len(points))
    return Cloud(tree.points, normals[tree.order], nothing, nothing, tree)


def seconds_of(reading: Cloud, reference: Cloud, starts: Any, n_threads: int) -> float:
    seeds = [[0, i] for i in range(len(starts))]
    start = time.perf_counter()
    register_many(reading, reference, starts, seeds, IcpConfig(), n_threads)
    return time.perf_counter() - start


def cpu_seconds_of(pairs: list[tuple[Cloud, Cloud]], starts: Any) -> float:
    begin = time.process_time()
    for reading, reference in pairs:
        seconds_of(reading, reference, starts, 1)
    return time.process_time() - begin


def measure(reading: Cloud, reference: Cloud, starts: Any, arguments: Any) -> dict[str, Any]:
    command = [sys.executable, __file__, "--start"]
    if arguments.case:
        command += ["--case", str(arguments.case)]
    seconds_of(reading, reference, starts[:1], 1)  # the cache is filled
    begin = time.perf_counter()
    first = float(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    process_s = time.perf_counter() - begin
    starts = np.resize(starts, (arguments.registrations, 4, 4))
    times: dict[int, list[float]] = {1: [], 2: []}
    cpu_s = 0.0
    for _ in range(arguments.runs):
        for n_threads in times:
            begin = time.process_time()
            times[n_threads].append(seconds_of(reading, reference, starts, n_threads))
            cpu_s += (time.process_time() - begin) * (n_threads == 1)
    one, two = (statistics.median(t) for t in times.values())
    n = arguments.registrations
    sizes = (max(n // 4, 1), max(n // 2, 1), n)
    return {
        "cpu_seconds_by_samples": {
            size: cpu_seconds_of([(reading, reference)], starts[:size]) for size in sizes
        },
        "cpu_seconds_by_pairs": {
            size: cpu_seconds_of([(reading, reference)] * size, starts[: sizes[0]])
            for size in (1, 2, 4)
        },
        "registrations_per_second_1_thread": n / one,
        "registrations_per_second_2_threads": n / two,
        "registrations_per_cpu_second": n * arguments.runs / cpu_s,
        "two_threads_over_one": one / two,
        "pairs_per_minute_1_thread": 60.0 * n / one / arguments.samples,
        "pairs_per_minute_2_threads": 60.0 * n / two / arguments.samples,
        "samples_per_pair": arguments.samples,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "first_registration_from_cache_s": first,
        "process_from_cache_s": process_s,
    }


if __name__ == "__main__":
    main()
