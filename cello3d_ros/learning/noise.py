"""Monte Carlo with sensor noise or from other places: registrations see other ranges.

Source: the sampled covariances of Bengtsson & Baerveldt 2003 and Iversen et al. 2017.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import subsample
from cello3d_ros.clouds.neighbors import build_tree
from cello3d_ros.clouds.shape import Cloud, prepare
from cello3d_ros.config import IcpConfig, Pipeline
from cello3d_ros.errors import CloudError
from cello3d_ros.geometry.se3 import Array, exp, inverse
from cello3d_ros.registration.backends import register
from cello3d_ros.registration.icp import Registration
from cello3d_ros.simulation.scanner import Echoes, measure

Look = Callable[[Array], Echoes]  # what a scan's beams meet from a pose T_world_sensor
_VIEW_M, _VIEW_RAD = 0.1, 0.035  # standard deviations of another view, along each axis


def register_noisy(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    config: IcpConfig,
    sigma_m: float,
    rng: np.random.Generator,
) -> Registration:
    """Register with subsamples and range noise drawn anew.

    The subsamples are those that the same generator draws without noise; sigma_m is the standard
    deviation of the noise.
    """
    read = subsample(len(reading.points), config.n_reading_points, rng)
    ref = subsample(len(reference.points), config.n_reference_points, rng)
    P, Q = noisy(reading, read, sigma_m, rng), noisy(reference, ref, sigma_m, rng)
    return register(P, Q, T_init, config, rng)


def register_rescanned(
    reading: Echoes,
    reference: Echoes,
    T_init: Array,
    pipeline: Pipeline,
    sigma_m: float,
    rng: np.random.Generator,
) -> Registration:
    """Register with both clouds scanned and prepared anew.

    Ranges, missing returns, filters, normals and subsamples are those of this registration alone.
    A scan that leaves no cloud gives the start, with the reason "too_few_points".
    """
    try:
        P, Q = (
            prepare(measure(echoes, rng, sigma_m), pipeline.cloud, rng)
            for echoes in (reading, reference)
        )
    except CloudError:
        return Registration(T_init, 0, False, "too_few_points", np.inf, 0)
    return register(P, Q, T_init, pipeline.icp, rng)


def seen_from(
    pair: tuple[Look, Look],
    T_world: tuple[Array, Array],
    pipeline: Pipeline,
    rng: np.random.Generator,
) -> tuple[Cloud, Cloud]:
    """Scan a pair from another place nearby, with the same motion between its scans.

    pair, T_world: how to scan and the poses (4, 4), of the reading and of the reference.  Both are
    carried along by ``T_reading exp(e)``, e ~ N(0, diag(0.1^2 I m^2, 0.035^2 I rad^2)): the beams
    fall elsewhere on the same surfaces, so that the bias of ICP is another draw while T_ref_read
    stays.  Noise and filters are of this view, and so is the scanner: another individual of its
    kind, with other errors of its beams.  Raises CloudError.
    """
    T_read, T_ref = T_world
    moved = T_read @ exp(rng.normal(size=6) * np.repeat([_VIEW_M, _VIEW_RAD], 3))
    poses = moved, moved @ inverse(T_read) @ T_ref
    serial = int(rng.integers(2**31))

    def scanned(look: Look, T: Array) -> Cloud:
        echoes = look(T)
        scanner = replace(echoes.scanner, serial=serial)
        return prepare(measure(echoes._replace(scanner=scanner), rng), pipeline.cloud, rng)

    P, Q = (scanned(look, T) for look, T in zip(pair, poses, strict=True))
    return P, Q


def noisy(
    cloud: Cloud, kept: NDArray[np.int64], sigma_m: float, rng: np.random.Generator
) -> Cloud:
    """Return some points of a cloud, each moved along its ray by N(0, sigma_m^2).

    The points keep the normals and features of the recorded cloud.  Those hold one draw of the
    sensor's noise already, averaged over their neighbourhood; computing them anew from the noisy
    cloud would add the same noise twice and cost more than the registration.
    """
    points = cloud.points[kept]
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    rays = points / np.maximum(ranges, np.finfo(np.float64).tiny)
    tree = build_tree(points + sigma_m * rng.normal(size=ranges.shape) * rays)
    order = kept[tree.order]
    return cloud._replace(
        points=tree.points,
        normals=cloud.normals[order],
        planarity=cloud.planarity[order],
        cylindricality=cloud.cylindricality[order],
        tree=tree._replace(order=np.arange(len(kept))),
    )
