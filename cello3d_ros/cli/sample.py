"""``cello3d sample RECORDING... --out DATASET``: brute force on every pair, resumable."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.cli.arguments import (
    add_jobs_argument,
    add_pipeline_argument,
    add_seed_argument,
    positive,
)
from cello3d_ros.config import Config, SamplingConfig, config_from, load_config, pipeline_of
from cello3d_ros.errors import ConfigError

if TYPE_CHECKING:
    from cello3d_ros.learning.dataset import PairRecord
    from cello3d_ros.learning.sample import Sampler, Status
    from cello3d_ros.learning.sampling import Progress
    from cello3d_ros.recordings.recording import Recording

_PRECISION = 0.05  # of ``--samples adaptive``: 800 Gaussian samples reach it
_BLOCK = 1000  # registrations of one task: docs/cluster.md says why


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="bag or data set")
    parser.add_argument(
        "--out", required=True, metavar="DATASET", help="folder to write or resume"
    )
    parser.add_argument("--config", metavar="FILE", help="YAML settings; flags below win")
    add_pipeline_argument(parser, "robot or what the settings name")
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
    add_seed_argument(parser, "of every random draw", default=None)
    parser.add_argument("--max-gap", type=positive, metavar="G", help="largest j - i of a pair")
    add_jobs_argument(parser)
    parser.add_argument(
        "--poses",
        choices=("recorded", "joint"),
        default="recorded",
        help="ground truth: as recorded, or joint poses found in the clouds (docs/align.md)",
    )
    cluster = parser.add_argument_group("on a Dask cluster (docs/cluster.md)")
    cluster.add_argument("--scheduler", metavar="ADDRESS", help="such as tcp://host:8786")
    cluster.add_argument(
        "--ship-clouds", action="store_true", help="send the scans: workers cannot read them"
    )
    cluster.add_argument(
        "--block", type=positive, default=_BLOCK, metavar="N", help="registrations of one task"
    )


def run(arguments: argparse.Namespace) -> None:
    """Sample what is missing; the same command finishes what was interrupted."""
    from cello3d_ros.learning.sample import sample

    config = _config(arguments)
    config = replace(config, sampling=_sampling(config, arguments))
    recordings = arguments.recordings
    if arguments.poses == "joint":
        from cello3d_ros.cli.align import joint

        if arguments.scheduler and not arguments.ship_clouds:
            raise ConfigError("--poses joint needs --ship-clouds: workers have no joint poses")
        recordings = joint(recordings, Path(arguments.out), config, arguments.jobs)
    with progress_bar() as report, _sampler(arguments, config) as sampler:
        outcomes = sample(recordings, arguments.out, config, arguments.jobs, report, sampler)
    print(f"{arguments.out}: {_summary(outcomes)}")


@contextmanager
def _sampler(arguments: argparse.Namespace, config: Config) -> Iterator[Sampler | None]:
    """Give the function that samples some pairs of a recording on a cluster, if one is named."""
    if not arguments.scheduler:
        yield None
        return
    if config.sampling.n_views > 1:
        raise ConfigError("sampling.n_views needs the simulated world: leave --scheduler out")
    import logging

    from cello3d_ros.learning.cluster import Job, connected, sample_recording_on

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are said once, by us
    with connected(arguments.scheduler) as client:
        if not client.nthreads():
            print(f"cello3d: {arguments.scheduler} has no worker yet, waiting", file=sys.stderr)

        def there(
            recording: Recording, path: str, todo: list[tuple[int, int]], progress: Progress
        ) -> Iterator[PairRecord]:
            job = Job(
                name=recording.name,
                path=str(Path(path).resolve()),
                pipeline=pipeline_of(config),
                sampling=config.sampling,
                block=arguments.block,
                ship_clouds=arguments.ship_clouds,
            )
            return sample_recording_on(client, recording, todo, job, progress)

        yield there


@contextmanager
def progress_bar() -> Iterator[Callable[[Status], None]]:
    """Give a bar that counts registrations, with their rate and the time left."""
    from tqdm import tqdm

    with tqdm(
        total=0, unit="reg", unit_scale=True, disable=not sys.stderr.isatty(), smoothing=0.1
    ) as bar:
        what = ""

        def show(status: Status) -> None:
            nonlocal what
            bar.total = status.n_total
            bar.set_postfix_str(f"pair {status.n_pairs} of {status.n_pairs_total}", refresh=False)
            bar.set_description(status.what, refresh=status.what != what)
            what = status.what
            bar.update(status.n_registrations - bar.n)

        yield show


def _config(arguments: argparse.Namespace) -> Config:
    """Return the settings of the pipeline and the file that were named."""
    if arguments.config:
        return load_config(arguments.config, arguments.pipeline)
    return config_from({"pipeline": arguments.pipeline or "robot"})


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
    return text if text == "adaptive" else positive(text)


def _summary(outcomes: Counter[str]) -> str:
    reasons = {reason: n for reason, n in sorted(outcomes.items()) if reason}
    told = ", ".join(f"{reason} {n}" for reason, n in reasons.items())
    rejected = f"{sum(reasons.values())} rejected" + (f" ({told})" if told else "")
    return f"{outcomes['']} pairs accepted, {rejected}"
