"""Worlds of roads: a block of streets with crossings, a highway, a tunnel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh, box, cylinder, join, moved, painted, terrain
from cello3d_ros.simulation.movers import Mover
from cello3d_ros.simulation.outdoor import Ground, tree, uneven_ground
from cello3d_ros.simulation.paths import Route, smooth
from cello3d_ros.simulation.things import (
    ASPHALT,
    CONCRETE,
    LEAF,
    beside,
    bush,
    car,
    extruded,
    fence,
    house,
    lamp,
    sign,
    traffic,
    walkers,
)

FAR = Route(np.array([[0, 500.0, 0], [1, 500.0, 0]]), closed=False)  # in the way of nothing

World = tuple[Mesh, Route, Mesh | None, tuple[Mover, ...]]


class _Street(NamedTuple):
    road: float  # half width, metres
    walk: float  # width of a sidewalk
    ground: Ground


def street(rng: np.random.Generator) -> World:
    """Build the four streets around a block of houses, with what stands and moves in them."""
    half = rng.uniform([32, 24], [50, 36])  # from the middle of the block to that of the streets
    road, walk = rng.uniform(3.2, 5.0), rng.uniform(2.0, 3.5)  # half width; of a sidewalk
    ground = uneven_ground(rng, wavelengths_m=(12.0, 50.0), std_m=0.06)
    route = _on(ground, smooth(_rectangle(half + 0.5 * road), closed=True))
    middle = _on(ground, smooth(_rectangle(half), closed=True))
    parts = [_floor(ground, 3.0 * half, 0.006, rng)]
    plan = _Street(road, walk, ground)
    parts += _sidewalks(half, plan)
    for side in range(4):
        parts += _row(side, half, plan, rng)
    ways = [beside(middle, sign_ * (road + 0.5 * walk)) for sign_ in (-1, 1)]
    movers = [
        *traffic(3, beside(route, road), (4.0, 9.0), rng),
        *walkers(int(rng.integers(4, 14)), [_on(ground, w, 0.12) for w in ways], rng),
    ]
    oncoming = [Mover(m.mesh, m.route, m.start_m, -m.speed_m_s) for m in movers[:3]]
    return join(parts), route, None, (*oncoming, *movers[3:])


def _rectangle(half: Array) -> Array:
    """Return corners of a rectangle about the origin, counterclockwise, from a long side on."""
    x, y = half
    shape = [(0.0, -y), (x - 4, -y), (x, -y), (x, -y + 4), (x, y - 4), (x, y), (x - 4, y)]
    shape += [(4 - x, y), (-x, y), (-x, y - 4), (-x, 4 - y), (-x, -y), (4 - x, -y)]
    return np.column_stack([np.array(shape), np.zeros(len(shape))])


def _on(ground: Ground, way: Route, above_m: float = 0.0) -> Route:
    points = way.points.copy()
    points[:, 2] = ground(points[:, :2]) + above_m
    return Route(points, way.closed)


def _floor(ground: Ground, half: Array, roughness_m: float, rng: np.random.Generator) -> Mesh:
    x, y = (np.arange(-h, h + 1.0, 1.0) for h in half)
    z = ground(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))
    return painted(terrain(x, y, z + roughness_m * rng.normal(size=z.shape)), ASPHALT)


def _sidewalks(half: Array, plan: _Street) -> list[Mesh]:
    """Return the raised sidewalks: around the block, and around the eight blocks about it."""
    parts = []
    inner, walk, ground = half - plan.road, plan.walk, plan.ground
    for sx in (-1, 0, 1):
        for sy in (-1, 0, 1):
            center = 2 * half * [sx, sy]
            ring = _on(ground, smooth(_rectangle(inner) + [*center, 0.0], closed=True), 0.0)
            points, heading = ring.points[::10], ring.heading_rad[::10]
            points, heading = np.vstack([points, ring.points[:1]]), np.append(heading, heading[0])
            profile = [(0.0, -0.2), (0.0, 0.12), (walk, 0.13), (walk, -0.2)]
            parts.append(painted(extruded(profile, points, heading), CONCRETE))
    return parts


Placed = tuple[Mesh, float, float, float]  # a thing, x along a street, y to its left, its turn


def _row(side: int, half: Array, plan: _Street, rng: np.random.Generator) -> list[Mesh]:
    """Return what stands along both edges of one of the four streets."""
    yaw = side * np.pi / 2
    length, away = (2 * half[0], half[1]) if side % 2 == 0 else (2 * half[1], half[0])
    reach = length / 2 - plan.road - 1.0
    parts = []
    for edge in (1.0, -1.0):  # toward the block, and away from it
        things = [*_houses(reach, edge, plan, rng), *_furniture(reach, edge, plan, rng)]
        for mesh, x, y, turn in things:
            spot = x * np.array([np.cos(yaw), np.sin(yaw)])
            spot += (y - away) * np.array([-np.sin(yaw), np.cos(yaw)])
            parts.append(moved(mesh, [*spot, float(plan.ground(spot))], yaw + turn))
    return parts


def _houses(
    reach: float, edge: float, plan: _Street, rng: np.random.Generator
) -> Iterator[Placed]:
    """Yield the houses of one edge, on the outer one beyond the crossings too, and gardens."""
    further = 30.0 if edge < 0 else 0.0
    x, end = -reach - further, reach + further
    front = edge * (plan.road + plan.walk)
    while x < end - 6.0:
        crossing = reach < abs(x + 5.0) < reach + 2 * plan.road + 2.0
        width = min(rng.uniform(8.0, 20.0), end - x)
        if x < reach < x + width:
            width = max(6.0, reach - x)
        if not crossing and rng.uniform() < 0.85:
            built = house(width, rng.uniform(7, 10), rng.uniform(5, 20), rng)
            set_back = edge * rng.uniform(0.0, 1.5)
            corner = (x, 0.0) if edge > 0 else (x + width, np.pi)
            yield built, corner[0], front + set_back, corner[1]
        elif not crossing:
            yield fence([0, 0, 0], [width, 0, 0], rng.uniform(0.9, 1.6)), x, front, 0.0
            shrub = bush([0, 0, 0], rng.uniform(0.6, 1.5, size=3), rng)
            yield shrub, x + width / 2, front + 3.0 * edge, 0.0
        x += width


def _furniture(
    reach: float, edge: float, plan: _Street, rng: np.random.Generator
) -> Iterator[Placed]:
    """Yield parked cars, trees, lamps, signs and bins of one edge."""
    kerb = edge * plan.road
    for x in np.arange(-reach + rng.uniform(2, 6), reach - 2, 5.6):
        if rng.uniform() < 0.55:  # parked half on the sidewalk
            turn = np.pi * float(rng.uniform() < 0.5) + rng.normal(scale=0.03)
            yield car(rng), x, kerb + 0.35 * edge, turn
    for x in np.arange(-reach + rng.uniform(1, 8), reach, rng.uniform(9, 16)):
        if rng.uniform() < 0.6:
            grown = tree(np.zeros(3), rng.uniform(5, 9), 180, FAR, rng)
            yield painted(grown, LEAF), x, kerb + 1.6 * edge, 0.0
        else:
            yield lamp([0, 0, 0], rng.uniform(5, 8), -edge * np.pi / 2), x, kerb + 1.5 * edge, 0.0
    for x in (-reach, reach):
        yield sign([0, 0, 0], rng.uniform(-np.pi, np.pi), rng), x, kerb + 1.3 * edge, 0.0
    for _ in range(int(rng.integers(1, 5))):
        bin_ = box([0, 0, 0.55], rng.uniform([0.4, 0.4, 0.9], [1.2, 0.8, 1.3]))
        yield bin_, rng.uniform(-reach, reach), kerb + edge * (plan.walk - 0.4), 0.0


def highway(rng: np.random.Generator) -> World:
    """Build two carriageways with rails, signs, slopes, trees and traffic; the route is a lane."""
    length = 900.0
    x = np.arange(0.0, length, 15.0)
    bend = rng.uniform(5, 30) * np.sin(2 * np.pi * x / rng.uniform(500, 1200) + rng.uniform(0, 6))
    axis = smooth(np.column_stack([x, bend, np.zeros(len(x))]), closed=False)
    axis = Route(axis.points[::20], closed=False)  # a point each metre
    median, lanes = rng.uniform(1.2, 2.5), int(rng.integers(2, 4))
    edge = median + 1.0 + 3.6 * lanes + 2.5
    at, heading = axis.points, axis.heading_rad

    def run(profile: list[tuple[float, float]], reflectance: float) -> Mesh:
        return painted(extruded(profile, at, heading), reflectance)

    slope = rng.uniform(-0.25, 0.4, size=2)
    parts = [run([(-edge, -0.02 * edge), (0.0, 0.0), (edge, -0.02 * edge)], ASPHALT)]
    for side, rise in ((-1, slope[0]), (1, slope[1])):
        low = -0.02 * edge
        bank = [(edge, low), (edge + 4, low - 0.3), (edge + 16, low + 12 * rise)]
        bank.append((edge + 70, low + 12 * rise + 1.0))
        parts.append(run([(side * y, z) for y, z in bank][::side], LEAF))
        parts += _rail(axis, side * (edge - 0.4))
    if rng.uniform() < 0.5:
        parts.append(run([(-0.3, 0), (-0.15, 0.3), (-0.1, 0.9), (0.1, 0.9), (0.15, 0.3), (0.3, 0)],
                         CONCRETE))  # fmt: skip
    else:
        parts += _rail(axis, 0.3) + _rail(axis, -0.3)
    parts += _roadside(axis, edge, slope, rng)
    own = beside(axis, -(median + 1.0 + 3.6 * 0.5))
    middles = [median + 1.0 + 3.6 * (lane + 0.5) for lane in range(lanes)]
    movers = [m for y in middles for m in traffic(9, beside(axis, y), (22, 36), rng)]
    movers = [Mover(m.mesh, m.route, m.start_m, -m.speed_m_s) for m in movers]
    movers += [m for y in middles[1:] for m in traffic(9, beside(axis, -y), (22, 36), rng)]
    return join(parts), Route(_fine(own.points[60:-60]), closed=False), None, tuple(movers)


def _roadside(axis: Route, edge: float, slope: Array, rng: np.random.Generator) -> list[Mesh]:
    """Return gantries, marker posts, at times a noise barrier, and trees on the slopes."""
    at, heading, parts = axis.points, axis.heading_rad, []
    for k in range(int(rng.uniform(10, 60)), len(at) - 5, int(rng.uniform(90, 220))):
        parts.append(_gantry(at[k], float(heading[k]), edge, rng))
    for k in range(0, len(at), 50):
        for side in (-1, 1):
            post = cylinder([0, side * (edge - 0.1), 0.0], 0.8, 0.06, 6)
            parts.append(painted(moved(post, at[k] - [0, 0, 0.2], float(heading[k])), 0.8))
    if rng.uniform() < 0.5:
        first = int(rng.integers(0, len(at) // 2))
        part = slice(first, first + int(rng.integers(80, 250)))
        wall = [(edge + 1.2, -1.0), (edge + 1.2, 3.5), (edge + 1.4, 3.5), (edge + 1.4, -1.0)]
        parts.append(painted(extruded(wall, at[part], heading[part]), CONCRETE))
    for _ in range(int(rng.integers(30, 90))):
        k, side = int(rng.integers(len(at))), int(rng.choice([-1, 1]))
        foot = [0.0, side * rng.uniform(edge + 14, edge + 40), 12 * slope[(side + 1) // 2] - 0.3]
        grown = painted(tree(np.zeros(3), rng.uniform(5, 14), 160, FAR, rng), LEAF)
        parts.append(moved(moved(grown, foot), at[k], float(heading[k])))
    return parts


def _fine(points: Array) -> Array:
    """Return a curve with ten times the points."""
    at = np.linspace(0, len(points) - 1, 10 * len(points))
    return np.stack([np.interp(at, np.arange(len(points)), c) for c in points.T], axis=1)


def _rail(axis: Route, left_m: float) -> list[Mesh]:
    """Return a guard rail on posts beside the axis of a road."""
    line = beside(axis, left_m)
    profile = [(0.0, 0.45), (0.03, 0.55), (0.0, 0.6), (0.03, 0.65), (0.0, 0.75)]
    posts = [
        box(p - [0, 0, 0.05], [0.08, 0.12, 1.4], float(h))
        for p, h in zip(line.points[::4], line.heading_rad[::4], strict=True)
    ]
    return [painted(extruded(profile, line.points, line.heading_rad), 0.5), join(posts)]


def _gantry(place: Array, heading: float, edge: float, rng: np.random.Generator) -> Mesh:
    """Return a bridge of signs across one carriageway, or both."""
    low = -edge if rng.uniform() < 0.5 else 0.0
    posts = [box([0, y, 3.2], [0.4, 0.4, 7.4]) for y in (low, edge)]
    beam = box([0, 0.5 * (low + edge), 6.7], [0.5, edge - low, 0.6])
    plates = [
        painted(box([-0.3, y, 6.6], [0.06, 3.0, 2.2]), 0.9)
        for y in np.arange(low + 4, edge - 3, 5)
    ]
    return moved(join([*posts, beam, *plates]), place, heading)


def tunnel(rng: np.random.Generator) -> World:
    """Build a road tunnel: a vault with lamps, cables, niches and signs, or next to nothing."""
    length, plain = rng.uniform(250, 400), rng.uniform() < 0.25
    x = np.arange(0.0, length, 10.0)
    bend = rng.uniform(0, 12) * np.sin(2 * np.pi * x / rng.uniform(300, 800))
    fall = rng.uniform(-0.03, 0.03) * x
    axis = smooth(np.column_stack([x, bend, fall]), closed=False, spacing_m=0.1)
    at, heading = axis.points[::10], axis.heading_rad[::10]
    half, spring, top = rng.uniform(4.0, 6.0), rng.uniform(1.5, 3.0), rng.uniform(4.8, 6.5)
    angle = np.linspace(0, np.pi, 15)
    vault = np.stack([half * np.cos(angle), spring + (top - spring) * np.sin(angle)], axis=1)
    profile = np.vstack([[half, 0.0], vault, [-half, 0.0]])
    kerb = [(half, 0.15), (half - 0.9, 0.15), (half - 0.9, 0.0)]
    floor = [(half, 0.0), (-half, 0.0)]
    parts = [painted(extruded(profile, at, heading), CONCRETE)]
    parts.append(painted(extruded(floor, at, heading), ASPHALT))
    parts.append(extruded(kerb, at, heading))
    parts.append(extruded([(-y, z) for y, z in kerb], at, heading))
    for end, k in ((-0.2, 0), (0.2, -1)):
        parts.append(moved(box([end, 0, 3], [0.2, 30, 14]), at[k], float(heading[k])))
    if not plain:
        parts += _fittings(axis, half, spring + 0.85 * (top - spring), rng)
    lane = Route(beside(axis, -0.45 * half).points[100:-100], closed=False)  # 10 m off its ends
    movers = (
        [] if plain else traffic(int(rng.integers(1, 4)), beside(axis, 0.45 * half), (8, 20), rng)
    )
    oncoming = tuple(Mover(m.mesh, m.route, m.start_m, -m.speed_m_s) for m in movers)
    return join(parts), lane, None, oncoming


def _fittings(
    axis: Route, half: float, lamp_height: float, rng: np.random.Generator
) -> list[Mesh]:
    """Return a cable tray, lamps, doors and signs of a tunnel."""
    at, heading, parts = axis.points[::10], axis.heading_rad[::10], []
    side = float(rng.choice([-1, 1]))
    tray = [
        (side * (half - 0.05), 2.2),
        (side * (half - 0.35), 2.2),
        (side * (half - 0.35), 2.1),
    ]
    parts.append(extruded(tray, at, heading))
    for k in range(5, len(at), int(rng.integers(8, 20))):
        light = box([0, side * 0.4 * half, lamp_height], [1.4, 0.25, 0.15])
        parts.append(moved(light, at[k], float(heading[k])))
    for k in range(int(rng.integers(5, 20)), len(at), int(rng.integers(25, 60))):
        door = box([0, side * (half - 0.05), 1.2], [rng.uniform(1.0, 3.0), 0.3, 2.4])
        parts.append(moved(door, at[k], float(heading[k])))
        plate = painted(box([3, -side * (half - 0.4), 2.4], [0.05, 0.6, 0.6]), 0.9)
        parts.append(moved(plate, at[k], float(heading[k])))
    return parts
