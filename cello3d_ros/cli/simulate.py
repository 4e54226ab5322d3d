"""``cello3d simulate WORLD --out BAG``: scan a simulated world into a rosbag2, or many."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import fields, replace
from pathlib import Path

from cello3d_ros.cli.sources import with_progress
from cello3d_ros.errors import RecordingError
from cello3d_ros.simulation.rescan import KEY, told
from cello3d_ros.simulation.scanner import SCANNERS, Scanner
from cello3d_ros.simulation.simulation import Simulation
from cello3d_ros.simulation.worlds import WORLDS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    names = ", ".join(WORLDS)
    parser.add_argument("world", metavar="WORLD", type=_world, help=f"{names} or a YAML file")
    parser.add_argument("--seed", type=int, default=0, help="seed of layout, path and noise")
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="N bags OUT/WORLD-SEED, of this and later seeds"
    )
    parser.add_argument("--scans", type=int, default=25, help="number of scans, 0.5 s apart")
    parser.add_argument("--path", type=Path, metavar="FILE", help="TUM poses of the sensor")
    parser.add_argument(
        "--scanner", choices=SCANNERS, default="spinning32", help="kind of lidar (spinning32)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change a property of the scanner, such as range_noise_m=0.03",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="BAG", help="rosbag2 folder to make (mcap)"
    )


def run(arguments: argparse.Namespace) -> None:
    """Write the bags.  Raises RecordingError if a name is taken or Open3D is missing."""
    from cello3d_ros.recordings.bag_writer import write_bag

    scanner = changed(SCANNERS[arguments.scanner], arguments.set)
    n_seeds = 1 if arguments.seeds is None else arguments.seeds
    if n_seeds < 1:
        raise RecordingError(f"--seeds must be at least 1: {n_seeds}")
    for seed in range(arguments.seed, arguments.seed + n_seeds):
        simulation = Simulation(
            str(arguments.world), seed, arguments.scans, scanner, arguments.path
        )
        out = arguments.out if arguments.seeds is None else arguments.out / simulation.name
        progress = with_progress(simulation, len(simulation), simulation.name)
        provenance = {"made_by": _command(arguments, seed), KEY: told(simulation)}
        write_bag(out, progress, provenance=provenance)
        print(f"{out}: {len(simulation)} scans of {simulation.name}")


def changed(scanner: Scanner, settings: list[str]) -> Scanner:
    """Return a scanner with some properties changed.  Raises RecordingError or ConfigError."""
    known = {field.name: getattr(scanner, field.name) for field in fields(scanner)}
    values = {}
    for setting in settings:
        name, _, text = setting.partition("=")
        if name not in known:
            raise RecordingError(f"--set {setting}: known are {', '.join(known)}")
        try:
            values[name] = type(known[name])(text)
        except ValueError:
            raise RecordingError(f"--set {setting}: {text!r} is no number") from None
    return replace(scanner, **values)


def _world(text: str) -> str:
    if text in WORLDS or text.endswith((".yaml", ".yml")):
        return text
    raise argparse.ArgumentTypeError(f"{text!r} is not {', '.join(WORLDS)} or a YAML file")


def _command(arguments: argparse.Namespace, seed: int) -> str:
    command = (
        f"cello3d simulate {shlex.quote(arguments.world)} --seed {seed} --scans {arguments.scans} "
        f"--scanner {arguments.scanner}"
    )
    if arguments.path is not None:
        command += f" --path {shlex.quote(str(arguments.path))}"
    return command + "".join(f" --set {shlex.quote(setting)}" for setting in arguments.set)
