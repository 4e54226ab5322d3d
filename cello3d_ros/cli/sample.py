"""``cello3d sample RECORDING... --out DATASET``: brute force on every pair, resumable."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cello3d_ros.config import Config, SamplingConfig, load_config, pipeline_of
from cello3d_ros.errors import ConfigError

if TYPE_CHECKING:
    from cello3d_ros.learning.dataset import Dataset, PairRecord
    from cello3d_ros.recordings.recording import Recording

    Sampler = Callable[[Recording, list[tuple[int, int]]], Iterator[PairRecord]]

_PRECISION = 0.05  # of ``--samples adaptive``: 800 Gaussian samples reach it
_BLOCK = 1000  # registrations of one task: docs/cluster.md says why


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="bag or data set")
    parser.add_argument(
        "--out", required=True, metavar="DATASET", help="folder to write or resume"
    )
    parser.add_argument("--config", metavar="FILE", help="YAML settings; flags below win")
    parser.add_argument(
        "--samples",
        type=_samples,
        metavar="N",
        help="registrations of each pair, or adaptive: until the covariance is known to "
        f"--precision (default {_PRECISION}), within min_samples and n_samples of the settings",
    )
    parser.add_argument(
        "--precision", type=float, metavar="P", help="relative standard error of eigenvalues"
    )
    parser.add_argument("--variance", type=float, metavar="A", help="of the starts (m^2, rad^2)")
    parser.add_argument(
        "--noise",
        type=float,
        metavar="SIGMA",
        help="standard deviation of ranges at each registration, m: of noise added to recorded "
        "clouds, or of new scans where the recording was made by cello3d simulate",
    )
    parser.add_argument("--seed", type=int, help="seed of every random draw")
    parser.add_argument("--max-gap", type=int, metavar="G", help="largest j - i of a pair")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="threads"
    )
    cluster = parser.add_argument_group("on a Dask cluster (docs/cluster.md)")
    cluster.add_argument("--scheduler", metavar="ADDRESS", help="such as tcp://host:8786")
    cluster.add_argument(
        "--ship-clouds", action="store_true", help="send the scans: workers cannot read them"
    )
    cluster.add_argument(
        "--block", type=int, default=_BLOCK, metavar="N", help="registrations of one task"
    )


def run(arguments: argparse.Namespace) -> None:
    """Sample what is missing; the same command finishes what was interrupted."""
    from threadpoolctl import threadpool_limits

    from cello3d_ros.learning.dataset import open_dataset
    from cello3d_ros.learning.identity import fingerprint, scan_prints
    from cello3d_ros.recordings import open_recording
    from cello3d_ros.simulation.rescan import rescannable
    from cello3d_ros.simulation.simulation import Simulation

    config = load_config(arguments.config) if arguments.config else Config()
    sampling = _sampling(config, arguments)
    pipeline = pipeline_of(config)
    opened = rescannable if sampling.noise_m > 0.0 else open_recording
    recordings = [opened(Path(path)) for path in arguments.recordings]
    names = Counter(recording.name for recording in recordings)
    if twice := [name for name, n in names.items() if n > 1]:
        raise ConfigError(f"two recordings are named {twice[0]!r}: their pairs would mix")
    paths = dict(zip(names, arguments.recordings))
    with _progress() as bar, _sampler(arguments, pipeline, sampling, paths, bar) as sampler:
        dataset = open_dataset(arguments.out, pipeline, sampling, create=True)
        for recording in recordings:
            bar.set_description(f"reading {recording.name}")
            facts: dict[str, Any] = {"n_scans": len(recording)}
            facts["fingerprint"] = fingerprint(recording)
            known = dataset.recordings.get(recording.name, {})
            if scans := known.get("scans") or scan_prints(recording):
                facts["scans"] = scans
            if sampling.noise_m > 0.0:
                facts["noise"] = "rescans" if isinstance(recording, Simulation) else "added"
            dataset.add_recording(recording.name, facts)
        try:
            with threadpool_limits(1, user_api="blas"):  # its threads take the kernels' cores
                outcomes = _sample(recordings, dataset, sampler, bar, arguments.jobs)
        except SystemError as error:  # what CPython makes of Ctrl-C in a compiled kernel
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise error.__cause__ from None
            raise
    print(f"{arguments.out}: {_summary(outcomes)}")


def _sample(
    recordings: list[Recording], dataset: Dataset, sampler: Sampler, bar: Any, n_threads: int
) -> Counter[str]:
    """Sample what is missing of all recordings; return how often each outcome occurs."""
    from cello3d_ros.learning.pairs import pairs

    n_samples = dataset.sampling.n_samples
    outcomes: Counter[str] = Counter()
    todo = {}
    bar.set_description("checking what is done")
    for recording in recordings:
        wanted = pairs(len(recording), dataset.sampling.max_gap)
        done = dataset.outcomes(recording.name, wanted, n_threads)
        outcomes.update(done.values())
        todo[recording.name] = [ij for ij in wanted if ij not in done]
    n_pairs = sum(outcomes.values()) + sum(map(len, todo.values()))
    bar.reset(total=n_samples * sum(map(len, todo.values())))
    for recording in recordings:
        bar.set_description(recording.name)
        bar.set_postfix_str(f"pair {sum(outcomes.values())} of {n_pairs}")
        for record in sampler(recording, todo[recording.name]):
            dataset.write(record)
            outcomes[record.reason] += 1
            bar.total -= n_samples - record.n_samples  # a rejected pair or one that ended early
            bar.set_postfix_str(f"pair {sum(outcomes.values())} of {n_pairs}")
    return outcomes


@contextmanager
def _sampler(
    arguments: argparse.Namespace,
    pipeline: Any,
    sampling: SamplingConfig,
    paths: dict[str, str],
    bar: Any,
) -> Iterator[Sampler]:
    """Give the function that samples some pairs of a recording, here or on a cluster."""
    if not arguments.scheduler:
        from cello3d_ros.learning.sampling import sample_recording

        yield lambda recording, todo: sample_recording(
            recording, todo, pipeline, sampling, arguments.jobs, bar.update
        )
        return
    if arguments.block < 1:
        raise ConfigError(f"--block must be at least 1: {arguments.block}")
    import logging

    from cello3d_ros.learning.cluster import Job, connected, sample_recording_on

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are said once, by us
    with connected(arguments.scheduler) as client:
        if not client.nthreads():
            print(f"cello3d: {arguments.scheduler} has no worker yet, waiting", file=sys.stderr)
        yield lambda recording, todo: sample_recording_on(
            client,
            recording,
            todo,
            Job(
                name=recording.name,
                path=str(Path(paths[recording.name]).resolve()),
                pipeline=pipeline,
                sampling=sampling,
            ),
            arguments.block,
            arguments.ship_clouds,
            bar.update,
        )


def _progress() -> Any:
    """Return a bar that counts registrations, with their rate and the time left."""
    from tqdm import tqdm

    return tqdm(
        total=0, unit="reg", unit_scale=True, disable=not sys.stderr.isatty(), smoothing=0.1
    )


def _sampling(config: Config, arguments: argparse.Namespace) -> SamplingConfig:
    """Return the settings with the flags that were given."""
    adaptive = arguments.samples == "adaptive"
    flags = {
        "n_samples": None if adaptive else arguments.samples,
        "precision": arguments.precision,
        "variance": arguments.variance,
        "noise_m": arguments.noise,
        "seed": arguments.seed,
        "max_gap": arguments.max_gap,
    }
    if adaptive and arguments.precision is None:
        flags["precision"] = config.sampling.precision or _PRECISION
    return replace(config.sampling, **{k: v for k, v in flags.items() if v is not None})


def _samples(text: str) -> int | str:
    return text if text == "adaptive" else int(text)


def _summary(outcomes: Counter[str]) -> str:
    reasons = {reason: n for reason, n in sorted(outcomes.items()) if reason}
    told = ", ".join(f"{reason} {n}" for reason, n in reasons.items())
    rejected = f"{sum(reasons.values())} rejected" + (f" ({told})" if told else "")
    return f"{outcomes['']} pairs accepted, {rejected}"
