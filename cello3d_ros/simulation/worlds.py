"""Simulated worlds by name: a mesh built from a seed, and a route that runs clear of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.simulation import indoor, outdoor, staircase
from cello3d_ros.simulation.meshes import Mesh
from cello3d_ros.simulation.paths import Route
from cello3d_ros.simulation.world_files import load_world


@dataclass(frozen=True)
class World:
    """What a simulated scanner sees, and where it is carried; z is up, metres."""

    name: str
    mesh: Mesh
    route: Route


Builder = Callable[[np.random.Generator], tuple[Mesh, Route]]

WORLDS: MappingProxyType[str, Builder] = MappingProxyType(
    {
        "rooms": indoor.rooms,
        "hall": indoor.hall,
        "corridor": indoor.corridor,
        "stairs": staircase.stairs,
        "garden": outdoor.garden,
        "wood": outdoor.wood,
        # the same places in another season, for the same seed
        "garden_winter": partial(outdoor.garden, foliage=0.08),
        "wood_autumn": partial(outdoor.wood, foliage=0.35),
    }
)


def build_world(name: str, rng: np.random.Generator) -> World:
    """Return the world of that name or YAML file; what varies is drawn from ``rng``."""
    if name.endswith((".yaml", ".yml")):
        return World(Path(name).stem, *load_world(Path(name), rng))
    if name not in WORLDS:
        raise RecordingError(
            f"there is no world {name!r}; known are {', '.join(WORLDS)} and YAML files"
        )
    mesh, route = WORLDS[name](rng)
    return World(name, mesh, route)
