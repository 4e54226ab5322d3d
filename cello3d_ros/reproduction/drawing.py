"""What the figures share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.se3 import Array

BLUE, RED, GREEN, ORANGE, GREY = "#2166ac", "#b2182b", "#1b7837", "#d95f02", "#777777"


def figure(width: float, height: float) -> Any:
    """Return an empty figure of a size in inches, drawn without a display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def ellipse(axes: Any, center: ArrayLike, C: Array, n_sigma: float, **style: Any) -> None:
    """Draw the contour of a Gaussian in the plane.  center: (2,); C: (2, 2)."""
    axes.plot(*contour(center, C, n_sigma), **style)


def contour(center: ArrayLike, C: Array, n_sigma: float) -> Array:
    """Return points of the ellipse of ``n_sigma`` deviations.  (2, 2) -> (2, 100)."""
    values, vectors = np.linalg.eigh(C)
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.asarray(center)[:, None] + n_sigma * root @ circle)
