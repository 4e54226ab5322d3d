"""What is known of a registered pair: found once, from the clouds and the pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.closed_form import closed_form
from cello3d_ros.covariance.descriptor import describe_clouds, n_features
from cello3d_ros.covariance.features import global_features
from cello3d_ros.covariance.heading import motion_of
from cello3d_ros.errors import NoOverlapError
from cello3d_ros.geometry.se3 import Array, inverse
from cello3d_ros.registration.overlap import Overlap, find_overlap

_N_LOOKED_AT = 10_000  # points of the reading that tell all but a descriptor


class Description(NamedTuple):
    """A registered pair as methods and models see it, whoever registered it.

    overlap_ratio: share of the reading's points; descriptors: (n_rotations, n_features), the k-th
    after a turn of the reading frame by 2 pi k / n_rotations about z; features: the numbers that
    ``FEATURES`` names; shapes: cheap predictors by name, each (6, 6), reading side; overlap: the
    associations that all of it comes from; motion: (2,), what ``motion_of`` finds; free: the
    directions of the sensor that no plane holds (``ClosedForm``).
    """

    overlap_ratio: float
    descriptors: Array
    features: Array
    shapes: dict[str, Array]
    overlap: Overlap
    motion: Array
    free: tuple[str, ...] = ()


def describe(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    pipeline: Pipeline,
    n_rotations: int = 1,
    n_threads: int = 1,
) -> Description:
    """Describe a registered pair.

    T_ref_read: (4, 4); n_rotations: 0 where nobody looks at descriptors, which then are not made:
    all else are means and shares, which 10 000 points of the reading tell as well.  n_threads
    changes no result.  Raises NoOverlapError when too little overlaps and
    FreeDirectionError when the normal equations are singular.
    """
    radius_m, k = pipeline.overlap.radius_m, pipeline.icp.n_neighbors
    n_looked_at = 0 if n_rotations else _N_LOOKED_AT
    overlap = find_overlap(reading, reference, T_ref_read, radius_m, k, n_threads, n_looked_at)
    _check_overlap(overlap, pipeline)
    found = closed_form(reading, reference, T_ref_read, overlap, pipeline.icp)
    shapes = {"hessian": found.inverse_H, "sandwich": found.sandwich}
    descriptors = _descriptors(reading, reference, T_ref_read, overlap, pipeline, n_rotations)
    features = global_features(reading, reference, T_ref_read, overlap, found, pipeline.icp)
    return Description(
        overlap.ratio,
        descriptors,
        features,
        shapes,
        overlap,
        motion_of(T_ref_read),
        found.free,
    )


def turns(n_rotations: int) -> Array:
    """Return the rotations about z by 2 pi k / n_rotations.  (n_rotations, 3, 3)."""
    angles = 2.0 * np.pi * np.arange(n_rotations) / max(n_rotations, 1)
    R = np.zeros((n_rotations, 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(angles)
    R[:, 1, 0] = np.sin(angles)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R


def _check_overlap(overlap: Overlap, pipeline: Pipeline) -> None:
    if overlap.n_points < pipeline.overlap.min_points:
        raise NoOverlapError(
            f"{overlap.n_points} overlapping points, need {pipeline.overlap.min_points}"
        )
    if overlap.ratio < pipeline.overlap.min_ratio:
        raise NoOverlapError(
            f"{overlap.ratio:.1%} of the reading overlaps the reference, need "
            f"{pipeline.overlap.min_ratio:.1%}"
        )


def _descriptors(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    overlap: Overlap,
    pipeline: Pipeline,
    n_rotations: int,
) -> Array:
    """Return the descriptor of the overlap after each turn.  (n_rotations, n_features)."""
    clouds, overlaps = (reading, reference), (overlap.reading, overlap.reference)
    T_read_ref = inverse(T_ref_read)
    turned = np.tile(np.eye(4), (n_rotations, 1, 1))
    turned[:, :3, :3] = turns(n_rotations)
    found = [describe_clouds(clouds, overlaps, (T, T @ T_read_ref), pipeline.grid) for T in turned]
    return np.array(found).reshape(n_rotations, n_features(pipeline.grid))
