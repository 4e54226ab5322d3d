"""Worlds inside buildings: rooms, a hall, a corridor with regular pillars."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh, block, box, cylinder, frustum, join, wall
from cello3d_ros.simulation.paths import Route, smooth


def rooms(rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Build two rows of furnished rooms, joined by doors in a ring."""
    n = int(rng.integers(2, 5))
    xs = np.concatenate([[0.0], np.cumsum(rng.uniform(3.2, 6.0, size=n))])
    ys = np.concatenate([[0.0], np.cumsum(rng.uniform(3.2, 6.0, size=2))])
    height = rng.uniform(2.4, 3.2)
    ring = [(i, 0) for i in range(n)] + [(i, 1) for i in reversed(range(n))]
    steps = list(zip(ring, ring[1:] + ring[:1], strict=True))
    doors = {frozenset(step): rng.uniform(0.25, 0.75) for step in steps}
    corners: list[Array] = []
    for here, following in steps:
        middle = np.array([xs[here[0]] + xs[here[0] + 1], ys[here[1]] + ys[here[1] + 1]]) / 2
        corners.append(middle + rng.uniform(-0.4, 0.4, size=2))
        step = np.subtract(following, here)
        door = _door(xs, ys, here, following, doors[frozenset((here, following))])
        corners += [door - 0.8 * step, door, door + 0.8 * step]
    route = smooth(_on_floor(corners), closed=True)
    parts = [shell(xs[-1], ys[-1], height), *_partitions(xs, ys, height, doors)]
    for i, j in ring:
        low, high = np.array([xs[i], ys[j]]), np.array([xs[i + 1], ys[j + 1]])
        parts += _furniture(low, high, height, route, rng)
    return join(parts), route


def _door(
    xs: Array, ys: Array, here: tuple[int, int], following: tuple[int, int], share: float
) -> Array:
    """Return the middle (2,) of the door between two rooms."""
    i, j = np.maximum(here, following)
    if here[0] != following[0]:
        return np.array([xs[i], ys[j] + share * (ys[j + 1] - ys[j])])
    return np.array([xs[i] + share * (xs[i + 1] - xs[i]), ys[j]])


def _partitions(
    xs: Array, ys: Array, height: float, doors: dict[frozenset[tuple[int, int]], float]
) -> list[Mesh]:
    """Return the walls between the rooms, with a door 1 m wide where two are joined."""
    parts = []
    n = len(xs) - 1
    neighbors = [((i, j), (i + 1, j)) for i in range(n - 1) for j in range(2)]
    for here, following in neighbors + [((i, 0), (i, 1)) for i in range(n)]:
        i, j = np.maximum(here, following)
        start = np.array([xs[i], ys[j]])
        across = following[0] > here[0]
        end = start + np.array([0, ys[j + 1] - ys[j]] if across else [xs[i + 1] - xs[i], 0])
        share = doors.get(frozenset((here, following)))
        middle = (share or 0.0) * float(np.linalg.norm(end - start))
        openings = [] if share is None else [(middle, 1.0, 0.0, 2.05)]
        parts.append(wall(start, end, (0.0, height), openings))
    return parts


def _furniture(
    low: Array, high: Array, height: float, route: Route, rng: np.random.Generator
) -> list[Mesh]:
    """Return cupboards along the walls, tables, bins and columns, none of them in the way."""
    parts = []
    for _ in range(int(rng.integers(4, 11))):
        size = rng.uniform([0.3, 0.3, 0.4], [1.4, 0.8, 2.0])
        if rng.uniform() < 0.5:
            size[:2] = size[1::-1]
        place = rng.uniform(low + 0.1 + size[:2] / 2, high - 0.1 - size[:2] / 2)
        side, far = int(rng.integers(2)), rng.uniform() < 0.5
        if (kind := rng.uniform()) < 0.6:
            place[side] = (high - 0.06 - size[:2] / 2 if far else low + 0.06 + size[:2] / 2)[side]
        if route.distance(place) < np.linalg.norm(size[:2]) / 2 + 0.4:
            continue
        if kind < 0.7:
            parts.append(box([*place, size[2] / 2], size))
        elif kind < 0.85:
            parts.append(_table(place, size, rng.uniform(0, np.pi)))
        else:
            top = height if rng.uniform() < 0.3 else rng.uniform(0.4, 1.2)
            parts.append(cylinder([*place, 0.0], top, rng.uniform(0.12, 0.25)))
    return parts


def _table(place: Array, size: Array, yaw: float) -> Mesh:
    top = box([*place, 0.73], [*size[:2], 0.04], yaw)
    legs = [[i * 0.45 * size[0], j * 0.45 * size[1]] for i in (-1, 1) for j in (-1, 1)]
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return join([top, *(box([*(place + leg @ turn), 0.36], [0.05, 0.05, 0.7]) for leg in legs)])


def hall(rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Build a hall with columns, roof beams, crates, barrels and a gallery."""
    length, width = rng.uniform(20, 36), rng.uniform(13, 22)
    height = rng.uniform(4.5, 9.0)
    angle = np.arange(14) * 2 * np.pi / 14
    radius = 1 + rng.uniform(0.05, 0.12) * np.cos(2 * angle + rng.uniform(0, 2 * np.pi))
    radius *= rng.uniform(0.28, 0.33)
    ring = np.stack([length * radius * np.cos(angle), width * radius * np.sin(angle)], axis=1)
    route = smooth(_on_floor(ring + np.array([length / 2, width / 2])), closed=True)
    parts = [shell(length, width, height)]
    bay = rng.uniform(3.5, 6.0)
    for x in np.arange(bay, length - 1, bay):
        parts.append(block([x - 0.15, 0.0, height - 0.6], [x + 0.15, width, height - 0.2]))
        parts += [box([x, y, height / 2], [0.35, 0.35, height]) for y in (0.4, width - 0.4)]
    depth = rng.uniform(1.2, 2.2)
    parts.append(block([0.0, 0.0, 2.8], [rng.uniform(0.4, 0.9) * length, depth, 3.0]))
    for _ in range(int(rng.integers(15, 35))):
        place = rng.uniform([1.0, 1.0], [length - 1.0, width - 1.0])
        size = rng.uniform([0.4, 0.4, 0.4], [2.2, 1.6, 2.5])
        if route.distance(place) < np.linalg.norm(size[:2]) / 2 + 0.5:
            continue
        if rng.uniform() < 0.75:
            parts.append(box([*place, size[2] / 2], size, rng.uniform(0, np.pi)))
        else:
            parts.append(frustum([*place, 0], [*place, size[2]], size[1] / 2, size[0] / 4, 16))
    return join(parts), route


def corridor(rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Build a long corridor: pillars at equal distances, doors in niches, little else."""
    length, width = rng.uniform(55, 100), rng.uniform(2.2, 3.6)
    height = rng.uniform(2.4, 3.2)
    bay, pillar = rng.uniform(2.5, 5.0), rng.uniform(0.15, 0.35)
    x = np.arange(1.5, length, 3.0)[:-1]
    weave = rng.uniform(-0.12, 0.12, size=len(x)) * (width - 2 * pillar)
    route = smooth(_on_floor(np.stack([x, width / 2 + weave], axis=1)), closed=False)
    parts = [block([0, 0, -0.2], [length, width, 0]), block([0, 0, height], [length, width, 9.0])]
    parts += [wall([x, -0.5], [x, width + 0.5], (0.0, height)) for x in (0.0, length)]
    middles = np.arange(bay / 2, length - 0.6, bay)
    niches = [(m + bay / 2, 0.9, 0.0, 2.0) for m in middles[:-1]]
    for y, inward in ((0.0, 1), (width, -1)):
        parts.append(wall([0.0, y], [length, y], (0.0, height), niches, 0.16))
        back = y - 0.3 * inward
        parts.append(wall([0.0, back], [length, back], (0.0, height)))
        for m in middles:
            across = sorted([y, y + inward * pillar])
            parts.append(block([m - 0.15, across[0], 0], [m + 0.15, across[1], height]))
    for _ in range(int(rng.integers(2, 6))):
        place = np.array([rng.uniform(2, length - 2), rng.choice([0.45, width - 0.45])])
        if route.distance(place) > 0.55:
            parts.append(cylinder([*place, 0], rng.uniform(0.5, 1.1), 0.15))
    return join(parts), route


def shell(length: float, width: float, height: float) -> Mesh:
    """Return floor, ceiling and outer walls of a rectangle that starts at the origin."""
    low, high = [0.0, 0.0], [length, width]
    corners = [low, [length, 0.0], high, [0.0, width]]
    walls = [
        wall(a, b, (0.0, height)) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    floors = [block([*low, z - 0.2], [*high, z]) for z in (0.0, height + 0.2)]
    return join([*walls, *floors])


def _on_floor(corners: ArrayLike) -> Array:
    corners = np.asarray(corners, dtype=np.float64)
    return np.concatenate([corners, np.zeros((len(corners), 1))], axis=1)
