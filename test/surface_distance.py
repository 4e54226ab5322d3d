"""Distances of points from triangles, by the formula of closest points; an oracle for scans."""

import numpy as np


def _to_segments(points, a, b):
    along = b - a
    length2 = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", points - a, along) / np.where(length2 > 0, length2, 1.0)
    return np.linalg.norm(a + np.clip(share, 0, 1)[:, None] * along - points, axis=1)


def _to_triangles(point, corners):
    """Return the distance (F,) of a point from triangles (F, 3, 3)."""
    p = np.broadcast_to(point, (len(corners), 3))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = [_to_segments(p, *ends) for ends in ((a, b), (b, c), (c, a))]
    n = np.cross(b - a, c - a)
    size = np.linalg.norm(n, axis=1)
    n = n / np.where(size > 0, size, 1.0)[:, None]
    height = np.einsum("ij,ij->i", p - a, n)
    foot = p - height[:, None] * n
    sides = [
        np.einsum("ij,ij->i", np.cross(v - u, foot - u), n) >= 0
        for u, v in ((a, b), (b, c), (c, a))
    ]
    inside = np.all(sides, axis=0) & (size > 0)
    return np.where(inside, np.abs(height), np.min(edges, axis=0))


def surface_distances(mesh, points, within_m=0.5):
    """Return the distance (N,) of points from a mesh; ``within_m`` stands for any beyond."""
    corners = mesh.vertices[mesh.triangles]
    low, high = corners.min(axis=1) - within_m, corners.max(axis=1) + within_m
    out = np.full(len(points), within_m)
    for k, point in enumerate(points):
        near = np.flatnonzero(np.all((low <= point) & (point <= high), axis=1))
        if len(near):
            out[k] = min(within_m, _to_triangles(point, corners[near]).min())
    return out
