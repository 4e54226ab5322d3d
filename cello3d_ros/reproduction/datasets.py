"""Where the tables' recordings come from, and their sampled datasets, kept on disk."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cello3d_ros.config import PIPELINES, SamplingConfig
from cello3d_ros.errors import RecordingError
from cello3d_ros.learning.dataset import Dataset, open_dataset
from cello3d_ros.learning.sampling import pairs, sample_recording
from cello3d_ros.recordings import Recording, open_recording
from cello3d_ros.recordings.challenging import is_challenging, sequence_of
from cello3d_ros.reproduction.costs import Costs
from cello3d_ros.reproduction.sequences import SEQUENCES, counterpart

PAPER = PIPELINES["paper"]
_N_TURNS = 7  # of each pair about z

Recordings = Mapping[str, Recording]  # by the key of their sequence


@dataclass(frozen=True)
class Workshop:
    """Where intermediate results are kept, and how much work may be done at a time.

    seed: of the places of simulated recordings and of every random draw.
    """

    folder: Path
    n_samples: int
    n_threads: int
    seed: int
    costs: Costs

    @property
    def sampling(self) -> SamplingConfig:
        """The paper's settings with our number of samples."""
        return SamplingConfig(n_samples=self.n_samples, n_rotations=_N_TURNS, seed=self.seed)


def simulated(seed: int, n_scans: int | None = None) -> Recordings:
    """Return the simulated counterparts of all sequences, or their first scans."""
    return {key: counterpart(key, seed, n_scans) for key in SEQUENCES}


def recorded(folder: Path) -> Recordings:
    """Return the paper's sequences that lie in a folder, each a folder or zip archive.

    Raises RecordingError where there is none, or one twice.
    """
    keys = {s.folder: key for key, s in SEQUENCES.items()}
    found: dict[str, Recording] = {}
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")
    for path in sorted(folder.iterdir()):
        key = keys.get(sequence_of(path.stem) or "")
        if key is None or not is_challenging(path):
            continue
        if key in found:
            raise RecordingError(f"{folder}: holds {SEQUENCES[key].folder!r} twice: {path.name}")
        found[key] = open_recording(path)
    if not found:
        titles = ", ".join(repr(s.folder) for s in SEQUENCES.values())
        raise RecordingError(f"{folder}: holds none of the 'Challenging data sets' {titles}")
    return found


def sampled(workshop: Workshop, key: str, recording: Recording) -> Dataset:
    """Return the dataset of a recording; what is on disk is not sampled again.

    It is a folder as ``cello3d sample`` makes it, with the paper's pipeline.
    """
    name, sampling = f"{key}-{workshop.seed}", workshop.sampling
    dataset = open_dataset(workshop.folder / name, PAPER, sampling, create=True)
    dataset.add_recording(recording.name, {"n_scans": len(recording)})
    wanted = pairs(len(recording), sampling.max_gap)
    done = dataset.outcomes(recording.name, wanted, workshop.n_threads)
    todo = [ij for ij in wanted if ij not in done]
    if todo:
        print(f"{name}: sampling {len(todo)} pairs of {recording.name}", file=sys.stderr)
    with workshop.costs.of(f"sampling {name}"):
        for record in sample_recording(
            recording, todo, dataset.pipeline, sampling, workshop.n_threads
        ):
            dataset.write(record)
    return dataset
