"""Time ICP on one case: one registration, a whole reference, redrawn clouds; beside others.

A case is a folder of ref_points.npy, ref_normals.npy, reading_points.npy and T0.npy (n, 4, 4);
T_libpointmatcher.npy and iterations_libpointmatcher.npy are compared with when they are there.
Times are process times of one thread, kernels compiled.  Without a case, two walls and a floor.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sampling import in_order
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from cello3d_ros.clouds.leaves import select, tree_order
from cello3d_ros.clouds.neighbors import build_tree, search
from cello3d_ros.config import IcpConfig
from cello3d_ros.geometry.se3 import exp, transform
from cello3d_ros.registration import kernels
from cello3d_ros.registration.backends import register_many
from cello3d_ros.registration.icp import icp

_CONFIG = IcpConfig()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--registrations", type=int, default=200)
    arguments = parser.parse_args()
    case = load(arguments.case) if arguments.case else simulate()
    with threadpool_limits(1):
        result = measure(case, arguments.registrations)
    print(json.dumps(result, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


def load(folder: Path) -> dict[str, Any]:
    return {path.stem: np.load(path) for path in folder.glob("*.npy")}


def simulate() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    wall = np.eye(3)[rng.integers(0, 3, 22000)]
    points = rng.uniform(0, 8, (22000, 3)) * (1 - wall) + rng.normal(scale=0.01, size=wall.shape)
    starts = exp(rng.normal(scale=0.05**0.5, size=(200, 6)))
    return {
        "ref_points": points[:20000],
        "ref_normals": wall[:20000],
        "reading_points": points[20000:],
        "T0": starts,
    }


def measure(case: dict[str, Any], n: int) -> dict[str, Any]:
    read, ref, normals = case["reading_points"], case["ref_points"], case["ref_normals"]
    starts = np.resize(case["T0"], (n, 4, 4))
    clouds = in_order(read, np.zeros_like(read)), in_order(ref, normals)  # as prepared ones are
    whole = IcpConfig(n_reading_points=0, n_reference_points=0)
    seeds = [[i] for i in range(n)]

    def single() -> list[Any]:
        return [icp(read, ref, normals, T, _CONFIG) for T in starts]

    for config in (whole, _CONFIG):  # kernels compiled, or read from numba's cache
        register_many(*clouds, starts[:60], seeds[:60], config)
    icp(read, ref, normals, starts[0], _CONFIG)
    seconds, found = timed(single)
    result: dict[str, Any] = {
        "registrations_per_cpu_second": n / seconds,
        "whole_registrations_per_cpu_second": n
        / timed(lambda: register_many(*clouds, starts, seeds, whole))[0],
        "redrawn_registrations_per_cpu_second": n
        / timed(lambda: register_many(*clouds, starts, seeds, _CONFIG))[0],
        "redrawn_sizes": [
            min(len(read), _CONFIG.n_reading_points),
            min(len(ref), _CONFIG.n_reference_points),
        ],
    }
    if "T_libpointmatcher" in case and "iterations_libpointmatcher" in case:
        errors = [np.abs(a.T_ref_read - T).max() for a, T in zip(found, case["T_libpointmatcher"])]
        same = [a.n_iterations == k for a, k in zip(found, case["iterations_libpointmatcher"])]
        result["fraction_within_1e-6"] = float(np.mean(np.array(errors) < 1e-6))
        result["same_iterations"] = float(np.mean(same))
    few = starts[: max(n // 10, 1)]
    seconds, plain = timed(lambda: [numpy_icp(read, ref, normals, T) for T in few])
    result["numpy_registrations_per_cpu_second"] = len(few) / seconds
    result["numpy_largest_difference"] = float(
        max(np.abs(a.T_ref_read - T).max() for a, T in zip(found, plain))
    )
    for name, run in (("open3d", open3d_icp), ("small_gicp", small_gicp_icp)):
        try:
            register = run(read, ref, normals)
        except ImportError:
            continue
        seconds, _ = timed(lambda register=register: [register(T) for T in few])
        result[f"{name}_registrations_per_cpu_second"] = len(few) / seconds
    result["ns_per_point_per_iteration"] = profile(read, ref, normals, found[0].T_ref_read)
    return result


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    start = time.process_time()
    answer = work()
    return time.process_time() - start, answer


def profile(read: Any, ref: Any, normals: Any, T: Any, n_runs: int = 50) -> dict[str, float]:
    """Time the three parts of an iteration where ICP ends, the neighbours known."""
    queries = np.ascontiguousarray(transform(T, read[tree_order(read)]))
    tree = build_tree(ref)
    normals = normals[tree.order]
    moved = queries - ref.mean(axis=0)
    d2, indices = np.empty((len(read), _CONFIG.n_neighbors)), np.empty((len(read), 3), np.int64)
    search(tree.leaves, queries, np.inf, d2, indices)
    rank = int(d2.size * _CONFIG.trim_ratio)
    limit = np.partition(d2, rank, axis=None)[rank]
    keys = np.arange(d2.size)
    parts = {
        "search": lambda: search(tree.leaves, queries, 1.2 * limit, d2, indices),
        "trim": lambda: select(d2.flatten(), keys, 0, d2.size, rank),
        "accumulate": lambda: kernels.plane_step(
            moved, queries, tree.points, normals, d2, indices, limit
        ),
    }
    nanoseconds = {}
    for name, part in parts.items():
        part()
        seconds, _ = timed(lambda part=part: [part() for _ in range(n_runs)])
        nanoseconds[name] = seconds / n_runs / len(read) * 1e9
    return nanoseconds


def numpy_icp(read: Any, ref: Any, normals: Any, T_init: Any) -> Any:
    """Follow the rules of registration/icp.py with numpy and scipy's tree."""
    k, mean, config = _CONFIG.n_neighbors, ref.mean(axis=0), _CONFIG
    tree = cKDTree(ref - mean)
    T_start = T_init.copy()
    T_start[:3, 3] -= mean
    start, T, steps = transform(T_start, read), np.eye(4), []
    for _ in range(config.max_iterations):
        moved = transform(T, start)
        distances, indices = tree.query(moved, k=k)
        d2 = distances.ravel() ** 2
        rank = min(int(d2.size * config.trim_ratio), d2.size - 1)
        kept = d2 <= np.partition(d2, rank)[rank]
        p, q = np.repeat(moved, k, axis=0)[kept], indices.ravel()[kept]
        n = normals[q]
        J = np.hstack([np.cross(p, n), n])
        r = np.einsum("ij,ij->i", p - tree.data[q], n)
        x = -np.linalg.solve(J.T @ J, J.T @ r)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        moved_by = step @ T
        steps.append((np.linalg.norm(x[:3]), np.linalg.norm(moved_by[:3, 3] - T[:3, 3])))
        T = moved_by
        last = np.mean(steps[-config.n_smoothed :], axis=0)
        limits = (config.rotation_epsilon_rad, config.translation_epsilon_m)
        if len(steps) >= config.n_smoothed and (last < limits).all():
            break
    T = T @ T_start
    T[:3, 3] += mean
    return T


def open3d_icp(read: Any, ref: Any, normals: Any) -> Callable[[Any], Any]:
    """Point to plane, nearest neighbour within 1 m, not trimmed."""
    import open3d

    reg = open3d.pipelines.registration
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p)) for p in (read, ref)]
    clouds[1].normals = open3d.utility.Vector3dVector(normals)
    plane = reg.TransformationEstimationPointToPlane()
    until = reg.ICPConvergenceCriteria(max_iteration=_CONFIG.max_iterations)
    return lambda T: reg.registration_icp(*clouds, 1.0, T, plane, until)


def small_gicp_icp(read: Any, ref: Any, normals: Any) -> Callable[[Any], Any]:
    """PLANE_ICP, nearest neighbour within 1 m, not trimmed; its normals are its own."""
    import small_gicp

    target, source = small_gicp.PointCloud(ref), small_gicp.PointCloud(read)
    small_gicp.estimate_normals(target, num_threads=1)

    def register(T: Any) -> Any:
        return small_gicp.align(
            target,
            source,
            small_gicp.KdTree(target, num_threads=1),
            T,
            registration_type="PLANE_ICP",
            max_correspondence_distance=1.0,
            num_threads=1,
            max_iterations=_CONFIG.max_iterations,
        )

    return register


if __name__ == "__main__":
    main()
