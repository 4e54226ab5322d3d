"""What a prediction costs: ``python benchmarks/prediction.py [--json FILE]``.

Models of 10^3, 10^5 and 10^6 synthetic examples, each in a process of its own: milliseconds of a
prediction, descriptor to covariance, and the largest memory of that process, which writes the
model, reads it back and predicts from it.  The spread of the projections is that at which about as
large a share of the examples weighs as in the shipped model (rho of the median example above the
nearest's: about 20); ``--spread 0`` weighs all alike, the slowest.  One thread.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from cello3d_ros.covariance.model import Model, load_model, predict, save_model

D, R = 704, 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--examples", type=int, nargs="+", default=[10**3, 10**5, 10**6])
    parser.add_argument("--predictions", type=int, default=300)
    parser.add_argument("--spread", type=float, default=1.0, help="standard deviation of a row")
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.file:
        print(json.dumps(measured(arguments.file, arguments.predictions)))
        return
    report = {
        str(n): in_a_process(n, arguments.spread, arguments.predictions)
        for n in arguments.examples
    }
    print(json.dumps(report, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


def in_a_process(n: int, spread: float, n_predictions: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.npz"
        save_model(synthetic(n, spread), file)
        command = [sys.executable, __file__, "--file", str(file)]
        command += ["--predictions", str(n_predictions)]
        done = subprocess.run(command, capture_output=True, check=True, text=True)
        return {**json.loads(done.stdout), "file_mb": file.stat().st_size / 1e6}


def synthetic(n: int, spread: float) -> Model:
    rng = np.random.default_rng(0)
    covariances = np.empty((n, 6, 6))
    for start in range(0, n, 10**5):
        A = rng.normal(size=(min(10**5, n - start), 6, 9)).round(1)  # few digits: a smaller file
        covariances[start : start + 10**5] = A @ np.swapaxes(A, 1, 2)
    return Model(
        theta=rng.normal(size=(R, D)) * spread / np.sqrt(D),
        mean=np.zeros(D),
        scale=np.ones(D),
        projections=(rng.normal(size=(n, R)) * spread).round(2),
        covariances=covariances,
        shape="sandwich",
        mean_weight=0.15,
    )


def measured(file: Path, n_predictions: int) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    begin = time.perf_counter()
    model = load_model(file)
    load_s = time.perf_counter() - begin
    wall, cpu, neighbors = [], [], []
    with threadpool_limits(1, user_api="blas"):
        begin = time.perf_counter()
        predict(model, rng.normal(size=D), np.eye(6))
        first_s = time.perf_counter() - begin
        for d in rng.normal(size=(n_predictions, D)):
            begin, used = time.perf_counter(), time.process_time()
            found = predict(model, d, np.eye(6))
            cpu.append(1e3 * (time.process_time() - used))
            wall.append(1e3 * (time.perf_counter() - begin))
            neighbors.append(found.effective_neighbors)
    return {
        "p50_ms": float(np.percentile(wall, 50)),
        "p95_ms": float(np.percentile(wall, 95)),
        "cpu_p50_ms": float(np.percentile(cpu, 50)),
        "cpu_p95_ms": float(np.percentile(cpu, 95)),
        "peak_memory_mb": peak_memory_mb(),
        "load_s": load_s,
        "first_prediction_s": first_s,
        "median_effective_neighbors": float(np.median(neighbors)),
    }


def peak_memory_mb() -> float:
    """Return the most that this process held; ``ru_maxrss`` would count its parent's too."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    main()
