"""A world inside a building: a staircase with lobbies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cello3d_ros.simulation.meshes import Mesh, block, box, cylinder, frustum, join, wall
from cello3d_ros.simulation.paths import Route, smooth


@dataclass(frozen=True)
class _Stairwell:
    """Measures of a staircase in metres: two flights side by side a storey, along +x and -x."""

    lane: float  # width of a flight
    gap: float  # between the flights
    landing: float
    lobby: float  # length of the floor before the stairs, x < 0
    n_steps: int  # of a flight
    rise: float
    tread: float

    @property
    def run(self) -> float:
        """Length of a flight along x."""
        return self.n_steps * self.tread

    @property
    def half(self) -> float:
        """Height of a flight."""
        return self.n_steps * self.rise

    @property
    def width(self) -> float:
        """Width of both flights and the gap."""
        return 2 * self.lane + self.gap

    @property
    def lanes(self) -> tuple[float, float]:
        """Middles in y of the flight up along x and of the flight back."""
        return self.lane / 2, self.width - self.lane / 2


def stairs(rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Build storeys of a lobby joined by a staircase that turns on half landings."""
    well = _Stairwell(
        lane=rng.uniform(1.3, 1.8),
        gap=rng.uniform(0.1, 0.4),
        landing=rng.uniform(1.6, 2.2),
        lobby=rng.uniform(4.0, 7.0),
        n_steps=int(rng.integers(8, 12)),
        rise=rng.uniform(0.16, 0.18),
        tread=rng.uniform(0.27, 0.3),
    )
    n_storeys = int(rng.integers(2, 4))
    floors = [2 * well.half * storey for storey in range(n_storeys + 1)]
    corners = [[-well.lobby + 0.9, rng.uniform(0.4, well.width - 0.8), 0.0]]
    for z in floors[:-1]:
        corners += _way_up(well, z)
    corners.append([-well.lobby + 0.9, well.lanes[0], floors[-1]])
    route = smooth(corners, closed=False)
    parts = _stairwell_shell(well, floors[-1] + 2.8, rng)
    for z in floors[:-1]:
        parts += _flights(well, z) + _railings(well, z)
        up = z + well.half
        parts.append(block([well.run, 0, up - 0.2], [well.run + well.landing, well.width, up]))
    for z in floors:
        parts.append(block([-well.lobby, -1.0, z - 0.2], [0.0, well.width, z]))
        parts += _lobby_objects(well, z, route, rng)
    return join(parts), route


def _way_up(well: _Stairwell, z: float) -> list[list[float]]:
    """Return corners of the route from the lobby at height ``z`` to the next, two flights up."""
    (there, back), run = well.lanes, well.run
    turn = run + 0.55 * well.landing
    flat = [(-1.2, there, 0), (0.0, there, 0), (turn, there, 1), (turn, back, 1)]
    flat += [(0.0, back, 2), (-1.4, back, 2)]
    ends = [(s * run, there, s) for s in (0.15, 0.85, 1.0)]
    ends += [(s * run, back, 2 - s) for s in (1.0, 0.85, 0.15)]
    way = [*flat[:2], *ends[:3], *flat[2:4], *ends[3:], *flat[4:]]
    return [[x, y, z + level * well.half] for x, y, level in way]


def _stairwell_shell(well: _Stairwell, top: float, rng: np.random.Generator) -> list[Mesh]:
    """Return the outer walls, with one tall window beside the stairs, the bottom and the roof."""
    x, end, y = -well.lobby, well.run + well.landing, well.width
    sill = well.half + 0.9
    window = (well.lobby + rng.uniform(0.8, 1.6), 1.0, sill, sill + 1.5)
    corners = [(x, y), (x, -1.0), (0.0, -1.0), (0.0, 0.0), (end, 0.0), (end, y)]
    parts = [wall(a, b, (0.0, top)) for a, b in pairwise(corners)]
    parts.append(wall((x, y), (end, y), (0.0, top), [window]))
    return [*parts, *(block([x, -1.0, z - 0.2], [end, y, z]) for z in (0.0, top + 0.2))]


def _flights(well: _Stairwell, z: float) -> list[Mesh]:
    """Return the steps of the flight up along x and of the flight back."""
    parts = []
    for k in range(well.n_steps):
        for x, y, level in (
            (k * well.tread, well.lanes[0], z + (k + 1) * well.rise),
            (
                (well.n_steps - k - 1) * well.tread,
                well.lanes[1],
                z + well.half + (k + 1) * well.rise,
            ),
        ):
            low = [x, y - well.lane / 2, level - well.rise - 0.12]
            parts.append(block(low, [x + well.tread, y + well.lane / 2, level]))
    return parts


def _railings(well: _Stairwell, z: float) -> list[Mesh]:
    """Return a handrail on posts along the inner side of both flights."""
    parts = []
    for inner, start, end in (
        (well.lane - 0.04, z, z + well.half),
        (well.lane + well.gap + 0.04, z + 2 * well.half, z + well.half),
    ):
        parts.append(
            frustum([0.0, inner, start + 1.0], [well.run, inner, end + 1.0], 0.03, 0.03, 6)
        )
        for share in np.arange(0.1, 1.0, 0.2):
            foot = [share * well.run, inner, start + share * (end - start)]
            parts.append(cylinder(foot, 1.0, 0.02, 6))
    return parts


def _lobby_objects(
    well: _Stairwell, z: float, route: Route, rng: np.random.Generator
) -> list[Mesh]:
    parts = []
    for _ in range(int(rng.integers(3, 7))):
        place = rng.uniform([0.4 - well.lobby, -0.6], [-0.6, well.width - 0.4])
        size = rng.uniform([0.3, 0.3, 0.4], [0.8, 0.6, 1.8])
        if route.distance(place) > np.linalg.norm(size[:2]) / 2 + 0.35:
            parts.append(box([*place, z + size[2] / 2], size))
    return parts
