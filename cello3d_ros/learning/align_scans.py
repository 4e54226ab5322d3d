"""The clouds of a recording on disk, so that any scan can be read again in little memory."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import crop_range, limit_density, subsample
from cello3d_ros.clouds.motion import undistorted
from cello3d_ros.config import CloudConfig
from cello3d_ros.errors import CloudError
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.recording import Scan

_MAX_POINTS = 20_000  # of a scan: with its neighbours they are 17 times as many

_Single = tuple[NDArray[np.float32], NDArray[np.float32]]  # points and normals


class RawScan(NamedTuple):
    """Filtered points (N, 3) as the sensor gave them, and their times (N,) in s after the stamp.

    time_s is None where the points carry no times or all are the stamp's.
    """

    points: Array
    time_s: Array | None


class ShapedScan(NamedTuple):
    """Points (N, 3) without the motion within the scan, and their normals (N, 3)."""

    points: Array
    normals: Array


class ScanStore:
    """Scans in a folder; the last used stay in memory.

    ``raw`` scans are written once.  A ``shaped`` scan has a version for each sweep that visited
    it; the last two are kept, so that an interrupted sweep can go on with the same bits.
    """

    def __init__(self, folder: Path, n_cached: int) -> None:
        """folder: where the files are."""
        self.folder = folder
        self._n_cached = n_cached
        self._cache: OrderedDict[tuple[int, int], _Single] = OrderedDict()

    def add_raw(self, k: int, scan: RawScan) -> None:
        """Write scan k."""
        time_s = np.zeros(0) if scan.time_s is None else scan.time_s
        points = scan.points.astype(np.float32)
        np.savez(self.folder / f"{k}.raw.npz", points=points, time_s=time_s)

    def raw(self, k: int) -> RawScan:
        """Read scan k."""
        with np.load(self.folder / f"{k}.raw.npz") as file:
            time_s = file["time_s"]
            return RawScan(file["points"].astype(np.float64), time_s if len(time_s) else None)

    def add_shaped(self, k: int, version: int, scan: ShapedScan) -> None:
        """Write a version of scan k and forget the one before the last."""
        points, normals = (rows.astype(np.float32) for rows in scan)
        np.savez(self.folder / f"{k}.{version}.npz", points=points, normals=normals)
        self._remember((k, version), (points, normals))
        self._cache.pop((k, version - 1), None)
        (self.folder / f"{k}.{version - 2}.npz").unlink(missing_ok=True)

    def shaped(self, k: int, version: int) -> ShapedScan:
        """Return a version of scan k in double precision."""
        scan = self._cache.get((k, version))
        if scan is None:
            with np.load(self.folder / f"{k}.{version}.npz") as file:
                scan = file["points"], file["normals"]
        self._remember((k, version), scan)
        points, normals = (rows.astype(np.float64) for rows in scan)
        return ShapedScan(points, normals)

    def clear(self) -> None:
        """Remove all scans."""
        self._cache.clear()
        for pattern in ("*.raw.npz", "[0-9]*.[0-9]*.npz"):
            for path in self.folder.glob(pattern):
                path.unlink()

    def _remember(self, key: tuple[int, int], scan: _Single) -> None:
        self._cache[key] = scan
        self._cache.move_to_end(key)
        while len(self._cache) > self._n_cached:
            self._cache.popitem(last=False)


def filtered_scan(scan: Scan, config: CloudConfig, rng: np.random.Generator) -> RawScan:
    """Return the points of a scan that the filters keep, at most 20 000 of them.

    Raises CloudError when fewer than ``n_neighbors`` are left.
    """
    if scan.time_s is not None:
        scan = scan.only(np.isfinite(scan.time_s))
    points = crop_range(scan.points, config.min_range_m, config.max_range_m)
    time_s = scan.time_s
    if time_s is not None and len(time_s) and np.ptp(time_s) > 0.0:
        range2 = np.einsum("ij,ij->i", scan.points, scan.points)
        time_s = time_s[(range2 >= config.min_range_m**2) & (range2 <= config.max_range_m**2)]
        rows = np.column_stack([points, time_s])
    else:
        rows = points
    kept = limit_density(rows, config.voxel_m, config.max_points_per_voxel, rng)
    if len(kept) < config.n_neighbors:
        raise CloudError(
            f"{len(kept)} of {len(scan.points)} points are left after the filters, need at least "
            f"{config.n_neighbors}"
        )
    kept = kept[subsample(len(kept), _MAX_POINTS, rng)]
    return RawScan(kept[:, :3].copy(), kept[:, 3].copy() if kept.shape[1] == 4 else None)


def without_motion(scan: RawScan, velocity: Array) -> Array:
    """Return the points (N, 3) as the sensor would have seen them at the stamp.

    velocity: (6,), of the sensor in its own frame, m/s and rad/s: ``p' = exp(time v) p``.
    """
    if scan.time_s is None or not velocity.any():
        return scan.points
    return undistorted(scan.points, scan.time_s, Motion.constant(velocity))
