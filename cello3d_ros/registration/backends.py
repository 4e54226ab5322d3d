"""Registrations by this package's ICP or by other libraries, behind one protocol.

Each backend draws the same subsamples from the same generator, so that what is sampled, learned
and served is a registration of subsamples whatever registers them.  ``icp`` and ``small_gicp``
give the same bits again for the same arguments.  Open3D adds up in the order in which its threads
end: its results repeat to rounding only.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.errors import ConfigError, how_to_install
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.registration import icp
from cello3d_ros.registration.icp import Registration
from cello3d_ros.threads import in_threads

_FEWEST_ASSOCIATIONS = 6  # as many as a rigid motion has degrees of freedom
_SMALL_GICP_NEIGHBORS = 20  # of the covariance of a point of the subsample


class Backend(Protocol):
    """One registration of random subsamples of two clouds.

    T_init: (4, 4), the first guess of T_ref_read; n_threads: at most as many, which changes no
    bit (other libraries use one).  Never raises on geometry: a registration without an answer
    keeps T_init and says why.  ``n_iterations`` is 0 where a library does not tell it.  Raises
    ConfigError where the library is not installed.
    """

    def __call__(
        self,
        reading: Cloud,
        reference: Cloud,
        T_init: Array,
        config: IcpConfig,
        rng: np.random.Generator,
        n_threads: int = 1,
    ) -> Registration: ...


def register(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    config: IcpConfig,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Registration:
    """Register by the backend of the settings; arguments as in ``Backend``."""
    return BACKENDS[config.backend](reading, reference, T_init, config, rng, n_threads)


def check_installed(config: IcpConfig) -> None:
    """Raise ConfigError, which says how to get it, where the backend's library is missing."""
    if config.backend == "small_gicp":
        _imported("small_gicp", "small_gicp", "small_gicp", config)
    elif config.backend != "icp":
        _imported("open3d", "Open3D", "open3d", config)


def register_many(
    reading: Cloud,
    reference: Cloud,
    T_inits: Array,
    seeds: Sequence[Sequence[int]],
    config: IcpConfig,
    n_threads: int = 1,
) -> list[Registration]:
    """Register from many starts, each with subsamples of its own.

    T_inits: (n, 4, 4); seeds: n seeds of numpy's default generator.  Each result depends on its
    own start and seed only, hence not on the number of threads.
    """

    def one(k: int) -> Registration:
        return register(reading, reference, T_inits[k], config, np.random.default_rng(seeds[k]))

    return in_threads(one, range(len(T_inits)), n_threads)


def _open3d(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    config: IcpConfig,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Registration:
    """Register by Open3D's point-to-plane ICP or generalized ICP, with the clouds' own normals.

    Open3D does not tell whether it converged: one more step from its answer says it, by the
    step's rotation and translation against the limits of the settings.
    """
    o3d = _imported("open3d", "Open3D", "open3d", config)
    o3c = o3d.pipelines.registration
    if config.backend == "open3d_gicp":
        function = o3c.registration_generalized_icp
        kind = o3c.TransformationEstimationForGeneralizedICP
    else:
        function, kind = o3c.registration_icp, o3c.TransformationEstimationPointToPlane
    clouds = [
        _open3d_cloud(o3d, cloud.points[kept], cloud.normals[kept])
        for cloud, kept in zip((reading, reference), _subsamples(reading, reference, config, rng))
    ]

    def run(T: Array, n: int) -> Any:
        criteria = o3c.ICPConvergenceCriteria(max_iteration=n)
        return function(*clouds, config.max_distance_m, T, kind(), criteria)

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            found = run(T_init, config.max_iterations)
            T_found = np.array(found.transformation)
            T_next = np.array(run(T_found, 1).transformation)
        except RuntimeError:  # Open3D's error for a system that it cannot solve
            return _failed(T_init, "singular")
    converged = _is_small(inverse(T_found) @ T_next, config)
    n_associations = len(found.correspondence_set)
    return _checked(T_init, T_found, 0, converged, found.inlier_rmse, n_associations)


def _is_small(step: Array, config: IcpConfig) -> bool:
    """Return whether a step is below the limits of the settings.  step: (4, 4)."""
    angle = math.acos(min(1.0, max(-1.0, (np.trace(step[:3, :3]) - 1.0) / 2.0)))
    shift = float(np.linalg.norm(step[:3, 3]))
    return angle < config.rotation_epsilon_rad and shift < config.translation_epsilon_m


def _small_gicp(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    config: IcpConfig,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Registration:
    """Register by small_gicp's generalized ICP, each point's covariance from the subsample."""
    small_gicp = _imported("small_gicp", "small_gicp", "small_gicp", config)
    read, ref = _subsamples(reading, reference, config, rng)
    source = small_gicp.PointCloud(reading.points[read])
    target = small_gicp.PointCloud(reference.points[ref])
    trees = [small_gicp.KdTree(cloud) for cloud in (source, target)]
    for cloud, tree in zip((source, target), trees):
        small_gicp.estimate_covariances(cloud, tree, _SMALL_GICP_NEIGHBORS)
    found = small_gicp.align(
        target,
        source,
        trees[1],
        T_init,
        "GICP",
        config.max_distance_m,
        1,
        config.max_iterations,
        config.rotation_epsilon_rad,
        config.translation_epsilon_m,
    )
    T_found = np.array(found.T_target_source)
    moved = reading.points[read] @ T_found[:3, :3].T + T_found[:3, 3]
    _, distances2 = trees[1].batch_nearest_neighbor_search(moved)
    near = np.asarray(distances2)[np.asarray(distances2) <= config.max_distance_m**2]
    rms = math.sqrt(near.mean()) if near.size else math.nan
    n_iterations = found.iterations + 1  # it reports the number of its last one, from 0
    return _checked(T_init, T_found, n_iterations, found.converged, rms, found.num_inliers)


def _subsamples(
    reading: Cloud, reference: Cloud, config: IcpConfig, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of both subsamples, drawn as ``icp.register`` draws them."""
    read = subsample(len(reading.points), config.n_reading_points, rng)
    return read, subsample(len(reference.points), config.n_reference_points, rng)


def _open3d_cloud(o3d: Any, points: Array, normals: Array) -> Any:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


def _checked(
    T_init: Array, T_found: Array, n_iterations: int, converged: bool, rms: float, n: int
) -> Registration:
    """Return the answer of a library, or why it is none."""
    if n < _FEWEST_ASSOCIATIONS:
        return _failed(T_init, "too_few_points")
    if not np.isfinite(T_found).all():
        return _failed(T_init, "singular")
    reason = "" if converged else "max_iterations"
    return Registration(T_found, n_iterations, bool(converged), reason, float(rms), int(n))


def _failed(T_init: Array, reason: str) -> Registration:
    return Registration(T_init.copy(), 0, False, reason, math.nan, 0)


def _imported(module: str, title: str, extra: str, config: IcpConfig) -> Any:
    """Import a library late; raises ConfigError that says how to get it."""
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"icp.backend {config.backend} needs {title}: {how_to_install(extra, error)}"
        ) from None


BACKENDS: Mapping[str, Backend] = MappingProxyType(
    {
        "icp": icp.register,
        "open3d_point_to_plane": _open3d,
        "open3d_gicp": _open3d,
        "small_gicp": _small_gicp,
    }
)
