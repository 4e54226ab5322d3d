"""Triangle meshes of simple solids, the material that simulated worlds are made of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.geometry.se3 import Array

_REFLECTANCE = 0.3

_BOX_TRIANGLES = np.array(
    [
        *((0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4)),
        *((2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)),
    ]
)


@dataclass(frozen=True)
class Mesh:
    """Triangles in space.

    vertices: (V, 3), metres.  triangles: (F, 3) indices into the vertices.
    reflectance: (F,), share of the light that comes back from a triangle that is hit head-on; 0.3
    where it is not given.
    """

    vertices: Array
    triangles: NDArray[np.int64]
    reflectance: Array | None = None

    def reflectances(self) -> Array:
        """Return the reflectance (F,) of every triangle."""
        if self.reflectance is None:
            return np.full(len(self.triangles), _REFLECTANCE)
        return self.reflectance


def painted(mesh: Mesh, reflectance: float) -> Mesh:
    """Return the mesh with one reflectance for all its triangles."""
    return replace(mesh, reflectance=np.full(len(mesh.triangles), float(reflectance)))


def moved(mesh: Mesh, place: ArrayLike, yaw_rad: float = 0.0) -> Mesh:
    """Return the mesh turned by ``yaw_rad`` about the vertical at its origin, then moved."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = mesh.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return replace(mesh, vertices=turned + np.asarray(place, dtype=np.float64))


def raised(point: ArrayLike, height_m: float) -> Array:
    """Return the point (3,) moved up."""
    x, y, z = np.asarray(point, dtype=np.float64)
    return np.array([x, y, z + height_m])


def join(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh with the triangles of all."""
    vertices: list[Array] = [np.zeros((0, 3))]
    triangles: list[NDArray[np.int64]] = [np.zeros((0, 3), dtype=np.int64)]
    reflectances = [np.zeros(0)]
    n_vertices = 0
    for mesh in meshes:
        vertices.append(mesh.vertices)
        triangles.append(mesh.triangles + n_vertices)
        reflectances.append(mesh.reflectances())
        n_vertices += len(mesh.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(triangles), np.concatenate(reflectances))


def box(center: ArrayLike, size: ArrayLike, yaw_rad: float = 0.0) -> Mesh:
    """Return a box turned by ``yaw_rad`` about the vertical through its center."""
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) - 0.5
    local = corners * np.asarray(size, dtype=np.float64)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = local @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(turned + np.asarray(center, dtype=np.float64), _BOX_TRIANGLES)


def block(low: ArrayLike, high: ArrayLike) -> Mesh:
    """Return the box between two opposite corners, parallel to the axes."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return box(0.5 * (low + high), high - low)


def frustum(
    base: ArrayLike, top: ArrayLike, radius_m: float, top_radius_m: float, n_sides: int = 12
) -> Mesh:
    """Return a closed cylinder, cone or anything between, from ``base`` to ``top``, both (3,)."""
    base, top = np.asarray(base, dtype=np.float64), np.asarray(top, dtype=np.float64)
    axis = (top - base) / np.linalg.norm(top - base)
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[2]) > 0.5 else [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    angle = np.arange(n_sides) * 2 * np.pi / n_sides
    ring = np.outer(np.cos(angle), across) + np.outer(np.sin(angle), np.cross(axis, across))
    vertices = np.concatenate([base + radius_m * ring, top + top_radius_m * ring, [base, top]])
    i = np.arange(n_sides)
    j = (i + 1) % n_sides
    sides = [np.stack(t, axis=1) for t in ((i, j, i + n_sides), (j, j + n_sides, i + n_sides))]
    caps = [
        np.stack([j, i, np.full(n_sides, 2 * n_sides)], axis=1),
        np.stack([i + n_sides, j + n_sides, np.full(n_sides, 2 * n_sides + 1)], axis=1),
    ]
    return Mesh(vertices, np.concatenate(sides + caps))


def cylinder(base: ArrayLike, height_m: float, radius_m: float, n_sides: int = 12) -> Mesh:
    """Return an upright cylinder."""
    return frustum(base, raised(base, height_m), radius_m, radius_m, n_sides)


def facets(
    center: ArrayLike, radii: ArrayLike, n_facets: int, size_m: float, rng: np.random.Generator
) -> Mesh:
    """Return foliage: loose triangles, randomly placed and turned inside an ellipsoid."""
    direction = rng.normal(size=(n_facets, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    depth = rng.uniform(0.3, 1.0, size=(n_facets, 1)) ** (1 / 2)
    middle = np.asarray(center) + np.asarray(radii) * direction * depth
    corners = middle[:, None] + rng.uniform(-size_m, size_m, size=(n_facets, 3, 3))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * n_facets).reshape(-1, 3))


def terrain(x: Array, y: Array, z: Array) -> Mesh:
    """Return the surface with height ``z`` (X, Y) over the grid lines ``x`` (X,), ``y`` (Y,)."""
    grid = np.stack([*np.meshgrid(x, y, indexing="ij"), z], axis=-1)
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    halves = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    return Mesh(grid.reshape(-1, 3), np.concatenate(halves))


def wall(
    start: ArrayLike,
    end: ArrayLike,
    z_m: tuple[float, float],
    openings: Iterable[tuple[float, float, float, float]] = (),
    thickness_m: float = 0.12,
) -> Mesh:
    """Return a wall along x or y from ``start`` to ``end`` (2,) with rectangular openings.

    openings: each (along, width, bottom, top) in metres: the middle, measured from ``start``,
    and the heights of sill and lintel; they must not meet.
    """
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    half = 0.5 * thickness_m * np.abs(along[::-1])

    def piece(a: float, b: float, low: float, high: float) -> list[Mesh]:
        if b - a <= 1e-6 or high - low <= 1e-6:
            return []
        ends = np.stack([start + a * along, start + b * along])
        return [block([*(ends.min(0) - half), low], [*(ends.max(0) + half), high])]

    pieces, done = [], 0.0
    for middle, width, bottom, top in sorted(openings):
        left, right = middle - 0.5 * width, middle + 0.5 * width
        pieces += piece(done, left, *z_m) + piece(left, right, z_m[0], bottom)
        pieces += piece(left, right, top, z_m[1])
        done = right
    return join(pieces + piece(done, length, *z_m))
