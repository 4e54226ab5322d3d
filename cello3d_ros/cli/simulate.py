"""``cello3d simulate WORLD --out BAG``: scan a simulated world into a rosbag2."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cello3d_ros.recordings.scanner import SCANNERS
from cello3d_ros.recordings.simulation import Simulation
from cello3d_ros.recordings.worlds import WORLDS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("world", metavar="WORLD", choices=WORLDS, help=", ".join(WORLDS))
    parser.add_argument("--seed", type=int, default=0, help="seed of layout, path and noise")
    parser.add_argument("--scans", type=int, default=25, help="number of scans, 0.5 s apart")
    parser.add_argument(
        "--scanner", choices=SCANNERS, default="spinning32", help="kind of lidar (spinning32)"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="BAG", help="rosbag2 folder to make (mcap)"
    )


def run(arguments: argparse.Namespace) -> None:
    """Write the bag.  Raises RecordingError if its name is taken or Open3D is missing."""
    from tqdm import tqdm

    from cello3d_ros.recordings.bag import write_bag

    simulation = Simulation(
        arguments.world, arguments.seed, arguments.scans, SCANNERS[arguments.scanner]
    )
    progress = tqdm(
        simulation, desc=simulation.name, unit="scan", disable=not sys.stderr.isatty(), leave=False
    )
    command = (
        f"cello3d simulate {arguments.world} --seed {arguments.seed} --scans {arguments.scans} "
        f"--scanner {arguments.scanner}"
    )
    write_bag(arguments.out, progress, provenance={"made_by": command})
    print(f"{arguments.out}: {len(simulation)} scans of {simulation.name}")
