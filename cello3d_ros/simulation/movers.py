"""What moves in a world while it is scanned: cars, people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh
from cello3d_ros.simulation.paths import Route


@dataclass(frozen=True)
class Mover:
    """A rigid thing that is carried along a route at a constant speed, and starts over at its end.

    mesh: in its own frame, x ahead, z up, the origin on the ground.  start_m: where on the route
    it is at time 0.  speed_m_s: negative for the other direction.
    """

    mesh: Mesh
    route: Route
    start_m: float
    speed_m_s: float

    def poses(self, time_s: ArrayLike) -> Array:
        """Return T_world_mover (..., 4, 4) at times (...)."""
        t = np.asarray(time_s, dtype=np.float64)
        places, heading = self.route.at(self.start_m + self.speed_m_s * t)
        heading = heading + (np.pi if self.speed_m_s < 0 else 0.0)
        T = np.zeros((*t.shape, 4, 4))
        T[..., 0, 0] = T[..., 1, 1] = np.cos(heading)
        T[..., 1, 0] = np.sin(heading)
        T[..., 0, 1] = -T[..., 1, 0]
        T[..., 2, 2] = T[..., 3, 3] = 1.0
        T[..., :3, 3] = places
        return T
