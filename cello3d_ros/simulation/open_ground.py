"""Worlds under an open sky: a field, a square, a harbour."""

from __future__ import annotations

import numpy as np

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import (
    Mesh,
    box,
    cylinder,
    frustum,
    join,
    moved,
    painted,
    terrain,
)
from cello3d_ros.simulation.outdoor import clear_of, places, surface, tree, uneven_ground
from cello3d_ros.simulation.paths import Route, smooth
from cello3d_ros.simulation.roads import World
from cello3d_ros.simulation.things import (
    CONCRETE,
    LEAF,
    beside,
    house,
    lamp,
    truck,
    walkers,
)


def field(rng: np.random.Generator) -> World:
    """Build a meadow: uneven ground with grass, at most eight trees, at times a fence."""
    ground = uneven_ground(rng, wavelengths_m=(3.0, 40.0), std_m=rng.uniform(0.03, 0.3))
    ring = _ring(rng, rng.uniform(12.0, 25.0))
    way = smooth(ring, closed=True)
    points = way.points.copy()
    points[:, 2] = ground(points[:, :2])
    route = Route(points, closed=True)
    parts = [painted(surface(ground, 60.0, rng.uniform(0.0, 0.06), rng), LEAF)]
    for place in places(rng, int(rng.integers(0, 9)), 80.0, 4.0):
        if route.distance(place) > 2.0:
            foot = np.array([*place, float(ground(place))])
            parts.append(painted(tree(foot, rng.uniform(4, 10), 220, route, rng), LEAF))
    if rng.uniform() < 0.4:
        x = np.arange(-50.0, 50.0, 3.0)
        spots = np.column_stack([x, np.full(len(x), -38.0)])
        feet = np.column_stack([spots, ground(spots) - 0.2])
        parts += [cylinder(foot, 1.4, 0.05, 6) for foot in feet]
    return clear_of(route, join(parts)), route, None, ()


def _ring(rng: np.random.Generator, radius_m: float) -> Array:
    """Return a dented circle (16, 3) around the origin."""
    angle = rng.uniform(0, 2 * np.pi) + np.arange(16) * 2 * np.pi / 16
    radius = radius_m * (1 + 0.15 * np.cos(2 * angle + rng.uniform(0, 2 * np.pi)))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(16)], axis=1)


def square(rng: np.random.Generator) -> World:
    """Build a paved square: facades around it, a fountain, benches, trees, lamps and people."""
    half = rng.uniform([28, 24], [55, 45])
    x = np.arange(-half.max() - 25, half.max() + 26.0, 2.0)
    ground = uneven_ground(rng, wavelengths_m=(25.0, 80.0), std_m=0.1)
    z = ground(np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1))
    parts = [painted(terrain(x, x, z), CONCRETE)]
    route = smooth(_ring(rng, 0.55 * half.min()), closed=True)
    points = route.points.copy()
    points[:, 2] = ground(points[:, :2])
    route = Route(points, closed=True)
    parts += _facades(half, rng)
    basin = rng.uniform(2.0, 4.0)
    parts.append(frustum([0, 0, -0.5], [0, 0, 0.6], basin, basin, 24))
    parts.append(frustum([0, 0, 0.5], [0, 0, rng.uniform(2, 5)], 0.5, 0.2, 12))
    for place in places(rng, int(rng.integers(10, 40)), 2 * half.min() - 8, 3.0):
        if route.distance(place) < 1.6 or np.linalg.norm(place) < basin + 1:
            continue
        foot, kind = np.array([*place, float(ground(place))]), rng.uniform()
        if kind < 0.35:
            parts.append(painted(tree(foot, rng.uniform(4, 8), 200, route, rng), LEAF))
        elif kind < 0.55:
            parts.append(lamp(foot, rng.uniform(3.5, 6), rng.uniform(0, 2 * np.pi)))
        elif kind < 0.85:
            parts.append(box(foot + [0, 0, 0.25], [1.8, 0.5, 0.45], rng.uniform(0, np.pi)))
        else:
            parts.append(box(foot + [0, 0, 1.2], [2.4, 2.0, 2.6], rng.uniform(0, np.pi)))
    ways = [smooth(_ring(rng, share * half.min()), closed=True) for share in (0.35, 0.85)]
    for way in ways:
        way.points[:, 2] = ground(way.points[:, :2])
    people = walkers(int(rng.integers(6, 20)), ways, rng)
    return clear_of(route, join(parts)), route, None, tuple(people)


def _facades(half: Array, rng: np.random.Generator) -> list[Mesh]:
    """Return rows of houses around a square, on three sides or four."""
    parts = []
    for side in range(4):
        length, away = (2 * half[0], half[1]) if side % 2 == 0 else (2 * half[1], half[0])
        if side == 3 and rng.uniform() < 0.5:
            continue  # open to one side
        at = -length / 2
        while at < length / 2 - 5:
            width = min(rng.uniform(9, 22), length / 2 - at)
            front = moved(house(width, 9.0, rng.uniform(8, 20), rng), [at, away, -0.5])
            parts.append(moved(front, np.zeros(3), side * np.pi / 2))
            at += width + (rng.uniform(3, 8) if rng.uniform() < 0.3 else 0.0)
    return parts


def harbour(rng: np.random.Generator) -> World:
    """Build a quay: water that returns nothing, boats, containers, a crane, sheds, lamps."""
    length, depth = rng.uniform(100, 150), rng.uniform(26, 40)
    parts = [painted(box([0, depth / 2, -0.5], [length, depth, 1.0]), CONCRETE)]
    parts.append(box([0, 0.0, -2.0], [length, 0.4, 4.1]))  # the wall of the quay
    corners = [(-0.4, 0.12), (0.4, 0.12), (0.4, 0.3), (-0.4, 0.3)]
    weave = rng.uniform(-0.5, 0.5, size=(4, 2))
    ring = np.array([(x * length, y * depth) for x, y in corners]) + weave
    fill = np.vstack([np.linspace(a, b, 6)[:-1] for a, b in zip(ring, np.roll(ring, -1, axis=0))])
    route = smooth(np.column_stack([fill, np.zeros(len(fill))]), closed=True)
    for x in np.arange(-length / 2 + 3, length / 2, rng.uniform(7, 12)):
        parts.append(painted(cylinder([x, 0.5, 0], 0.5, 0.18, 10), 0.1))
    for x in np.arange(-length / 2 + 8, length / 2 - 8, 13.0):
        if rng.uniform() < 0.6:
            parts.append(_boat([x, -rng.uniform(3.0, 5.0), -1.4], rng))
    for x in np.arange(-length / 2 + 8, length / 2 - 8, 7.0):
        for row in (0.5, 0.62):
            for level in range(int(rng.integers(0, 4))):
                crate = box([x, row * depth, 1.3 + 2.6 * level], [6.06, 2.44, 2.59])
                parts.append(painted(_ribbed(crate), float(rng.uniform(0.1, 0.5))))
    x = -length / 2
    while x < length / 2 - 10:
        width = rng.uniform(12, 30)
        if rng.uniform() < 0.8:
            parts.append(moved(house(min(width, length / 2 - x), 12, rng.uniform(5, 11), rng),
                               [x, 0.85 * depth, 0]))  # fmt: skip
        x += width + rng.uniform(0, 6)
    crane = rng.uniform(-0.3, 0.3) * length
    for dx in (-5, 5):
        for y in (0.07 * depth, 0.4 * depth):
            parts.append(box([crane + dx, y, 9], [0.7, 0.7, 18]))
    parts.append(box([crane, 0.1 * depth, 18], [3, 1.4 * depth, 1.5]))
    for x in np.arange(-length / 2 + 10, length / 2, 25):
        parts.append(lamp([x, 0.4 * depth, 0], 9.0, -np.pi / 2))
    for _ in range(int(rng.integers(1, 4))):
        place = [rng.uniform(-0.45, 0.45) * length, 0.73 * depth, 0]
        parts.append(moved(truck(rng), place, rng.normal(scale=0.1)))
    people = walkers(int(rng.integers(2, 7)), [beside(route, 2.0)], rng)
    return join(parts), route, None, tuple(people)


def _boat(place: list[float], rng: np.random.Generator) -> Mesh:
    """Return a boat with a cabin and a mast, along the quay."""
    length = rng.uniform(6, 11)
    hull = frustum([0, 0, 0], [0, 0, 1.6], 0.8, 1.0, 12)
    hull = Mesh(hull.vertices * [length / 2, rng.uniform(1.2, 1.7), 1.0], hull.triangles)
    cabin = box([-0.1 * length, 0, 2.2], [0.35 * length, 1.6, 1.3])
    mast = cylinder([0.1 * length, 0, 1.5], rng.uniform(4, 9), 0.06, 8)
    return painted(moved(join([hull, cabin, mast]), place), float(rng.uniform(0.2, 0.8)))


def _ribbed(crate: Mesh) -> Mesh:
    """Return a container with ribs along its long sides."""
    low, high = crate.vertices.min(axis=0), crate.vertices.max(axis=0)
    middle = 0.5 * (low[2] + high[2])
    ribs = [
        box([x, y, middle], [0.12, 0.08, 2.4])
        for x in np.arange(low[0] + 0.3, high[0], 0.55)
        for y in (low[1], high[1])
    ]
    return join([crate, *ribs])
