"""The way of a scanner through a world: a smooth curve, and poses along it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from cello3d_ros.clouds.neighbors import build_tree, nearest
from cello3d_ros.geometry.se3 import Array

_MAX_TURN_RAD = np.radians(12.0)  # a step; the sway adds about 2
_SWAY_STD = np.array([np.radians(1.5), np.radians(1.5), np.radians(2.0), 0.03])  # r, p, y, height
_SWAY_MEMORY = 0.8


@dataclass(frozen=True)
class Route:
    """A curve on the floor.

    points: (M, 3), dense.  A closed route is walked round and round, an open one to and fro
    (backwards on the way back).
    """

    points: Array
    closed: bool

    @cached_property
    def arc_m(self) -> Array:
        """Arc length (M,) at each point."""
        return _arc_length(self.points)

    @cached_property
    def heading_rad(self) -> Array:
        """Direction (M,) of the curve in the plane at each point, without jumps of 2 pi.

        Smoothed over a metre.
        """
        step = np.diff(self.points[:, :2], axis=0)
        turned = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        spacing = self.arc_m[-1] / (len(self.points) - 1)
        half = min(int(0.5 / spacing), (len(turned) - 1) // 2)
        if self.closed:
            lap = 2 * np.pi * np.round((turned[-1] - turned[0]) / (2 * np.pi))
            turned = np.concatenate(
                [turned[len(turned) - half :] - lap, turned, turned[: half + 1] + lap]
            )
        else:
            turned = np.pad(turned, (half, half + 1), mode="edge")
        window = np.ones(2 * half + 1) / (2 * half + 1)
        return np.convolve(turned, window, mode="valid")

    def at(self, s_m: ArrayLike) -> tuple[Array, Array]:
        """Return places (..., 3) and headings (...) at arc lengths (...), which start over."""
        s = np.asarray(s_m, dtype=np.float64) % self.arc_m[-1]
        places = [np.interp(s, self.arc_m, c) for c in self.points.T]
        return np.stack(places, axis=-1), np.interp(s, self.arc_m, self.heading_rad)

    def distance(self, xy: ArrayLike) -> Array:
        """Return the horizontal distance (...) of points (..., 2) from the curve."""
        return self.nearest(xy)[0]

    def nearest(self, xy: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
        """Return that distance, and the index of the nearest point of the curve."""
        xy = np.asarray(xy, dtype=np.float64)
        tree = build_tree(self.points * [1.0, 1.0, 0.0])
        flat = np.pad(xy.reshape(-1, 2), ((0, 0), (0, 1)))
        distances2, indices = nearest(tree, flat, 1)
        shape = xy.shape[:-1]
        return np.sqrt(distances2).reshape(shape), tree.order[indices].reshape(shape)


def smooth(corners: ArrayLike, closed: bool, spacing_m: float = 0.05) -> Route:
    """Return the curve that cuts the corners (W, 3) of a polygon (Chaikin 1974).

    It stays in the hull of each three successive corners: straight on where they are in line.
    """
    points = np.asarray(corners, dtype=np.float64)
    for _ in range(5):
        following = np.roll(points, -1, axis=0)
        quarter = 0.25 * (following - points)
        cut = np.stack([points + quarter, following - quarter], axis=1).reshape(-1, 3)
        points = cut if closed else np.concatenate([points[:1], cut[1:-3], points[-1:]])
    if closed:
        points = np.concatenate([points, points[:1]])
    s = _arc_length(points)
    even = np.linspace(0.0, s[-1], max(2, int(s[-1] / spacing_m)))
    return Route(np.stack([np.interp(even, s, c) for c in points.T], axis=1), closed)


@dataclass(frozen=True)
class Course:
    """One of the ways to walk along a route.

    step_m: mean length of a step, each within a fifth of it.  start_m: arc length of the first
    scan.  aside_m: distance to the left of the route.  seed: of steps, sway and height.
    """

    step_m: float
    start_m: float = 0.0
    aside_m: float = 0.0
    seed: int = 0


def walk(
    route: Route,
    n_scans: int,
    height_m: float,
    rng: np.random.Generator,
    course: Course | None = None,
) -> Array:
    """Return sensor poses T_world_sensor (n_scans, 4, 4) along the route.

    Without a course steps are 0.4 to 0.9 m long, and at least 0.3 m where the curve turns.  The
    sensor looks along the curve, turning by at most 12 degrees a step, and sways in roll, pitch,
    yaw and height.  A longer walk starts like a shorter one of the same generator.
    """
    step_rng, sway_rng = rng.spawn(2)
    s = _arc_length(route.points)
    if course is None:
        at, yaw = _steps(route, s, n_scans, step_rng)
        place = np.stack([np.interp(at, s, c) for c in route.points.T], axis=1)
    else:
        place, yaw = _on_course(route, course, n_scans, step_rng)
    sway = _sway(n_scans, sway_rng)
    T = np.tile(np.eye(4), (n_scans, 1, 1))
    angles = np.stack([yaw + sway[:, 2], sway[:, 1], sway[:, 0]], axis=1)
    T[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    T[:, :3, 3] = place
    T[:, 2, 3] += height_m + sway[:, 3]
    return T


def _steps(route: Route, s: Array, n_scans: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the arc length and the yaw of each scan; ``s`` is the arc length of the points."""
    forward = np.diff(route.points, axis=0)
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    length = s[-1]
    walked, at, yaw = 0.0, [0.0], [heading[0]]
    for step in rng.uniform(0.4, 0.9, size=n_scans - 1):
        here = heading[min(int(np.searchsorted(s, at[-1], side="right")), len(heading)) - 1]
        turn = (here - yaw[-1] + np.pi) % (2 * np.pi) - np.pi
        walked += max(0.3, 0.6 * step) if abs(turn) > _MAX_TURN_RAD else step
        fro = length - abs(walked % (2 * length) - length)
        at.append(walked % length if route.closed else fro)
        yaw.append(yaw[-1] + np.clip(turn, -_MAX_TURN_RAD, _MAX_TURN_RAD))
    return np.array(at), np.array(yaw)


def _on_course(
    route: Route, course: Course, n_scans: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return the place (n, 3) and the yaw (n,) of each scan of a walk on a course."""
    steps = course.step_m * rng.uniform(0.8, 1.2, size=n_scans - 1)
    s = course.start_m + np.concatenate([[0.0], np.cumsum(steps)])
    if not route.closed:
        s = route.arc_m[-1] - np.abs(s % (2 * route.arc_m[-1]) - route.arc_m[-1])
    place, heading = route.at(s)
    yaw = [heading[0]]
    for wanted in heading[1:]:
        turn = (wanted - yaw[-1] + np.pi) % (2 * np.pi) - np.pi
        yaw.append(yaw[-1] + np.clip(turn, -_MAX_TURN_RAD, _MAX_TURN_RAD))
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros(n_scans)], axis=1)
    return place + course.aside_m * left, np.array(yaw)


def _sway(n_scans: int, rng: np.random.Generator) -> Array:
    """Return smooth noise (n_scans, 4): roll, pitch, yaw, height, of stationary deviation."""
    fresh = rng.normal(size=(n_scans, 4)) * _SWAY_STD
    out = fresh.copy()
    for k in range(1, n_scans):
        out[k] = _SWAY_MEMORY * out[k - 1] + np.sqrt(1 - _SWAY_MEMORY**2) * fresh[k]
    return np.asarray(out)


def _arc_length(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
