"""The online composition: two clouds and a first guess in, a pose and its covariance out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.closed_form import closed_form
from cello3d_ros.covariance.descriptor import describe_overlap
from cello3d_ros.covariance.model import Model, predict
from cello3d_ros.errors import ModelError, NoOverlapError, RegistrationError
from cello3d_ros.geometry.se3 import Array, inverse, transform
from cello3d_ros.registration.backends import register
from cello3d_ros.registration.icp import Registration
from cello3d_ros.registration.overlap import find_overlap


class Description(NamedTuple):
    """What a model is told of a registered pair.

    n_overlap: overlapping points of both clouds; overlap_ratio: share of the reading's points;
    descriptors: (n_rotations, n_features), the k-th after a turn of the reading frame by
    2 pi k / n_rotations about z; shapes: cheap predictors by name, each (6, 6), reading side.
    """

    n_overlap: int
    overlap_ratio: float
    descriptors: Array
    shapes: dict[str, Array]


class Estimate(NamedTuple):
    """A registration and what the model says of it.

    covariance: (6, 6), reading side, ordered (u, omega); nearest_rho: squared distance of the
    nearest training example; effective_neighbors: how many examples share in the answer.
    """

    registration: Registration
    overlap_ratio: float
    covariance: Array
    nearest_rho: float
    effective_neighbors: float


def describe(
    reading: Cloud, reference: Cloud, T_ref_read: Array, pipeline: Pipeline, n_rotations: int = 1
) -> Description:
    """Describe a registered pair.

    T_ref_read: (4, 4).  Raises NoOverlapError when too little overlaps and RegistrationError
    when the geometry leaves a direction free.
    """
    overlap = find_overlap(
        reading, reference, T_ref_read, pipeline.overlap.radius_m, pipeline.icp.n_neighbors
    )
    if overlap.n_points < pipeline.overlap.min_points:
        raise NoOverlapError(
            f"{overlap.n_points} overlapping points, need {pipeline.overlap.min_points}"
        )
    if overlap.ratio < pipeline.overlap.min_ratio:
        raise NoOverlapError(
            f"{overlap.ratio:.1%} of the reading overlaps the reference, need "
            f"{pipeline.overlap.min_ratio:.1%}"
        )
    P, Q = overlap.reading, overlap.reference
    T_read_ref = inverse(T_ref_read)
    points = np.vstack([reading.points[P], transform(T_read_ref, reference.points[Q])])
    normals = np.vstack([reading.normals[P], reference.normals[Q] @ T_read_ref[:3, :3].T])
    planarity = np.concatenate([reading.planarity[P], reference.planarity[Q]])
    cylindricality = np.concatenate([reading.cylindricality[P], reference.cylindricality[Q]])
    descriptors = [
        describe_overlap(points @ Rz.T, normals @ Rz.T, planarity, cylindricality, pipeline.grid)
        for Rz in turns(n_rotations)
    ]
    shapes = closed_form(
        reading, reference, T_ref_read, overlap.distances2, overlap.indices, pipeline.icp
    )._asdict()
    return Description(overlap.n_points, overlap.ratio, np.array(descriptors), shapes)


def turns(n_rotations: int) -> Array:
    """Return the rotations about z by 2 pi k / n_rotations.  (n_rotations, 3, 3)."""
    angles = 2.0 * np.pi * np.arange(n_rotations) / n_rotations
    R = np.zeros((n_rotations, 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(angles)
    R[:, 1, 0] = np.sin(angles)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R


def estimate(
    reading: Cloud,
    reference: Cloud,
    T_init: Array,
    model: Model,
    pipeline: Pipeline,
    rng: np.random.Generator,
) -> Estimate:
    """Register two clouds and predict the covariance of the result.

    T_init: (4, 4), the first guess of T_ref_read.  A registration that reached its last iteration
    is returned with ``converged`` False: its covariance says little.  Raises RegistrationError
    when ICP has no answer, NoOverlapError when the clouds share too little and ModelError when
    the grid is not the model's.
    """
    if pipeline.grid != model.pipeline.grid:
        raise ModelError(f"the model was trained with {model.pipeline.grid}, not {pipeline.grid}")
    registration = register(reading, reference, T_init, pipeline.icp, rng)
    if registration.reason not in ("", "max_iterations"):
        raise RegistrationError(f"ICP has no answer: {registration.reason.replace('_', ' ')}")
    description = describe(reading, reference, registration.T_ref_read, pipeline)
    S = description.shapes.get(model.shape)
    prediction = predict(model, description.descriptors[0], S)
    return Estimate(registration, description.overlap_ratio, *prediction)
