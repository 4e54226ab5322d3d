"""A model on real recordings, judged by joint reference poses: one line a recording.

    python benchmarks/real.py --data FOLDER --cache FOLDER [--model general] [--samples 200]

FOLDER holds recordings.  Each is aligned from its clouds (recordings named still_* by their own,
exact poses), sampled and judged; what is done is kept in the cache, so that the same command goes
on.  Columns: pairs; expected error of a step; D2/6; share in 95 %; median KL; share of pairs that
the model calls unknown; scans left out.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from cello3d_ros.config import Config, NodeConfig, sections_of
from cello3d_ros.covariance.lost import is_lost
from cello3d_ros.covariance.model import Model, find_model, load_model
from cello3d_ros.errors import Cello3dError
from cello3d_ros.learning.align_report import sentences
from cello3d_ros.learning.align_sweeps import AlignSettings
from cello3d_ros.learning.aligned import aligned_parts
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.learning.examples import answers, load_examples, select_inputs
from cello3d_ros.learning.measures import figures
from cello3d_ros.learning.sample import sample
from cello3d_ros.recordings import open_recording

EXACT = "still_"  # recordings named so have exact poses of their own
HEADING = (
    f"{'recording':20} {'pairs':>5} {'step mm':>8} {'D2/6':>8} {'in 95 %':>8} {'KL':>8} "
    f"{'unknown':>8} {'lost':>6} {'left out':>8} {'s':>6}"
)


def sampled(path: Path, cache: Path, model: Model, arguments: argparse.Namespace) -> dict:
    """Align and sample a recording unless that is done; return what is known of its poses."""
    folder = cache / path.name
    sampling = replace(
        model.sampling, n_samples=arguments.samples, max_gap=arguments.max_gap, precision=0.0
    )
    sections = sections_of(model.pipeline)
    config = Config(**sections, sampling=sampling)
    if path.name.startswith(EXACT):
        sample([path], folder, config, arguments.jobs)
        return {"sigma_m": 0.0, "n_left_out": 0, "told": []}
    settings = AlignSettings(model.pipeline, n_threads=arguments.jobs)
    parts = aligned_parts(open_recording(path), cache / f"{path.name}.joint", settings)
    found = parts[0].alignment
    sample(parts, folder, config, arguments.jobs)
    return {
        "sigma_m": found.sigmas()[0],
        "n_left_out": len(found.reasons),
        "told": list(sentences(found)),
    }


def judged(folder: Path, model: Model) -> dict:
    """Return the figures of a model on a dataset."""
    dataset = open_dataset(folder)
    names = {key[0] for key in dataset.pair_keys()}
    examples = select_inputs(load_examples([dataset], names), model.features)
    said = answers(model, examples)
    found = figures(np.array([answer.covariance for answer in said]), examples)
    quantile = NodeConfig().unknown_quantile
    sandwich = examples.shapes["sandwich"]
    return {
        "n_pairs": found.n_pairs,
        "dm2_over_6": found.dm2_over_6,
        "coverage_95": found.coverage_95,
        "kl_median": found.kl_median,
        "unknown": float(np.mean([answer.novelty > quantile for answer in said])),
        "lost": float(np.mean([is_lost(Y, model.lost) for Y in sandwich])),
    }


def main() -> None:
    """Print a line for each recording, then the geometric mean of those in motion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--model", default="general")
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--max-gap", type=int, default=4)
    parser.add_argument("--only", default="", help="names, divided by commas")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    model = load_model(find_model(arguments.model))
    arguments.cache.mkdir(parents=True, exist_ok=True)
    only = set(filter(None, arguments.only.split(",")))
    moving = []
    print(HEADING, flush=True)
    for path in sorted(arguments.data.iterdir()):
        if not path.is_dir() or (only and path.name not in only):
            continue
        start = time.monotonic()
        try:
            row = sampled(path, arguments.cache, model, arguments)
            row |= judged(arguments.cache / path.name, model)
        except Cello3dError as error:
            print(f"{path.name:20} {error}", flush=True)
            continue
        row |= {"seconds": time.monotonic() - start}
        (arguments.cache / f"{path.name}.json").write_text(json.dumps(row, indent=1) + "\n")
        if not path.name.startswith(EXACT):
            moving.append(row["dm2_over_6"])
        print(
            f"{path.name:20} {row['n_pairs']:5} {1e3 * row['sigma_m']:8.2f} "
            f"{row['dm2_over_6']:8.2f} {row['coverage_95']:8.2f} {row['kl_median']:8.2f} "
            f"{row['unknown']:8.2f} {row['lost']:6.2f} {row['n_left_out']:8} "
            f"{row['seconds']:6.0f}",
            flush=True,
        )
    if moving:
        print(f"in motion: geometric mean of D2/6 {np.exp(np.mean(np.log(moving))):.2f}")


if __name__ == "__main__":
    main()
