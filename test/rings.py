"""Scans of few beams: points on rings, with noise along the ray."""

import numpy as np


def scan(hit, T_world_sensor, n_beams, elevations_deg=(-15.0, 15.0), seed=0, noise_m=0.02):
    """Return what a spinning lidar sees, in its own frame.  (N, 3).

    hit: origin (3,) and directions (M, 3) in the world to distances (M,), inf where nothing is.
    """
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.linspace(*elevations_deg, n_beams))[:, None]
    azimuth = np.radians(np.arange(0.0, 360.0, 0.4) + 0.4 * rng.random())
    horizontal = np.cos(elevation)
    rays = np.stack(
        [
            horizontal * np.cos(azimuth),
            horizontal * np.sin(azimuth),
            np.sin(elevation) + 0.0 * azimuth,
        ],
        axis=-1,
    ).reshape(-1, 3)
    with np.errstate(all="ignore"):
        distances = hit(T_world_sensor[:3, 3], rays @ T_world_sensor[:3, :3].T)
    seen = (distances > 0.0) & (distances < 80.0)
    distances = distances[seen] + noise_m * rng.normal(size=seen.sum())
    return rays[seen] * distances[:, None]


def to_plane(axis, at):
    """Return the function that hits the plane across an axis."""

    def hit(origin, rays):
        distances = (at - origin[axis]) / rays[:, axis]
        return np.where(distances > 0.0, distances, np.inf)

    return hit


def to_tunnel(radius):
    """Return the function that hits a round tunnel along x."""

    def hit(origin, rays):
        a, b = (rays[:, 1:] ** 2).sum(axis=1), rays[:, 1:] @ origin[1:]
        return (np.sqrt(b * b - a * (origin[1:] @ origin[1:] - radius**2)) - b) / a

    return hit


def to_box(x, y, z):
    """Return the function that hits a room of these half sizes about the origin, from within."""

    def hit(origin, rays):
        return np.minimum.reduce(
            [
                to_plane(axis, sign * half)(origin, rays)
                for axis, half in enumerate((x, y, z))
                for sign in (-1, 1)
            ]
        )

    return hit
