"""``cello3d reproduce WHAT``: the paper's tables and figures, with data, pictures and a page."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.cli.arguments import add_jobs_argument, add_seed_argument, positive
from cello3d_ros.errors import Cello3dError

if TYPE_CHECKING:
    from cello3d_ros.reproduction.datasets import Workshop
    from cello3d_ros.reproduction.result import Result

#: Registrations of each by default, so that all ends within an hour; the paper has 5000.
_N_SAMPLES = {
    "table1": 250,
    "table2": 250,
    "readings": 250,
    "fig-objective": 300,
    "fig-noise": 200,
    "fig-cylinder": 3000,
    "fig-hallway": 2000,
    "fig-trajectories": 250,
}
_FEWEST_SAMPLES = 50  # that a cluster can be told from: learning/clustering.py
_ON_RECORDINGS = ("table1", "table2", "readings", "fig-trajectories")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("what", choices=[*_N_SAMPLES, "all"], metavar="WHAT", help=_choices())
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("build/reproduce"),
        metavar="DIR",
        help="data, pictures and the datasets kept for the next run (build/reproduce)",
    )
    parser.add_argument(
        "--samples",
        type=positive,
        metavar="N",
        help="registrations of each pair, 5000 in the paper; by default 250 for tables, and what "
        "a figure needs",
    )
    parser.add_argument(
        "--scans", type=positive, metavar="N", help="of each simulation, by default all"
    )
    parser.add_argument(
        "--places",
        type=positive,
        default=1,
        metavar="N",
        help="simulated places of each kind, of successive seeds (1)",
    )
    parser.add_argument(
        "--runs", type=positive, default=100, metavar="N", help="odometries of a recording (100)"
    )
    add_seed_argument(parser, "of places and random draws (0)")
    add_jobs_argument(parser)
    _add_places(parser)


def _add_places(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data",
        type=Path,
        metavar="FOLDER",
        help="the paper's own sequences, folders or zip archives, in place of simulated ones",
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="FILE",
        help="Markdown page whose sections are written (DIR/results.md)",
    )


def run(arguments: argparse.Namespace) -> None:
    """Make what was asked for, each published as soon as it is done."""
    if arguments.samples is not None and arguments.samples < _FEWEST_SAMPLES:
        raise Cello3dError(f"--samples must be at least {_FEWEST_SAMPLES}: {arguments.samples}")
    if arguments.scans == 1:
        raise Cello3dError("--scans must be at least 2: odometry needs two scans")
    if arguments.data and arguments.places > 1:
        raise Cello3dError("--places is for simulated places, --data has one of each kind")
    wanted = list(_N_SAMPLES) if arguments.what == "all" else [arguments.what]
    if arguments.data and not set(wanted) & set(_ON_RECORDINGS):
        raise Cello3dError(f"--data is for {', '.join(_ON_RECORDINGS)}, not {arguments.what}")
    for what in wanted:
        _make(what, arguments)


def _make(what: str, arguments: argparse.Namespace) -> None:
    from cello3d_ros.reproduction.costs import Costs
    from cello3d_ros.reproduction.datasets import Workshop
    from cello3d_ros.reproduction.result import publish

    out: Path = arguments.out
    n_samples = arguments.samples or _N_SAMPLES[what]
    folder = out / ("datasets-recorded" if arguments.data else "datasets")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Cello3dError(f"cannot make {folder}: {error.strerror}") from None
    costs = Costs(folder / "costs.json")
    workshop = Workshop(folder, n_samples, arguments.jobs, arguments.seed, costs)
    start = time.process_time()
    if what in _ON_RECORDINGS:
        result = _on_recordings(what, workshop, arguments)
    else:
        result = _figure(what)(n_samples, arguments.jobs, arguments.seed)
    cpu_s = time.process_time() - start + costs.earlier()
    page = arguments.results or out / "results.md"
    publish(result, out, page, _command(result.what, arguments), cpu_s)
    print(f"{result.what}: {cpu_s:.0f} s of processor time; {out}/{result.what}.png, {page}")


def _on_recordings(what: str, workshop: Workshop, arguments: argparse.Namespace) -> Result:
    """Make a table or figure of recordings, the paper's or simulated ones."""
    from dataclasses import replace

    from cello3d_ros.reproduction import datasets, readings, table1, table2, trajectories
    from cello3d_ros.reproduction.models import Place

    if arguments.data:
        places = [Place(workshop, datasets.recorded(arguments.data))]
        source = "on the paper's own data"
    else:
        seeds = range(arguments.seed, arguments.seed + arguments.places)
        places = [
            Place(replace(workshop, seed=seed), datasets.simulated(seed, arguments.scans))
            for seed in seeds
        ]
        source = "on simulated counterparts"
    if what == "table1":
        result = table1.make(places, source)
    elif what == "table2":
        result = table2.make(places, arguments.runs, source)
    elif what == "readings":
        result = readings.make(places[0], source)
    else:
        result = trajectories.make(places[0])
    if arguments.data:
        return result._replace(
            what=f"{what}-recorded", title=f"{result.title}, on the paper's data"
        )
    return result


def _figure(what: str) -> Callable[[int, int, int], Result]:
    from cello3d_ros.reproduction import cylinder, hallway, noise, objective

    return {
        "fig-objective": objective.make,
        "fig-noise": noise.make,
        "fig-cylinder": cylinder.make,
        "fig-hallway": hallway.make,
    }[what]


def _command(what: str, arguments: argparse.Namespace) -> str:
    """Return the command that makes one section again, without what is where it is written."""
    words = ["cello3d", "reproduce", what.removesuffix("-recorded")]
    flags: dict[str, object] = {}
    if arguments.samples is not None:
        flags["--samples"] = arguments.samples
    for name, default in (("scans", None), ("places", 1), ("runs", 100), ("seed", 0)):
        if (value := getattr(arguments, name)) != default:
            flags[f"--{name}"] = value
    if arguments.data:
        flags["--data"] = "FOLDER"
    return " ".join(words + [shlex.quote(str(w)) for item in flags.items() for w in item])


def _choices() -> str:
    return ", ".join([*_N_SAMPLES, "all"])
