"""``cello3d simulate WORLD --out BAG``: scan a simulated world into a rosbag2, or many."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

from cello3d_ros.cli.arguments import add_seed_argument, positive
from cello3d_ros.cli.sources import check_folder, with_progress
from cello3d_ros.errors import RecordingError, counted
from cello3d_ros.simulation.drives import MOTIONS, Drive
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.rescan import KEY, told
from cello3d_ros.simulation.scanner import Scanner
from cello3d_ros.simulation.simulation import Simulation, n_poses
from cello3d_ros.simulation.worlds import WORLDS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    names = ", ".join(WORLDS)
    parser.add_argument("world", metavar="WORLD", type=_world, help=f"{names} or a YAML file")
    add_seed_argument(parser, "of layout, path and noise")
    parser.add_argument(
        "--seeds",
        type=positive,
        metavar="N",
        help="N bags OUT/WORLD-SEED, of this and later seeds",
    )
    parser.add_argument(
        "--scans",
        type=positive,
        metavar="N",
        help="number of scans (25; with --path all of its poses)",
    )
    parser.add_argument(
        "--drive",
        choices=MOTIONS,
        help="a robot carries the scanner and sweeps while it moves (else a walk, 0.5 s a scan)",
    )
    parser.add_argument("--path", type=Path, metavar="FILE", help="TUM poses of the sensor")
    parser.add_argument(
        "--scanner",
        choices=SCANNERS,
        metavar="NAME",
        default="spinning32",
        help=f"lidar (spinning32): {', '.join(SCANNERS)}",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change a property of the scanner, such as range_noise_m=0.03, or of the drive, "
        "such as speed_m_s=8",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="BAG", help="rosbag2 folder to make (mcap)"
    )


def run(arguments: argparse.Namespace) -> None:
    """Write the bags.  Raises RecordingError if a name is taken or embreex is missing."""
    from cello3d_ros.recordings.bag_writer import ODOMETRY_PER_SCAN, write_bag

    scanner, drive = _configured(arguments)
    n_seeds = 1 if arguments.seeds is None else arguments.seeds
    if arguments.seeds is None:
        check_folder(arguments.out)
    if arguments.scans is None:
        arguments.scans = 25 if arguments.path is None else n_poses(arguments.path)
    for seed in range(arguments.seed, arguments.seed + n_seeds):
        simulation = Simulation(
            str(arguments.world), seed, arguments.scans, scanner, arguments.path, drive=drive
        )
        out = arguments.out if arguments.seeds is None else arguments.out / simulation.name
        progress = with_progress(simulation, len(simulation), simulation.name)
        provenance = {"made_by": _command(arguments, seed), KEY: told(simulation)}
        odometry = ODOMETRY_PER_SCAN if drive is None else simulation.track()
        write_bag(out, progress, odometry=odometry, provenance=provenance)
        print(f"{out}: {counted(len(simulation), 'scan')} of {simulation.name}")


def _configured(arguments: argparse.Namespace) -> tuple[Scanner, Drive | None]:
    """Return the scanner and the drive with what ``--set`` changes."""
    scanner = SCANNERS[arguments.scanner]
    if arguments.drive is None:
        return changed(scanner, arguments.set), None
    drive = Drive(motion=arguments.drive)
    known = {field.name for field in fields(Drive)} - {"motion"}
    of_drive = [setting for setting in arguments.set if setting.partition("=")[0] in known]
    rest = [setting for setting in arguments.set if setting not in of_drive]
    return changed(scanner, rest), changed(drive, of_drive)


T = TypeVar("T", Scanner, Drive)


def changed(thing: T, settings: list[str]) -> T:
    """Return a scanner or drive with some properties changed.

    Raises RecordingError or ConfigError.
    """
    known = {field.name: getattr(thing, field.name) for field in fields(thing)}
    values = {}
    for setting in settings:
        name, _, text = setting.partition("=")
        if name not in known:
            raise RecordingError(f"--set {setting}: known are {', '.join(known)}")
        try:
            values[name] = _READ[type(known[name])](text)
        except (ValueError, KeyError):
            raise RecordingError(f"--set {setting}: {text!r} is no number") from None
    return replace(thing, **values)


_READ: dict[type, Callable[[str], Any]] = {
    int: int,
    float: float,
    str: str,
    bool: {"true": True, "false": False}.__getitem__,
    tuple: lambda text: tuple(float(part) for part in text.split(",")),
}


def _world(text: str) -> str:
    if text in WORLDS or text.endswith((".yaml", ".yml")):
        return text
    raise argparse.ArgumentTypeError(f"{text!r} is not {', '.join(WORLDS)} or a YAML file")


def _command(arguments: argparse.Namespace, seed: int) -> str:
    command = (
        f"cello3d simulate {shlex.quote(arguments.world)} --seed {seed} --scans {arguments.scans} "
        f"--scanner {arguments.scanner}"
    )
    if arguments.drive is not None:
        command += f" --drive {arguments.drive}"
    if arguments.path is not None:
        command += f" --path {shlex.quote(str(arguments.path))}"
    return command + "".join(f" --set {shlex.quote(setting)}" for setting in arguments.set)
