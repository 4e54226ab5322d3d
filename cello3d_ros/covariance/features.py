"""Global features: a few numbers about a registered pair that need no history of ICP.

They follow from the associations at the registered pose, whoever registered, and do not change
when both clouds are turned about the sensor.
"""

from __future__ import annotations

import numpy as np

from cello3d_ros.clouds.filters import n_drawn
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import IcpConfig
from cello3d_ros.covariance.closed_form import ClosedForm
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.overlap import Overlap

#: What ``global_features`` returns, in its order; logarithms are natural.
FEATURES = (
    "overlap_ratio",
    "log_sandwich_m",
    "log_sandwich_rad",
    "log_trim_m",
    "log_residual_m",
    "log_condition",
    "log_least_sandwich_against_hessian",
    "log_mean_sandwich_against_hessian",
    "log_largest_sandwich_against_hessian",
    "log_associations",
    "log_reading_points_per_draw",
    "log_reference_points_per_draw",
    "log_motion_m",
)
KINDS = ("descriptor", "global", "both")  # what a model may look at
_LEAST = 1e-6  # m, rad or a ratio: stands for the nothing that exact copies leave
_MOTION_M = 0.1  # added to the distance of the two sensors, so that its logarithm is bounded


def global_features(
    reading: Cloud,
    reference: Cloud,
    T_ref_read: Array,
    overlap: Overlap,
    found: ClosedForm,
    config: IcpConfig,
) -> Array:
    """Return the numbers that ``FEATURES`` names.  found: of the overlap's associations.

    The share of the reading that overlaps; the standard deviation of the sandwich in translation
    and in rotation; the distance up to which ICP keeps associations, their root mean square
    point-to-plane residual, their number; the condition of H in units in which the mean variances
    of translation and of rotation are 1; the least, geometric mean and largest eigenvalue of the
    sandwich against ``rms^2 H^-1``, which independent residuals would make; how many points stand
    behind each that ICP draws, in either cloud; the distance of the two sensors.
    """
    S, H_inverse = found.sandwich, found.inverse_H
    limit, rms = max(found.trim_m, _LEAST), max(found.residual_rms_m, _LEAST)
    spread = np.sqrt(np.maximum([np.trace(S[:3, :3]), np.trace(S[3:, 3:])], _LEAST**2))
    traces = np.trace(H_inverse[:3, :3]), np.trace(H_inverse[3:, 3:])
    unit = np.repeat(np.sqrt(3.0 / np.array(traces)), 3)
    variances, vectors = np.linalg.eigh(H_inverse * np.outer(unit, unit))
    root = unit[:, None] * vectors / np.sqrt(variances)  # root^T H^-1 root = I
    ratios = np.maximum(np.linalg.eigvalsh(root.T @ S @ root) / rms**2, _LEAST)
    against = ratios[0], np.exp(np.log(ratios).mean()), ratios[-1]
    drawn = (
        len(reading.points) / n_drawn(len(reading.points), config.n_reading_points),
        len(reference.points) / n_drawn(len(reference.points), config.n_reference_points),
    )
    motion = np.linalg.norm(T_ref_read[:3, 3]) + _MOTION_M
    condition, n = variances[-1] / variances[0], found.n_associations
    logs = np.log([*spread, limit, rms, condition, *against, n, *drawn, motion])
    return np.concatenate([[overlap.ratio], logs])


def model_inputs(kind: str, descriptors: Array, features: Array) -> Array:
    """Return what a model looks at of a pair, or of many.

    kind: one of ``KINDS``; descriptors: (..., R, D), the first as recorded, the others turned
    about z; features: (..., G).  Returns (..., R, D) for "descriptor", (..., 1, G) or
    (..., 1, G + D) otherwise: global features do not tell the turns of a pair apart.
    """
    if kind == "descriptor":
        return descriptors
    row = np.asarray(features)[..., None, :]
    return row if kind == "global" else np.concatenate([row, descriptors[..., :1, :]], axis=-1)
