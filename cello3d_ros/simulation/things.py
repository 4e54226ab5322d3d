"""What stands and moves in many worlds: cars, people, poles, houses, kerbs; metres, z up."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import (
    Mesh,
    box,
    cylinder,
    facets,
    frustum,
    join,
    moved,
    painted,
)
from cello3d_ros.simulation.movers import Mover
from cello3d_ros.simulation.paths import Route

ASPHALT, CONCRETE, LEAF, SIGN, RUBBER = 0.15, 0.35, 0.45, 0.9, 0.05


def car(rng: np.random.Generator) -> Mesh:
    """Return a car or a van, x ahead, the origin on the ground below its middle."""
    length, width = rng.uniform(3.6, 4.9), rng.uniform(1.65, 1.9)
    waist, top = rng.uniform(0.8, 1.0), rng.uniform(1.4, 1.6)
    van = rng.uniform() < 0.2
    cabin_length = 0.75 * length if van else 0.5 * length
    top += 0.5 if van else 0.0
    paint = float(rng.uniform(0.05, 0.7))
    hull = box([0, 0, 0.5 * (waist + 0.25)], [length, width, waist - 0.25])
    base = np.array([-0.05 * length, 0, waist])
    cabin = _tapered(base, [cabin_length, 0.95 * width], top - waist, 0.75)
    wheels = [
        frustum([x * length, y - 0.1, 0.32], [x * length, y + 0.1, 0.32], 0.32, 0.32, 12)
        for x in (-0.31, 0.31)
        for y in (-0.5 * width, 0.5 * width)
    ]
    return join([painted(hull, paint), painted(cabin, 0.1), painted(join(wheels), RUBBER)])


def _tapered(base: Array, size: ArrayLike, height: float, top: float) -> Mesh:
    """Return a block whose upper face is smaller than its lower one."""
    block = box([0, 0, 0.5], [1, 1, 1])
    scale = np.where(block.vertices[:, 2:] > 0.5, top, 1.0) * np.asarray(size)
    return Mesh(
        np.column_stack([scale * block.vertices[:, :2], height * block.vertices[:, 2]]) + base,
        block.triangles,
    )


def truck(rng: np.random.Generator) -> Mesh:
    """Return a lorry, x ahead."""
    length, height = rng.uniform(7.0, 14.0), rng.uniform(3.0, 3.9)
    load = box([-1.2, 0, 0.5 * (height + 1.1)], [length - 2.4, 2.5, height - 1.1])
    cab = box([0.5 * length - 1.0, 0, 1.7], [2.0, 2.4, 2.6])
    n = int(length / 2.5)
    wheels = [
        frustum([x, y - 0.15, 0.5], [x, y + 0.15, 0.5], 0.5, 0.5, 12)
        for x in np.linspace(-0.5 * length + 1.2, 0.5 * length - 1.2, n)
        for y in (-1.1, 1.1)
    ]
    body = join([load, cab, box([0, 0, 0.9], [length - 0.5, 0.9, 0.3])])
    return join([painted(body, float(rng.uniform(0.2, 0.8))), painted(join(wheels), RUBBER)])


def person(rng: np.random.Generator) -> Mesh:
    """Return a standing or walking person, x ahead."""
    tall, stride = rng.uniform(1.55, 1.9), rng.uniform(0.0, 0.3)
    hip, neck = 0.5 * tall, 0.84 * tall
    legs = [
        frustum([side * stride, 0.09 * side, 0.0], [0, 0.08 * side, hip], 0.07, 0.09, 8)
        for side in (-1, 1)
    ]
    arms = [
        frustum([-side * stride, 0.27 * side, hip], [0, 0.2 * side, neck], 0.05, 0.06, 6)
        for side in (-1, 1)
    ]
    trunk = frustum([0, 0, hip - 0.05], [0, 0, neck], 0.15, 0.2, 10)
    head = frustum([0, 0, neck + 0.02], [0, 0, tall], 0.1, 0.09, 8)
    return painted(join([*legs, *arms, trunk, head]), float(rng.uniform(0.1, 0.6)))


def walkers(n: int, routes: Iterable[Route], rng: np.random.Generator) -> list[Mover]:
    """Return people who walk along routes, each at a pace of its own, both ways."""
    routes = list(routes)
    return [
        _on_its_way(person(rng), routes[int(rng.integers(len(routes)))], (0.7, 1.7), rng)
        for _ in range(n)
    ]


def traffic(
    n: int, lane: Route, speeds_m_s: tuple[float, float], rng: np.random.Generator
) -> list[Mover]:
    """Return cars and lorries that drive along a lane, all at one speed, well apart."""
    speed = rng.uniform(*speeds_m_s)
    starts = (rng.uniform() + np.arange(n)) * lane.arc_m[-1] / n
    return [
        Mover(truck(rng) if rng.uniform() < 0.15 else car(rng), lane, float(start), speed)
        for start in starts
    ]


def _on_its_way(
    mesh: Mesh, route: Route, speeds_m_s: tuple[float, float], rng: np.random.Generator
) -> Mover:
    speed = rng.uniform(*speeds_m_s) * rng.choice([-1.0, 1.0])
    return Mover(mesh, route, rng.uniform(0, route.arc_m[-1]), speed)


def lamp(place: ArrayLike, height: float, toward_rad: float) -> Mesh:
    """Return a street lamp with an arm."""
    x, y, z = np.asarray(place, dtype=np.float64)
    arm = np.array([1.5 * np.cos(toward_rad), 1.5 * np.sin(toward_rad), 0.2])
    top = np.array([x, y, z + height])
    return painted(
        join(
            [
                frustum([x, y, z - 0.3], top, 0.09, 0.05, 10),
                frustum(top, top + arm, 0.04, 0.04, 6),
                box(top + arm, [0.6, 0.25, 0.12], toward_rad),
            ]
        ),
        CONCRETE,
    )


def sign(place: ArrayLike, toward_rad: float, rng: np.random.Generator) -> Mesh:
    """Return a traffic sign on a pole, which sends much light back."""
    place = np.asarray(place, dtype=np.float64)
    size = rng.uniform(0.5, 0.9)
    plate = box([0.06, 0, 2.3], [0.02, size, size])
    pole = painted(cylinder([0, 0, -0.3], 2.3 + size / 2, 0.03, 8), CONCRETE)
    return moved(join([painted(plate, SIGN), pole]), place, toward_rad)


def fence(start: ArrayLike, end: ArrayLike, height: float, spacing: float = 0.14) -> Mesh:
    """Return a fence of upright slats, with gaps between them, on two rails."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    along = b - a
    length = float(np.linalg.norm(along[:2]))
    yaw = float(np.arctan2(along[1], along[0]))
    slats = [
        box(a + along * s / length + [0, 0, 0.5 * height], [0.09, 0.02, height], yaw)
        for s in np.arange(0.05, length, spacing)
    ]
    rails = [
        box(0.5 * (a + b) + [0, 0, share * height], [length, 0.04, 0.08], yaw)
        for share in (0.2, 0.8)
    ]
    return join([*slats, *rails])


def bush(place: ArrayLike, size: ArrayLike, rng: np.random.Generator) -> Mesh:
    """Return a bush of loose leaves around a place on the ground."""
    size = np.asarray(size, dtype=np.float64)
    center = np.asarray(place, dtype=np.float64) + [0, 0, 0.8 * size[2]]
    n = int(np.clip(160 * size[0] * size[1], 60, 1500))
    return painted(facets(center, size, n, 0.1, rng), LEAF)


def house(length: float, depth: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return a house with its front along x from the origin, facing -y.

    Windows lie deeper than the front or have frames, by chance; some have balconies.
    """
    storey, bay = rng.uniform(2.9, 3.6), rng.uniform(2.2, 3.4)
    relief = rng.uniform(0.08, 0.3)
    parts = [box([length / 2, depth / 2 + relief, height / 2], [length, depth, height])]
    bays, storeys = max(1, int(length / bay)), max(1, int(height / storey))
    gap = length / bays
    width, tall = rng.uniform(0.4, 0.6) * gap, rng.uniform(0.4, 0.55) * storey
    for k in range(bays + 1):  # the wall between the windows
        left, right = (
            max(0.0, k * gap - (gap - width) / 2),
            min(length, k * gap + (gap - width) / 2),
        )
        parts.append(
            box([0.5 * (left + right), relief / 2, height / 2], [right - left, relief, height])
        )
    for level in range(storeys + 1):
        low = max(0.0, level * storey - 0.6 * (storey - tall))
        high = min(height, level * storey + 0.4 * (storey - tall))
        parts.append(
            box([length / 2, relief / 2, 0.5 * (low + high)], [length, relief, high - low])
        )
    if rng.uniform() < 0.4:
        for level in range(1, storeys):
            k = int(rng.integers(bays))
            parts.append(box([(k + 0.5) * gap, -0.5, level * storey], [0.9 * gap, 1.1, 0.15]))
            parts.append(
                box([(k + 0.5) * gap, -1.0, level * storey + 0.5], [0.9 * gap, 0.06, 1.0])
            )
    if rng.uniform() < 0.5:  # a roof that overhangs
        parts.append(box([length / 2, depth / 2, height + 0.15], [length + 0.8, depth + 0.8, 0.3]))
    return painted(join(parts), float(rng.uniform(0.2, 0.7)))


def extruded(profile: ArrayLike, along: Array, heading_rad: Array) -> Mesh:
    """Return the surface that a line (P, 2) of offsets to the left and up sweeps along places.

    along: (M, 3).  heading_rad: (M,).
    """
    profile = np.asarray(profile, dtype=np.float64)
    left = np.stack([-np.sin(heading_rad), np.cos(heading_rad)], axis=1)
    grid = np.empty((len(along), len(profile), 3))
    grid[..., :2] = along[:, None, :2] + profile[None, :, :1] * left[:, None]
    grid[..., 2] = along[:, None, 2] + profile[None, :, 1]
    index = np.arange(grid[..., 0].size).reshape(grid.shape[:2])
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    halves = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    return Mesh(grid.reshape(-1, 3), np.concatenate(halves))


def beside(route: Route, left_m: float) -> Route:
    """Return the curve that runs beside another, to its left, without its corners crossing."""
    heading = route.heading_rad
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros(len(heading))], axis=1)
    return Route(route.points + left_m * left, route.closed)
