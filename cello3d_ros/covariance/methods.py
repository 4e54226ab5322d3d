"""Every way to the covariance of a registration behind one interface, by name.

A method takes a ``Case`` and returns a (6, 6) positive definite covariance of its registration,
reading side, ordered (u, omega).  RegistrationError or ModelError: a method has no answer.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cello3d_ros.covariance.case import Case, MethodSettings
from cello3d_ros.covariance.closed_form import censi
from cello3d_ros.covariance.features import model_inputs
from cello3d_ros.covariance.fused import fused, monte_carlo, registrations
from cello3d_ros.covariance.model import Model, Prediction, placed, predict
from cello3d_ros.covariance.sigma_points import sigma_points
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite, larger, symmetrized
from cello3d_ros.geometry.se3 import Array

Method = Callable[[Case], Array]


def by_model(case: Case) -> Array:
    """Return the model's prediction, widened where the settings say so."""
    return widened(predicted(case), case)


def by_constant(case: Case) -> Array:
    """Return the mean of the model's examples, relative to the pair's shape as they are."""
    return placed(case.model, mean_example(case.model), *_place(case))


def by_hessian(case: Case) -> Array:
    """Return ``sigma^2 H^-1``."""
    return case.settings.sigma_m**2 * case.description.shapes["hessian"]


def by_sandwich(case: Case) -> Array:
    """Return ``H^-1 (sum g g^T) H^-1``."""
    return case.description.shapes["sandwich"]


def by_censi(case: Case) -> Array:
    """Return ``censi`` of ``closed_form``."""
    return censi(
        *(case.reading, case.reference, case.T_hat, case.description.overlap),
        case.pipeline.icp,
        case.settings.sigma_m,
    )


def by_monte_carlo(case: Case) -> Array:
    """Return the covariance of a few registrations."""
    xi = registrations(case)
    if not is_positive_definite(Y := monte_carlo(xi)):
        raise RegistrationError(f"the covariance of {len(xi)} registrations is singular")
    return Y


def by_fusion(case: Case) -> Array:
    """Return the answer of ``by_model``, updated by a few registrations."""
    return fused(by_model(case), registrations(case))


#: Methods by name: those that a robot can choose, and two more to compare with.
METHODS: dict[str, Method] = {
    "cello3d": by_model,
    "constant": by_constant,
    "hessian": by_hessian,
    "sandwich": by_sandwich,
    "censi": by_censi,
    "sigma_points": sigma_points,
    "monte_carlo": by_monte_carlo,
    "fused": by_fusion,
}
ASK_MODEL = ("cello3d", "fused")  # methods that answer with the model's prediction


def extra_runs(name: str, settings: MethodSettings) -> int:
    """Return how many runs of ICP a method adds to the registration that it judges."""
    n = settings.n_registrations
    return {"sigma_points": 12, "monte_carlo": n, "fused": n}.get(name, 0)


def mean_example(model: Model) -> Array:
    """Return the mean of the examples as recorded, without their copies turned about z.  (6, 6).

    The turns of a pair stand side by side, in the order of ``model.rotations_rad``.
    """
    unturned = int(np.flatnonzero(model.rotations_rad == 0.0)[0])
    return symmetrized(model.covariances[unturned :: len(model.rotations_rad)].mean(axis=0))


def predicted(case: Case) -> Prediction:
    """Return the model's answer with the evidence for it."""
    model, found = case.model, case.description
    inputs = model_inputs(model.features, found.descriptors, found.features)
    return predict(model, inputs[0], *_place(case))


def _place(case: Case) -> tuple[Array | None, Array]:
    """Return what places a covariance of the model: the pair's shape and motion."""
    return case.description.shapes.get(case.model.shape), case.description.motion


def widened(prediction: Prediction, case: Case) -> Array:
    """Return a prediction's covariance, for an unknown pair at least the mean of the examples.

    The latter is the smallest that is larger than both, and only where ``widen_unknown`` asks.
    """
    settings = case.settings
    if not settings.widen_unknown or prediction.novelty <= settings.unknown_quantile:
        return prediction.covariance
    return larger(by_constant(case), prediction.covariance)
