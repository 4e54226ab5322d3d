"""Worlds inside buildings: rooms, a hall, a corridor with regular pillars, a staircase."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.meshes import Mesh, block, box, cylinder, frustum, join, wall
from cello3d_ros.recordings.paths import Route, smooth


def rooms(rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Build two rows of furnished rooms, joined by doors in a ring."""
    n = int(rng.integers(2, 5))
    xs = np.concatenate([[0.0], np.cumsum(rng.uniform(3.2, 6.0, size=n))])
    ys = np.concatenate([[0.0], np.cumsum(rng.uniform(3.2, 6.0, size=2))])
    height = rng.uniform(2.4, 3.2)
    ring = [(i, 0) for i in range(n)] + [(i, 1) for i in reversed(range(n))]
    doors = {
        frozenset((a, b)): rng.uniform(0.25, 0.75)
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True)
    }
    corners: list[Array] = []
    for here, following in zip(ring, ring[1:] + ring[:1], strict=True):
        middle = np.array([xs[here[0]] + xs[here[0] + 1], ys[here[1]] + ys[here[1] + 1]]) / 2
        corners.append(middle + rng.uniform(-0.4, 0.4, size=2))
        step = np.subtract(following, here)
        door = _door(xs, ys, here, following, doors[frozenset((here, following))])
        corners += [door - 0.8 * step, door, door + 0.8 * step]
    route = smooth(_on_floor(corners), closed=True)
    parts = [_shell(xs[-1], ys[-1], height), *_partitions(xs, ys, height, doors)]
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
    parts = [_shell(length, width, height)]
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


def stairs(rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Build storeys of a lobby joined by a staircase that turns on half landings."""
    lane, gap, landing = rng.uniform(1.3, 1.8), rng.uniform(0.1, 0.4), rng.uniform(1.6, 2.2)
    n_steps, rise, tread = (
        int(rng.integers(8, 12)),
        rng.uniform(0.16, 0.18),
        rng.uniform(0.27, 0.3),
    )
    lobby, n_storeys = rng.uniform(4.0, 7.0), int(rng.integers(2, 4))
    run, half, width = n_steps * tread, n_steps * rise, 2 * lane + gap
    top = 2 * half * n_storeys + 2.8
    parts = [
        block([-lobby, -1.0, -0.2], [run + landing, width, 0.0]),
        block([-lobby, -1.0, top], [run + landing, width, top + 0.2]),
        wall([-lobby, -1.0], [-lobby, width], (0.0, top)),
        wall([-lobby, width], [run + landing, width], (0.0, top), _windows(lobby, half, top, rng)),
        wall([-lobby, -1.0], [0.0, -1.0], (0.0, top)),
        wall([0.0, -1.0], [0.0, 0.0], (0.0, top)),
        wall([0.0, 0.0], [run + landing, 0.0], (0.0, top)),
        wall([run + landing, 0.0], [run + landing, width], (0.0, top)),
    ]
    lanes = (lane / 2, width - lane / 2)
    corners: list[list[float]] = [[-lobby + 0.9, rng.uniform(0.4, width - 0.8), 0.0]]
    for storey in range(n_storeys):
        z = 2 * half * storey
        corners += [[-1.2, lanes[0], z], [-0.3, lanes[0], z], [0.0, lanes[0], z]]
        corners += [[run, lanes[0], z + half], [run + 0.55 * landing, lanes[0], z + half]]
        corners += [[run + 0.55 * landing, lanes[1], z + half], [run, lanes[1], z + half]]
        corners += [[0.0, lanes[1], z + 2 * half], [-0.3, lanes[1], z + 2 * half]]
        corners += [[-1.4, lanes[1], z + 2 * half]]
        parts += _flights(lanes, lane, (n_steps, rise, tread), z)
        parts.append(block([run, 0, z + half - 0.2], [run + landing, width, z + half]))
        parts.append(block([-lobby, -1, z + 2 * half - 0.2], [0, width, z + 2 * half]))
    corners.append([-lobby + 0.9, lanes[0], 2 * half * n_storeys])
    route = smooth(corners, closed=False)
    for storey in range(n_storeys + 1):
        parts += _lobby_objects(-lobby, width, 2 * half * storey, route, rng)
    return join(parts), route


def _flights(
    lanes: tuple[float, float], lane: float, steps: tuple[int, float, float], z: float
) -> list[Mesh]:
    """Return the flight up along x, the flight back, and their railing."""
    n, rise, tread = steps
    parts = []
    for k in range(n):
        for x, y, level in (
            (k * tread, lanes[0], z + (k + 1) * rise),
            ((n - k - 1) * tread, lanes[1], z + (n + k + 1) * rise),
        ):
            low = [x, y - lane / 2, level - rise - 0.12]
            parts.append(block(low, [x + tread, y + lane / 2, level]))
            inner = y + np.sign(np.mean(lanes) - y) * (lane / 2 - 0.04)
            if k % 2:
                parts.append(cylinder([x + tread / 2, inner, level], 0.9, 0.02, 6))
    for y, a, b in ((lanes[0], 0, n), (lanes[1], 2 * n, n)):
        inner = y + np.sign(np.mean(lanes) - y) * (lane / 2 - 0.04)
        ends = [[x, inner, z + level * rise + 1.0] for x, level in ((0.0, a), (n * tread, b))]
        parts.append(frustum(ends[0], ends[1], 0.03, 0.03, 6))
    return parts


def _windows(
    lobby: float, half: float, top: float, rng: np.random.Generator
) -> list[tuple[float, float, float, float]]:
    """Return one tall window beside the stairs, at a random place."""
    return [(lobby + rng.uniform(0.8, 1.6), 1.0, half + 0.9, min(top - 0.5, half + 2.4))]


def _lobby_objects(
    x: float, width: float, z: float, route: Route, rng: np.random.Generator
) -> list[Mesh]:
    parts = []
    for _ in range(int(rng.integers(3, 7))):
        place = rng.uniform([x + 0.4, -0.6], [-0.6, width - 0.4])
        size = rng.uniform([0.3, 0.3, 0.4], [0.8, 0.6, 1.8])
        if route.distance(place) > np.linalg.norm(size[:2]) / 2 + 0.35:
            parts.append(box([*place, z + size[2] / 2], size))
    return parts


def _shell(length: float, width: float, height: float) -> Mesh:
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
