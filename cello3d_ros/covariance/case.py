"""What every covariance method is given: one registered pair and the settings to judge it by."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.shape import Cloud
from cello3d_ros.config import Pipeline
from cello3d_ros.covariance.description import Description
from cello3d_ros.covariance.model import Model
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.icp import Registration


class MethodSettings(NamedTuple):
    """What methods assume and what becomes of their answers; the defaults are the node's.

    sigma_m: standard deviation of the sensor's noise along each axis; n_registrations: extra runs
    of ICP by ``monte_carlo`` and ``fused``; unknown_quantile: the ``novelty`` beyond which a pair
    is unknown, i.e. unlike all examples; widen_unknown: whether the model's prediction for an
    unknown pair is widened to the mean of the examples; scale: factor on every covariance, which
    is then kept within floor_sigma_m, floor_sigma_rad and ceiling (``bounded``); n_threads changes
    no result.
    """

    sigma_m: float = 0.01
    n_registrations: int = 12
    unknown_quantile: float = 0.99
    widen_unknown: bool = True
    scale: float = 1.0
    floor_sigma_m: float = 1e-4
    floor_sigma_rad: float = 1e-4
    ceiling: float = 900.0
    n_threads: int = min(os.cpu_count() or 1, 4)  # more than that is not worth starting


DEFAULTS = MethodSettings()


@dataclass(frozen=True, eq=False)
class Case:
    """A registered pair, described once for all methods, and what they may use beside it."""

    reading: Cloud
    reference: Cloud
    registration: Registration
    description: Description
    pipeline: Pipeline
    model: Model
    rng: np.random.Generator
    settings: MethodSettings = DEFAULTS

    @property
    def T_hat(self) -> Array:
        """The registered pose T_ref_read.  (4, 4)."""
        return self.registration.T_ref_read
