"""Worlds under the sky: a garden with a pavilion, and a wood, both on uneven ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import (
    Mesh,
    box,
    facets,
    frustum,
    join,
    raised,
    terrain,
)
from cello3d_ros.simulation.paths import Route, smooth

Ground = Callable[[ArrayLike], Array]  # (..., 2) -> (...,), height in metres


def garden(rng: np.random.Generator, foliage: float = 1.0) -> tuple[Mesh, Route]:
    """Build a pavilion that the route runs through, trees, hedges and a garden wall.

    foliage: share of the leaves that hang; another share leaves everything else where it is.
    """
    ground = uneven_ground(rng, wavelengths_m=(8.0, 30.0), std_m=0.18)
    ring = _ring(rng, radius_m=rng.uniform(7.5, 11.0), wobble=0.15)
    route = _route(ring, ground)
    parts = [surface(ground, 32.0, 0.03, rng)]
    at = int(rng.integers(len(route.points) // 12, len(route.points) // 6))
    center = route.points[at]
    parts.append(_pavilion(center, route, rng))
    edge = rng.uniform(14.0, 20.0)
    parts += [
        box([sx * edge, 0.0, 0.6], [0.3, 2 * edge, 2.6]) for sx in (-1, 1) if rng.uniform() < 0.7
    ]
    for place in places(rng, 30, 2.0 * edge, 2.5):
        if route.distance(place) > 1.2 and np.linalg.norm(place - center[:2]) > 4.5:
            parts.append(_plant(np.array([*place, ground(place)]), route, rng, foliage))
    return clear_of(route, join(parts)), route


def _plant(foot: Array, route: Route, rng: np.random.Generator, foliage: float) -> Mesh:
    """Return a tree, a bush or a cut hedge, which keeps its leaves."""
    kind = rng.uniform()
    if kind < 0.6:
        return tree(foot, rng.uniform(4.0, 8.0), 220, route, rng, foliage)
    if kind < 0.85:
        bush = facets(raised(foot, 0.4), rng.uniform(0.4, 0.8, size=3), 150, 0.1, rng)
        return _thinned(bush, foliage)
    size = [rng.uniform(1.0, 2.0), rng.uniform(0.3, 0.6), rng.uniform(0.6, 1.4)]
    return box(raised(foot, 0.3), size, rng.uniform(0, np.pi))


def wood(rng: np.random.Generator, foliage: float = 1.0) -> tuple[Mesh, Route]:
    """Build a wood: trunks with branches and foliage, bushes, fallen logs, rough ground.

    foliage: as that of ``garden``.
    """
    ground = uneven_ground(rng, wavelengths_m=(3.0, 25.0), std_m=rng.uniform(0.2, 0.4))
    ring = _ring(rng, radius_m=rng.uniform(9.0, 14.0), wobble=0.25)
    route = _route(ring, ground)
    parts = [surface(ground, 36.0, 0.06, rng)]
    for place in places(rng, int(rng.integers(110, 220)), 66.0, 1.5):
        if route.distance(place) < 0.8:
            continue
        foot = np.array([*place, ground(place)])
        parts.append(tree(foot, rng.uniform(5.0, 13.0), 160, route, rng, foliage))
    for place in places(rng, 60, 50.0, 1.0):
        foot = np.array([*place, ground(place) + 0.3])
        bush = facets(foot, rng.uniform(0.3, 0.9, size=3), 90, 0.1, rng)
        parts.append(_thinned(bush, foliage))
    for place in places(rng, 6, 40.0, 3.0):
        along = rng.normal(size=2)
        end = place + rng.uniform(2.0, 5.0) * along / np.linalg.norm(along)
        if min(route.distance(np.linspace(place, end, 9))) > 0.8:
            low, high = ([*p, float(ground(p)) + 0.1] for p in (place, end))
            parts.append(frustum(low, high, 0.2, 0.13, 9))
    return clear_of(route, join(parts)), route


def uneven_ground(
    rng: np.random.Generator, wavelengths_m: tuple[float, float], std_m: float
) -> Ground:
    """Return a sum of waves of random length and direction, of the given deviation."""
    n = 10
    length = np.exp(rng.uniform(np.log(wavelengths_m[0]), np.log(wavelengths_m[1]), size=n))
    angle, phase = rng.uniform(0, 2 * np.pi, size=(2, n))
    k = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    amplitude = std_m * length / np.sqrt(0.5 * (length**2).sum())

    def height(xy: ArrayLike) -> Array:
        return np.asarray(np.sin(np.asarray(xy) @ k + phase) @ amplitude)

    return height


def surface(ground: Ground, half_m: float, roughness_m: float, rng: np.random.Generator) -> Mesh:
    """Return the ground as triangles of 0.5 m, each corner moved up or down a little."""
    x = np.arange(-half_m, half_m + 0.5, 0.5)
    z = ground(np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1))
    return terrain(x, x, z + roughness_m * rng.normal(size=z.shape))


def _ring(rng: np.random.Generator, radius_m: float, wobble: float) -> Array:
    """Return a dented circle (16, 2) around the origin, from a random side."""
    angle = rng.uniform(0, 2 * np.pi) + np.arange(16) * 2 * np.pi / 16
    phase = rng.uniform(0, 2 * np.pi, size=2)
    radius = 1 + wobble * (np.cos(2 * angle + phase[0]) + 0.5 * np.cos(3 * angle + phase[1]))
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(radius_m * radius[:, None] * ring)


def _route(ring: Array, ground: Ground) -> Route:
    """Return the curve around the ring (W, 2), on the ground."""
    way = smooth(np.concatenate([ring, np.zeros((len(ring), 1))], axis=1), closed=True)
    points = np.concatenate([way.points[:, :2], ground(way.points[:, :2])[:, None]], axis=1)
    return Route(points, closed=True)


def places(rng: np.random.Generator, n: int, side_m: float, apart_m: float) -> Array:
    """Return at most ``n`` random places (m, 2) of a square, no two nearer than ``apart_m``."""
    kept: list[Array] = []
    for place in rng.uniform(-side_m / 2, side_m / 2, size=(3 * n, 2)):
        if all(np.linalg.norm(place - other) >= apart_m for other in kept) and len(kept) < n:
            kept.append(place)
    return np.array(kept)


def tree(
    foot: Array,
    height: float,
    n_leaves: int,
    route: Route,
    rng: np.random.Generator,
    foliage: float = 1.0,
) -> Mesh:
    """Return a leaning trunk with branches, none across the route, and foliage at their ends."""
    radius = rng.uniform(0.07, 0.26)
    top = foot + np.array([*rng.normal(scale=0.05 * height, size=2), height])
    parts = [frustum(raised(foot, -0.5), top, radius, 0.4 * radius, 10)]
    n_branches = int(rng.integers(4, 9))
    for share in rng.uniform(0.35, 0.95, size=n_branches):
        base = foot + share * (top - foot)
        angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.35) * height * (1.1 - share)
        rise = rng.uniform(0.1, 0.6)
        end = base + reach * np.array([np.cos(angle), np.sin(angle), rise])
        if base[2] - foot[2] > 3.5 or min(route.distance(np.linspace(base, end, 9)[:, :2])) > 0.6:
            parts.append(frustum(base, end, 0.25 * radius, 0.1 * radius, 5))
        blob = rng.uniform(0.4, 0.9, size=3) * max(0.8, 0.12 * height)
        leaves = facets(end, blob, n_leaves // n_branches, 0.14, rng)
        parts.append(_thinned(leaves, foliage))
    return join(parts)


def _thinned(leaves: Mesh, share: float) -> Mesh:
    """Return the first of some leaves, which were drawn in no order."""
    return _only(leaves, slice(round(share * len(leaves.triangles))))


def _only(mesh: Mesh, rows: NDArray[np.bool_] | slice) -> Mesh:
    """Return the mesh with some of its triangles."""
    return Mesh(mesh.vertices, mesh.triangles[rows], mesh.reflectances()[rows])


def _pavilion(center: Array, route: Route, rng: np.random.Generator) -> Mesh:
    """Return a floor, pillars around it with a beam on top, a pointed roof and benches.

    It is turned so that the pillars keep clear of the route.
    """
    n = int(rng.choice([4, 6, 8]))
    radius, height = rng.uniform(2.3, 3.2), rng.uniform(2.4, 3.0)
    angle = np.arange(n) * 2 * np.pi / n + np.linspace(0, 2 * np.pi / n, 25)[:, None]
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    clearance = route.distance(center[:2] + radius * out[..., :2]).min(axis=1)
    feet = center + radius * out[np.argmax(clearance)]
    thick = rng.uniform(0.1, 0.17)
    up = np.array([0.0, 0.0, height])
    parts = [
        frustum(raised(center, -1.0), raised(center, 0.05), radius + 0.3, radius + 0.3, 24),
        frustum(center + up, center + up * 1.45, radius + 0.6, 0.1, n),
    ]
    for k in range(n):
        foot, following = feet[k], feet[(k + 1) % n]
        parts.append(frustum(raised(foot, -0.5), foot + up, thick, thick, 12))
        parts.append(frustum(foot + up * 0.95, following + up * 0.95, 0.1, 0.1, 4))
        middle = 0.5 * (foot + following)
        side = following - foot
        if route.distance(middle[:2]) > 0.5 * np.linalg.norm(side) + 0.3:
            size = [0.8 * float(np.linalg.norm(side)), 0.35, 0.45]
            yaw = float(np.arctan2(side[1], side[0]))
            parts.append(box(raised(middle, 0.25), size, yaw))
    return join(parts)


def clear_of(route: Route, mesh: Mesh) -> Mesh:
    """Return the mesh without the small facets that hang over the route at a person's height."""
    corners = mesh.vertices[mesh.triangles]
    small = np.ptp(corners, axis=1).max(axis=1) < 0.3
    middle = corners.mean(axis=1)
    _, nearest = route.nearest(middle[:, :2])
    above = middle[:, 2] - route.points[nearest, 2]
    hit = small & (route.distance(middle[:, :2]) < 0.6) & (above > 0.35) & (above < 2.4)
    return _only(mesh, ~hit)
