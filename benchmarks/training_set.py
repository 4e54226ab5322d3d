"""Sample the simulated data of the shipped model: robots of all kinds in worlds of all kinds.

    python benchmarks/training_set.py --out FOLDER [--part train|test|far] [--share 1.0] [--jobs 2]

The part "test" has seeds, worlds and robots of its own, and more places for each pair.  The part
"far" starts ICP as far off as the paper, for registrations that end in another minimum.  What is
done stays in the folder, so that the same command goes on.  ``--list`` prints the recordings.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cello3d_ros.config import Config, SamplingConfig
from cello3d_ros.learning.sample import sample
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS, calibrated
from cello3d_ros.simulation.scanner import Scanner
from cello3d_ros.simulation.simulation import Simulation

FIRST_SEED = {"train": 1000, "test": 5000, "far": 9000}
SAMPLING = {
    "train": SamplingConfig(n_samples=50, n_views=10, variance=0.0025, max_gap=2, n_rotations=1),
    "test": SamplingConfig(n_samples=60, n_views=15, variance=0.0025, max_gap=2, n_rotations=1),
    "far": SamplingConfig(n_samples=60, n_views=10, max_gap=2, n_rotations=1),
}
N_SCANS = 3
N_DRIVES = {"train": 24, "test": 6, "far": 4}  # of each world
N_WALKS = {"train": 6, "test": 4, "far": 2}  # of each world of the paper's kinds
WALKED = ("rooms", "hall", "corridor", "stairs", "garden", "wood")
OF_WALKS = ("spinning16", "spinning32", "spinning64", "wide")

#: World -> largest step (m), fastest robot (m/s), lowest and highest mount (m).
WORLDS = {
    "rooms": (0.8, 2.0, 0.3, 1.6),
    "hall": (1.5, 4.0, 0.3, 1.8),
    "corridor": (1.0, 3.0, 0.3, 1.6),
    "stairs": (0.6, 1.0, 0.5, 1.6),
    "garden": (1.5, 4.0, 0.4, 2.0),
    "wood": (1.5, 4.0, 0.5, 2.0),
    "garden_winter": (1.5, 4.0, 0.4, 2.0),
    "wood_autumn": (1.5, 4.0, 0.5, 2.0),
    "street": (3.0, 20.0, 0.8, 2.5),
    "highway": (3.0, 30.0, 1.2, 2.5),
    "tunnel": (3.0, 25.0, 0.8, 2.5),
    "field": (3.0, 10.0, 0.4, 2.5),
    "square": (3.0, 8.0, 0.3, 2.0),
    "harbour": (3.0, 8.0, 0.5, 2.5),
    "warehouse": (1.5, 5.0, 0.3, 2.5),
    "parking": (2.0, 6.0, 0.3, 2.0),
    "office": (0.8, 2.0, 0.3, 1.6),
}
MOTIONS = {
    "forward": 0.55,
    "reverse": 0.08,
    "sideways": 0.12,
    "stop_and_go": 0.1,
    "spin": 0.08,
    "still": 0.07,
}
RATES_HZ = (1.0, 2.0, 5.0, 10.0, 20.0)
LEAST_STEP_M = 0.04


def _coarse(name: str, azimuth_step_deg: float) -> Scanner:
    return replace(SCANNERS[name], azimuth_step_deg=azimuth_step_deg)


#: As they are sold, in their coarser modes where a scan would have 100 000 beams.
SOLD = {
    "vlp16": SCANNERS["vlp16"],
    "vlp32c": _coarse("vlp32c", 0.4),
    "hdl32e": _coarse("hdl32e", 0.32),
    "hdl64e": _coarse("hdl64e", 0.35),
    "os0_128": replace(SCANNERS["os0_128"], n_columns=512),
    "os1_64": SCANNERS["os1_64"],
    "os2_128": replace(SCANNERS["os2_128"], n_columns=512),
    "xt32": _coarse("xt32", 0.36),
    "pandar40p": _coarse("pandar40p", 0.4),
    "bpearl": _coarse("bpearl", 0.4),
    "m1": _coarse("m1", 0.3),
    "e1r": SCANNERS["e1r"],
    "mid360": SCANNERS["mid360"],
    "avia": SCANNERS["avia"],
    "tilting_line": _coarse("tilting_line", 0.5),
    "spinning16": SCANNERS["spinning16"],
    "spinning32": SCANNERS["spinning32"],
    "spinning64": SCANNERS["spinning64"],
}


class Kept(Simulation):
    """A simulation whose scans are computed once, as they are read several times."""

    def __iter__(self) -> Iterator[Scan]:
        if "scans" not in self.__dict__:
            self.__dict__["scans"] = list(super().__iter__())
        return iter(self.__dict__["scans"])


def recordings(part: str) -> list[Simulation]:
    """Return the recordings of a part, one of each world in turn."""
    first, found = FIRST_SEED[part], []
    for n in range(N_DRIVES[part]):
        found += [driven(world, first + n) for world in WORLDS]
        if n < N_WALKS[part]:
            found += [walked(world, first + 500 + n) for world in WALKED]
    return found


def driven(world: str, seed: int) -> Simulation:
    """Return a recording of a robot: its scanner, mount, motion and rate follow from the seed."""
    rng = np.random.default_rng([seed, list(WORLDS).index(world)])
    name = str(rng.choice(list(SOLD)))
    longest, fastest, low, high = WORLDS[world]
    motion = str(rng.choice(list(MOTIONS), p=list(MOTIONS.values())))
    step = float(np.exp(rng.uniform(np.log(LEAST_STEP_M), np.log(longest))))
    rates = [rate for rate in RATES_HZ if step * rate <= fastest] or [RATES_HZ[0]]
    rate = float(rng.choice(rates))
    drive = Drive(
        motion=motion,
        rate_hz=rate,
        speed_m_s=step * rate,
        turn_rad_s=float(rng.uniform(0.1, 0.5)) * min(rate, 4.0),
        sway_deg=float(rng.uniform(0.2, 1.5)),
        height_m=float(rng.uniform(low, high)),
        roll_deg=float(rng.normal(0.0, 2.0)),
        pitch_deg=float(rng.normal(0.0, 3.0)),
        yaw_deg=float(rng.choice([0.0, rng.uniform(-180.0, 180.0)])),
        sweeps=False,
        body=bool(rng.uniform() < 0.3),
    )
    title = f"{world}-{name}-{motion}-{seed}"
    scanner = calibrated(SOLD[name], rng)
    return Kept(world, seed, N_SCANS, scanner, title=title, drive=drive)


def walked(world: str, seed: int) -> Simulation:
    """Return a walk through a world of the paper's kinds, in steps of 0.4 to 0.9 m."""
    name = OF_WALKS[(seed + WALKED.index(world)) % len(OF_WALKS)]
    scanner = calibrated(SCANNERS[name], np.random.default_rng([seed, WALKED.index(world)]))
    return Kept(world, seed, N_SCANS, scanner, title=f"{world}-{name}-walk-{seed}")


def main() -> None:
    """Sample a share of the recordings, and say how far it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--part", choices=FIRST_SEED, default="train")
    parser.add_argument("--share", type=float, default=1.0, help="of the recordings, the first")
    parser.add_argument("--every", default="0/1", help="k/n: every n-th recording from the k-th")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    found = recordings(arguments.part)
    found = found[: round(arguments.share * len(found))]
    k, n = map(int, arguments.every.split("/"))
    found = found[k::n]
    if arguments.list:
        for simulation in found:
            print(simulation.name, simulation.drive)
        return

    # one after another, so that no more than one world is held
    outcomes: dict[str, int] = {}
    config = Config(sampling=SAMPLING[arguments.part])
    for simulation in found:
        for reason, count in sample([simulation], arguments.out, config, arguments.jobs).items():
            outcomes[reason] = outcomes.get(reason, 0) + count
        simulation.__dict__.pop("scans", None)
        print(simulation.name, outcomes, flush=True)


if __name__ == "__main__":
    main()
