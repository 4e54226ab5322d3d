"""The constant range errors of the beams of a spinning lidar, seen on the planes of one scan.

    python benchmarks/beams.py FOLDER [FOLDER ...] [--scan 2]
    python benchmarks/beams.py --simulated 0.01

Each FOLDER is a recording. A beam is recognized by its elevation. Where the neighbourhood of a
point is a plane that at least four beams meet, the distance along each beam from the plane is
noted. A beam's error is its mean over all planes to the left, and once more to the right; the
covariance of the two, over the beams, is that of what is constant: ``offset``, its root. The
planes absorb a part of it: of simulated offsets of 10 mm it finds 3 to 8, 6 on average. ``corr``
is the correlation of left and right, ``noise`` the deviation within one beam and plane.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.spatial import cKDTree

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings import open_recording
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.simulation import Simulation

N_POINTS = 3000  # whose neighbourhoods are looked at
FEWEST_PLANES = 8  # of each beam and side


def main() -> None:
    """Print a line for each recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--scan", type=int, default=2, help="number of the scan, from 0")
    parser.add_argument(
        "--simulated", type=float, metavar="M", help="simulate offsets of M metres"
    )
    arguments = parser.parse_args()
    for path in arguments.folders:
        scan = next(islice(open_recording(path), arguments.scan, None))
        print(path.name, summary(scan.points), flush=True)
    if arguments.simulated is not None:
        for world in ("parking", "hall", "street"):
            for name in ("vlp16", "hdl32e", "hdl64e", "os1_64"):
                scanner = replace(SCANNERS[name], range_offset_m=arguments.simulated)
                for scan in Simulation(world, 77, 1, scanner):
                    print(world, name, summary(scan.points), flush=True)


def summary(points: Array) -> str:
    """Return what is found of one scan (N, 3), in the frame of the sensor, as a line."""
    points = points[np.linalg.norm(points, axis=1) > 1.0]
    rows = distances(points, beams(points))
    errors = []
    for beam in np.unique(rows[:, 0]):
        sides = [rows[(rows[:, 0] == beam) & (rows[:, 1] == side), 2] for side in (0, 1)]
        if min(map(len, sides)) >= FEWEST_PLANES:
            errors.append([side.mean() for side in sides])
    if len(errors) < 6:
        return f"{len(errors)} beams only"
    covariance = np.cov(np.array(errors).T)
    common = covariance[0, 1]
    corr = common / np.sqrt(covariance[0, 0] * covariance[1, 1])
    offset = np.sign(common) * np.sqrt(abs(common))
    noise = np.sqrt(np.mean(rows[:, 3] ** 2))
    return (
        f"{len(errors)} beams, offset {1e3 * offset:.1f} mm, corr {corr:.2f}, "
        f"noise {1e3 * noise:.0f} mm"
    )


def beams(points: Array) -> NDArray[np.intp]:
    """Return the number (N,) of each point's beam: elevations gather at those of the beams."""
    elevation = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    counts, edges = np.histogram(
        elevation, np.arange(elevation.min() - 0.1, elevation.max() + 0.1, 0.01)
    )
    smooth = gaussian_filter1d(counts.astype(float), 4)
    peaks, _ = find_peaks(smooth, height=len(points) / 5120, distance=12)
    middle = 0.5 * (edges[peaks] + edges[peaks + 1])
    return np.searchsorted(0.5 * (middle[1:] + middle[:-1]), elevation)


def distances(points: Array, beam: NDArray[np.intp]) -> Array:
    """Return a row of beam, side, mean distance from a plane and deviation for each of both."""
    tree, rows = cKDTree(points), []
    ranges = np.linalg.norm(points, axis=1)
    for k in np.random.default_rng(0).choice(len(points), min(N_POINTS, len(points)), False):
        near = neighbourhood(tree, points[k], beam) if ranges[k] < 40.0 else None
        if near is None or (found := from_plane(points[near])) is None:
            continue
        distance, fits = found
        for n in np.unique(beam[near][fits]):
            some = fits & (beam[near] == n)
            if some.sum() >= 3:
                side = float(points[k, 1] > 0.0)
                rows.append((n, side, distance[some].mean(), distance[some].std(ddof=1)))
    return np.array(rows).reshape(-1, 4)


def neighbourhood(tree: cKDTree, point: Array, beam: NDArray[np.intp]) -> list[int] | None:
    """Return at least 20 points around one that four beams have met, or None."""
    range_m = np.linalg.norm(point)
    for share in (0.06, 0.12, 0.2):
        near = tree.query_ball_point(point, max(0.4, share * range_m))
        if len(near) >= 20 and len(np.unique(beam[near])) >= 4:
            return list(near)
    return None


def from_plane(points: Array) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return the distances (n,) along the beams from the plane through points, and which fit.

    None where they are no plane, or one that a beam grazes.
    """
    fits = np.ones(len(points), np.bool_)
    for _ in range(3):
        centre = points[fits].mean(axis=0)
        _, sizes, axes = np.linalg.svd(points[fits] - centre, full_matrices=False)
        off = (points - centre) @ axes[2]
        fits = np.abs(off) < max(0.06, 3.0 * off[fits].std())
    sizes = sizes / np.sqrt(fits.sum())
    cosine = points @ axes[2] / np.linalg.norm(points, axis=1)
    is_plane = sizes[2] <= 0.035 and sizes[1] >= max(0.1, 3.0 * sizes[2]) and fits.mean() >= 0.85
    return (off / cosine, fits) if is_plane and np.abs(cosine).min() >= 0.3 else None


if __name__ == "__main__":
    main()
