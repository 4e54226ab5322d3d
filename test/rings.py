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


def to_meadow(amplitude_m, grass_m, trees, seed, below_m=1.5):
    """Return the function that hits uneven ground with grass, its height and trees on it.

    amplitude_m: deviation of the ground's height, waves of 2 to 25 m; grass_m: how far short of
    the ground beams end; trees: trunks and round crowns at (n, 2).
    """
    rng = np.random.default_rng(seed)
    wave, turn, phase = (
        np.exp(rng.uniform(np.log(2.0), np.log(25.0), 24)),
        *rng.uniform(0.0, 2.0 * np.pi, (2, 24)),
    )
    K = 2.0 * np.pi / wave * [np.cos(turn), np.sin(turn)]

    def height(xy):
        return amplitude_m * np.sqrt(2.0 / 24.0) * np.cos(xy @ K + phase).sum(axis=-1)

    def hit(origin, rays):
        down = rays[:, 2] < -0.005
        ground = np.where(down, -(below_m + origin[2]) / rays[:, 2], np.inf)
        for _ in range(6):  # the ground is nearly flat: each look comes nearer
            at = origin[:2] + rays[:, :2] * np.minimum(ground, 200.0)[:, None]
            ground = np.where(down, (height(at) - below_m - origin[2]) / rays[:, 2], np.inf)
        short = np.abs(rng.normal(0.0, grass_m, len(rays)))
        found = ground - 0.3 * short / np.maximum(np.abs(rays[:, 2]), 0.05)
        for tree in trees:
            for radius, low, high in ((0.15, -1.7, 2.0), (1.2, 2.0, 6.0)):
                shaft = _to_shaft(tree, radius, low, high)(origin, rays)
                found = np.minimum(found, shaft)
        return found

    return hit, height


def _to_shaft(place, radius, low, high):
    """Return the function that hits a round shaft that stands upright."""

    def hit(origin, rays):
        q = origin[:2] - place
        a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ q
        distances = -(b + np.sqrt(b * b - a * (q @ q - radius**2))) / a
        z = origin[2] + distances * rays[:, 2]
        return np.where((distances > 0.0) & (z > low) & (z < high), distances, np.inf)

    return hit
