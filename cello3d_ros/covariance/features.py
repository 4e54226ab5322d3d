"""Global features: a few numbers about a registered pair that need no history of ICP.

They follow from the associations at the registered pose, whoever registered, and do not change
when both clouds are turned about the sensor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.clouds.filters import n_drawn
from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.compiled import kernel
from cello3d_ros.config import IcpConfig
from cello3d_ros.covariance.closed_form import HELD, ClosedForm
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
    "log_displacement_m",
    "log_range_m",
    "log_normal_variance",
    "log_held",
)
KINDS = ("descriptor", "global", "both")  # what a model may look at
_LEAST = 1e-6  # m, rad or a ratio: stands for the nothing that exact copies leave
_AT_REST_M = 5e-4  # added to the displacement, so that its logarithm is bounded


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
    behind each that ICP draws, in either cloud; how far the sensor sees the reading's points move,
    and how far they are, root mean square; the mean variance of a normal; how well the least held
    direction is held.
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
    displacement, far = _displacement_and_range(reading.points, T_ref_read)
    lengths = displacement + _AT_REST_M, far
    condition, n = variances[-1] / variances[0], found.n_associations
    evidence = max(found.normal_variance, _LEAST), max(found.held, _LEAST)
    logs = np.log([*spread, limit, rms, condition, *against, n, *drawn, *lengths, *evidence])
    return np.concatenate([[overlap.ratio], logs])


@kernel()
def _displacement_and_range(points: Array, T: Array) -> tuple[float, float]:
    """Return the root mean squares of ``|T p - p|`` and of ``|p|`` over points p, (N, 3)."""
    moved2 = far2 = 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        far2 += x * x + y * y + z * z
        for a in range(3):
            d = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3] - points[i, a]
            moved2 += d * d
    return np.sqrt(moved2 / len(points)), np.sqrt(far2 / len(points))


def is_free(features: Array) -> NDArray[np.bool_]:
    """Return whether no plane holds some direction of a pair, which then has no answer.

    features: (..., G), or (..., 0) where they are not known: nothing is free then.  Returns (...).
    """
    if features.shape[-1] == 0:
        return np.zeros(features.shape[:-1], np.bool_)
    return np.asarray(features[..., FEATURES.index("log_held")] < np.log(HELD))


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
