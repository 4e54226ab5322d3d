"""The paper's seven sequences: their simulated counterparts, and what the paper found on them."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

from cello3d_ros.simulation.paths import Course
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.simulation import Simulation

# the paper's scanner, at the density of its clouds: 360 000 points in the apartment, 190 000 in
# the hall and on the stairs, 160 000 to 220 000 outside, where the sky returns nothing
_FINE = replace(SCANNERS["tilting_hokuyo"], n_beams=344, azimuth_step_deg=0.25)
_COARSE = replace(_FINE, n_beams=182)
_FIRST_SEED = 100  # of the places


class PaperTrajectory(NamedTuple):
    """A row of Table II: length, mean errors, mean D_M of translation, rotation and both."""

    length_m: float
    error_m: float
    dm_translation: float
    error_rad: float
    dm_rotation: float
    dm_6dof: float


class Sequence(NamedTuple):
    """One sequence.

    world, n_scans: of its simulated counterpart, as many scans as the paper had.  second: whether
    it is the second season of a place, walked another way.  folder: the name of the sequence in
    the 'Challenging data sets'.  trained_on: keys of the sequences that the paper trained on.
    kl_baseline, kl_ours, kl_censi: its Table I; trajectory: its Table II.
    """

    title: str
    world: str
    n_scans: int
    second: bool
    folder: str
    trained_on: tuple[str, ...]
    kl_baseline: float
    kl_ours: float
    kl_censi: float
    trajectory: PaperTrajectory


SEQUENCES: MappingProxyType[str, Sequence] = MappingProxyType(
    {
        "apartment": Sequence(
            "Apartment",
            "rooms",
            45,
            False,
            "Apartment",
            ("hauptgebaude", "stairs"),
            34.1,
            26.6,
            9.19e7,
            PaperTrajectory(22, 0.115, 0.274, 0.0331, 0.160, 0.540),
        ),
        "hauptgebaude": Sequence(
            "Hauptgebaude",
            "hall",
            36,
            False,
            "ETH Hauptgebaude",
            ("apartment", "stairs"),
            34.0,
            26.7,
            2.06e8,
            PaperTrajectory(24, 0.168, 0.467, 0.00910, 0.346, 1.15),
        ),
        "stairs": Sequence(
            "Stairs",
            "stairs",
            31,
            False,
            "Stairs",
            ("apartment", "hauptgebaude"),
            33.7,
            27.0,
            7.65e7,
            PaperTrajectory(12, 0.0664, 0.0998, 0.0127, 0.307, 0.592),
        ),
        "gazebo_summer": Sequence(
            "Gazebo Summer",
            "garden",
            32,
            False,
            "Gazebo in summer",
            ("gazebo_winter",),
            20.8,
            19.8,
            2.55e6,
            PaperTrajectory(14, 0.0396, 0.278, 0.0165, 0.278, 0.491),
        ),
        "gazebo_winter": Sequence(
            "Gazebo Winter",
            "garden_winter",
            31,
            True,
            "Gazebo in winter",
            ("gazebo_summer",),
            20.3,
            18.9,
            2.25e6,
            PaperTrajectory(15, 0.0311, 2.000, 0.0144, 2.90, 2.50),
        ),
        "wood_autumn": Sequence(
            "Wood Autumn",
            "wood_autumn",
            32,
            True,
            "Wood in autumn",
            ("wood_summer",),
            13.2,
            11.5,
            4.94e6,
            PaperTrajectory(18, 0.217, 0.205, 0.0178, 0.394, 0.405),
        ),
        "wood_summer": Sequence(
            "Wood Summer",
            "wood",
            37,
            False,
            "Wood in summer",
            ("wood_autumn",),
            13.6,
            11.3,
            3.52e7,
            PaperTrajectory(21, 0.332, 0.208, 0.0299, 0.533, 0.762),
        ),
    }
)


def counterpart(key: str, seed: int, n_scans: int | None = None) -> Simulation:
    """Return the simulated counterpart of a sequence, or its first scans.

    It has the length of the paper's sequence.  A seed is a place of the kind, the same in both
    seasons, which are walked by other steps, starting elsewhere, aside of each other.
    """
    sequence = SEQUENCES[key]
    step_m = sequence.trajectory.length_m / (sequence.n_scans - 1)
    return Simulation(
        sequence.world,
        _FIRST_SEED + seed,
        min(n_scans or sequence.n_scans, sequence.n_scans),
        _COARSE if key in ("hauptgebaude", "stairs") else _FINE,
        title=f"{key}-{seed}",
        course=Course(step_m, 1.5, 0.3, 1) if sequence.second else Course(step_m),
    )
