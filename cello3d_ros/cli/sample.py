"""``cello3d sample RECORDING... --out DATASET``: brute force on every pair, resumable."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

from cello3d_ros.config import Config, load_config, pipeline_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="bag or data set")
    parser.add_argument(
        "--out", required=True, metavar="DATASET", help="folder to write or resume"
    )
    parser.add_argument("--config", metavar="FILE", help="YAML settings; flags below win")
    parser.add_argument("--samples", type=int, metavar="N", help="registrations of each pair")
    parser.add_argument("--variance", type=float, metavar="A", help="of the starts (m^2, rad^2)")
    parser.add_argument("--seed", type=int, help="seed of every random draw")
    parser.add_argument("--max-gap", type=int, metavar="G", help="largest j - i of a pair")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="threads"
    )


def run(arguments: argparse.Namespace) -> None:
    """Sample what is missing; the same command finishes what was interrupted."""
    from tqdm import tqdm

    from cello3d_ros.learning.dataset import open_dataset
    from cello3d_ros.learning.pairs import pairs
    from cello3d_ros.learning.sampling import sample_recording
    from cello3d_ros.recordings import open_recording

    config = load_config(arguments.config) if arguments.config else Config()
    flags = {
        "n_samples": arguments.samples,
        "variance": arguments.variance,
        "seed": arguments.seed,
        "max_gap": arguments.max_gap,
    }
    sampling = replace(config.sampling, **{k: v for k, v in flags.items() if v is not None})
    pipeline = pipeline_of(config)
    recordings = [open_recording(Path(path)) for path in arguments.recordings]
    dataset = open_dataset(arguments.out, pipeline, sampling, create=True)
    for recording in recordings:
        dataset.add_recording(recording.name, {"n_scans": len(recording)})
    n_accepted = n_rejected = 0
    total = sum(len(pairs(len(recording), sampling.max_gap)) for recording in recordings)
    with tqdm(total=total, unit="pair", disable=not sys.stderr.isatty()) as bar:
        for recording in recordings:
            name = recording.name
            todo = [
                ij for ij in pairs(len(recording), sampling.max_gap) if not dataset.has(name, *ij)
            ]
            bar.update(len(pairs(len(recording), sampling.max_gap)) - len(todo))
            for record in sample_recording(recording, todo, pipeline, sampling, arguments.jobs):
                dataset.write(record)
                bar.update()
        for record in dataset:
            n_accepted += record.accepted
            n_rejected += not record.accepted
    print(f"{arguments.out}: {n_accepted} pairs accepted, {n_rejected} rejected")
