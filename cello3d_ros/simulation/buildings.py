"""Worlds inside large buildings: a warehouse, a parking deck, offices behind glass."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.indoor import shell
from cello3d_ros.simulation.meshes import Mesh, block, box, cylinder, join, moved, painted, wall
from cello3d_ros.simulation.movers import Mover
from cello3d_ros.simulation.paths import Route, smooth
from cello3d_ros.simulation.roads import World
from cello3d_ros.simulation.things import CONCRETE, beside, car, walkers


def _loop(corners: ArrayLike, step_m: float = 2.0) -> Route:
    """Return the closed route through corners on the floor, round at the corners only."""
    a = np.asarray(corners, dtype=np.float64)
    sides = zip(a, np.roll(a, -1, axis=0), strict=True)
    points = [
        np.linspace(p, q, max(2, int(np.linalg.norm(q - p) / step_m)) + 1)[:-1] for p, q in sides
    ]
    xy = np.concatenate(points)
    return smooth(np.column_stack([xy, np.zeros(len(xy))]), closed=True)


def warehouse(rng: np.random.Generator) -> World:
    """Build a hall of high racks with aisles between them, pallets, forklifts and people."""
    n_aisles, bay = int(rng.integers(3, 6)), rng.uniform(2.6, 3.0)
    n_bays = int(rng.integers(9, 16))
    deep, aisle = 1.1, rng.uniform(2.6, 3.6)
    pitch = 2 * deep + aisle
    lane = rng.uniform(3.5, 5.0)  # across the ends of the racks
    length, width = n_bays * bay + 2 * lane, n_aisles * pitch + 2.0
    height, levels = rng.uniform(7, 11), int(rng.integers(3, 5))
    parts = [painted(shell(length, width, height), CONCRETE)]
    for k in range(n_aisles + 1):
        y = 1.0 + k * pitch
        for row in (
            (-deep / 2, deep / 2) if 0 < k < n_aisles else ((deep / 2,), (-deep / 2,))[k > 0]
        ):
            parts.append(moved(_rack(n_bays, bay, deep, levels, rng), [lane, y + row, 0]))
    for x in np.arange(lane / 2, length, 2 * lane):
        parts.append(block([x - 0.15, 0, height - 0.8], [x + 0.15, width, height - 0.3]))
    free, first, second = sorted(rng.choice(n_aisles, size=3, replace=False))
    y1, y2 = (1.0 + pitch * (k + 0.5) for k in (first, second))
    ends = 0.65 * lane, length - 0.65 * lane
    route = _loop(_rectangle(np.array([ends[0], y1]), np.array([ends[1], y2])))
    for _ in range(int(rng.integers(3, 9))):
        place = rng.uniform([0.8, 1.0], [length - 0.8, width - 1.0])
        if route.distance(place) > 1.5 and not lane - 1 < place[0] < length - lane + 1:
            parts.append(_pallet(place, rng))
    side = _loop(_rectangle(np.array([0.6, 1.6]), np.array([1.0, width - 1.6])))
    y = 1.0 + pitch * (free + 0.5)
    aisle_way = _loop(
        _rectangle(np.array([lane + 1, y - 0.2]), np.array([length - lane - 1, y + 0.2]))
    )
    movers = walkers(int(rng.integers(1, 4)), [side, aisle_way], rng)
    movers.append(Mover(_forklift(), aisle_way, rng.uniform(0, 20), rng.uniform(0.8, 2.0)))
    return join(parts), route, None, tuple(movers)


def _rack(n_bays: int, bay: float, deep: float, levels: int, rng: np.random.Generator) -> Mesh:
    """Return a rack along x: uprights, beams, and goods in most places."""
    rise, parts = 1.9, []
    for k in range(n_bays + 1):
        parts += [
            box([k * bay, y, levels * rise / 2], [0.1, 0.08, levels * rise])
            for y in (-deep / 2, deep / 2)
        ]
    for level in range(levels):
        if level:
            for y in (-deep / 2, deep / 2):
                parts.append(box([n_bays * bay / 2, y, level * rise], [n_bays * bay, 0.05, 0.12]))
        for k in range(n_bays):
            for half in (0.27, 0.73):
                if rng.uniform() < 0.75:
                    size = rng.uniform([0.8, 0.8, 0.5], [1.15, deep, 1.5])
                    at = [
                        (k + half) * bay,
                        rng.normal(scale=0.04),
                        level * rise + 0.1 + size[2] / 2,
                    ]
                    goods = box(at, size, rng.normal(scale=0.02))
                    parts.append(painted(goods, float(rng.uniform(0.1, 0.8))))
    return join(parts)


def _pallet(place: Array, rng: np.random.Generator) -> Mesh:
    size = rng.uniform([0.8, 0.8, 0.3], [1.2, 1.2, 1.8])
    return box([*place, size[2] / 2], size, rng.uniform(0, np.pi))


def _forklift() -> Mesh:
    mast = [box([0.7, y, 1.1], [0.12, 0.1, 2.2]) for y in (-0.35, 0.35)]
    forks = [box([1.2, y, 0.1], [1.0, 0.12, 0.06]) for y in (-0.25, 0.25)]
    return join([box([-0.2, 0, 0.6], [1.5, 1.1, 1.0]), *mast, *forks,
                 box([-0.3, 0, 2.1], [1.0, 1.0, 0.08])])  # fmt: skip


def parking(rng: np.random.Generator) -> World:
    """Build a deck of a car park: a low ceiling on beams and columns, cars in bays, open sides."""
    n_rows, n_bays = int(rng.integers(2, 4)), int(rng.integers(12, 22))
    deep, lane, bay = 5.0, rng.uniform(6.0, 7.0), 2.5
    pitch, height = 2 * deep + lane, rng.uniform(2.4, 3.0)
    length, width = n_bays * bay + 2 * lane, n_rows * pitch
    parts = [painted(block([0, 0, -0.3], [length, width, 0.0]), CONCRETE)]
    parts.append(painted(block([0, 0, height], [length, width, height + 0.3]), CONCRETE))
    for x in np.arange(lane, length - lane + 0.1, 3 * bay):
        parts.append(block([x - 0.2, 0, height - 0.4], [x + 0.2, width, height]))
        for k in range(n_rows + 1):
            y = np.clip(k * pitch, 0.3, width - 0.3)
            parts.append(box([x, y, height / 2], [0.4, 0.5, height]))
    for a, b in (((0, 0), (length, 0)), ((0, width), (length, width)), ((0, 0), (0, width)),
                 ((length, 0), (length, width))):  # fmt: skip
        shut = rng.uniform() < 0.4
        parts.append(wall(a, b, (0.0, height if shut else 1.0)))
    for k in range(n_rows):
        for y, face in (
            (k * pitch + deep / 2, np.pi / 2),
            ((k + 1) * pitch - deep / 2, -np.pi / 2),
        ):
            for n in range(n_bays):
                if rng.uniform() < 0.6:
                    at = [lane + (n + 0.5) * bay, y + rng.normal(scale=0.15), 0.0]
                    turn = face + np.pi * float(rng.uniform() < 0.5) + rng.normal(scale=0.03)
                    parts.append(moved(car(rng), at, turn))
    for y in np.arange(2.0, width, 4.0):  # pipes and lamps under the ceiling
        parts.append(box([length / 2, y, height - 0.15], [length - 1, 0.12, 0.1]))
    y1, y2 = 0.5 * pitch, (n_rows - 0.5) * pitch
    ends = (lane / 2, length - lane / 2)
    route = _loop([(ends[0], y1), (ends[1], y1), (ends[1], y2), (ends[0], y2)])
    way = beside(route, 1.6)
    return join(parts), route, None, tuple(walkers(int(rng.integers(1, 4)), [way], rng))


def office(rng: np.random.Generator) -> World:
    """Build a corridor around meeting rooms behind glass, with glass to the outside as well."""
    inner = rng.uniform([10, 6], [18, 10])  # the block of rooms
    hall, height = rng.uniform(2.2, 3.2), rng.uniform(2.6, 3.2)
    desks = rng.uniform(2.5, 4.0)  # depth of the places along the outside
    low, high = np.zeros(2), inner + 2 * (hall + desks)
    a, b = low + hall + desks, high - hall - desks
    route = _loop(_rectangle(a - hall / 2, b + hall / 2))
    parts = [block([*low, -0.2], [*high, 0.0]), block([*low, height], [*high, height + 0.2])]
    panes: list[Mesh] = []
    for corners, share in ((_rectangle(a, b), 0.7), (_rectangle(low, high), 0.6)):
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            solid, glass = _front(start, end, height, share, rng)
            parts += solid
            panes += glass
    n = int(rng.integers(2, 4))
    for k in range(1, n):
        x = a[0] + k * (b[0] - a[0]) / n
        parts.append(wall([x, a[1]], [x, b[1]], (0.0, height)))
    for _ in range(int(rng.integers(20, 40))):
        size = rng.uniform([0.4, 0.4, 0.5], [1.8, 0.9, 1.6])
        place = rng.uniform(low + 0.5 * size[0] + 0.2, high - 0.5 * size[0] - 0.2)
        if route.distance(place) > np.linalg.norm(size[:2]) / 2 + 0.6:
            parts.append(box([*place, size[2] / 2], size, rng.choice([0, np.pi / 2])))
    yard = rng.uniform(6, 15)
    parts.append(box([high[0] / 2, -yard, 1.0], [high[0] + 30, 0.5, 9.0]))  # the house opposite
    parts.append(block([-25, -yard, -0.6], [high[0] + 25, high[1] + 25, -0.4]))
    for x in np.arange(-10, high[0] + 10, 6.0):
        parts.append(cylinder([x, high[1] + rng.uniform(3, 12), -0.5], 5.0, 0.15))
    people = walkers(int(rng.integers(2, 6)), [beside(route, 0.8)], rng)
    return join(parts), route, join(panes), tuple(people)


def _rectangle(low: Array, high: Array) -> Array:
    """Return the corners (4, 2) of a rectangle, counterclockwise."""
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def _front(
    start: Array, end: Array, height: float, share: float, rng: np.random.Generator
) -> tuple[list[Mesh], list[Mesh]]:
    """Return the solid parts and the panes of a wall between posts.

    A share of its bays is glass above a low sill, the others are solid.
    """
    n = max(2, round(float(np.linalg.norm(end - start)) / 1.8))
    yaw = float(np.arctan2(*(end - start)[::-1]))
    width = float(np.linalg.norm(end - start)) / n
    solid, glass = [], []
    for k in range(n + 1):
        solid.append(
            box([*(start + (end - start) * k / n), height / 2], [0.08, 0.08, height], yaw)
        )
    for k in range(n):
        x, y = start + (end - start) * (k + 0.5) / n
        if rng.uniform() >= share:
            solid.append(box([x, y, height / 2], [width, 0.1, height], yaw))
            continue
        solid.append(box([x, y, 0.1], [width, 0.1, 0.2], yaw))
        solid.append(box([x, y, height - 0.15], [width, 0.1, 0.3], yaw))
        glass.append(box([x, y, height / 2 - 0.05], [width, 0.01, height - 0.5], yaw))
    return solid, glass
