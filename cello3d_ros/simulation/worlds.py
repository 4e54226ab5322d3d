"""Simulated worlds by name: a mesh built from a seed, and a route that runs clear of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.simulation import buildings, indoor, open_ground, outdoor, roads, staircase
from cello3d_ros.simulation.meshes import Mesh
from cello3d_ros.simulation.movers import Mover
from cello3d_ros.simulation.paths import Route
from cello3d_ros.simulation.world_files import load_world


@dataclass(frozen=True)
class World:
    """What a simulated scanner sees, and where it is carried; z is up, metres.

    glass: panes, seen through.  movers: what moves while it is scanned.
    """

    name: str
    mesh: Mesh
    route: Route
    glass: Mesh | None = None
    movers: tuple[Mover, ...] = ()


# mesh and route, and where there are any, glass and movers
Builder = Callable[[np.random.Generator], tuple[Any, ...]]

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
        "street": roads.street,
        "highway": roads.highway,
        "tunnel": roads.tunnel,
        "field": open_ground.field,
        "square": open_ground.square,
        "harbour": open_ground.harbour,
        "warehouse": buildings.warehouse,
        "parking": buildings.parking,
        "office": buildings.office,
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
    return World(name, *WORLDS[name](rng))
