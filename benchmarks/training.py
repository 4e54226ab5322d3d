"""What training costs: ``python benchmarks/training.py [--json FILE]``.

1000 pairs of 10 recordings, each turned 7 times, with 704 features: a Theta of each form is
searched for as many iterations as asked, from random features, on which the search goes on to the
last iteration.  Seconds are of the wall clock; they include reading nothing and writing nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np

from cello3d_ros.config import TrainingConfig
from cello3d_ros.learning.examples import Examples
from cello3d_ros.learning.training import fit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--rotations", type=int, default=7)
    parser.add_argument("--features", type=int, default=704)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--theta", nargs="+", default=["upper_triangular", "low_rank", "diagonal"])
    arguments = parser.parse_args()
    examples = synthetic(arguments.pairs, arguments.rotations, arguments.features)
    report: dict[str, object] = {"cores": os.cpu_count()}
    for theta in arguments.theta:
        config = TrainingConfig(
            shape="none",
            features="descriptor",
            theta=theta,
            regularization=0.0,
            max_iterations=arguments.iterations,
        )
        begin, used = time.perf_counter(), time.process_time()
        training = fit(examples, config)
        report[theta] = {
            "iterations": training.n_iterations,
            "seconds": round(time.perf_counter() - begin, 2),
            "cpu_seconds": round(time.process_time() - used, 2),
            "loss": [training.curve[0][1], training.curve[-1][1]],
        }
    print(json.dumps(report, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


def synthetic(n_pairs: int, n_rotations: int, n_features: int) -> Examples:
    """Covariances whose size follows the first feature, so that there is something to learn."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(n_pairs, n_rotations, n_features)).astype(np.float32)
    sizes = np.exp(features[:, 0, 0].astype(np.float64))
    features[:, :, 0] = features[:, :1, 0]
    A = 1e-2 * rng.normal(size=(n_pairs, 6, 12))
    return Examples(
        features=features,
        covariances=sizes[:, None, None] * (A @ np.swapaxes(A, 1, 2)),
        motions=rng.normal(size=(n_pairs, 2)),
        groups=np.array([f"recording{k % 10}" for k in range(n_pairs)]),
        shapes={},
        rotations_rad=2.0 * np.pi * np.arange(n_rotations) / n_rotations,
    )


if __name__ == "__main__":
    main()
