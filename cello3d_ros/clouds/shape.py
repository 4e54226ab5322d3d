"""Local shape of a cloud: normals, planarity and cylindricality of each point."""

from __future__ import annotations

from typing import NamedTuple

from cello3d_ros.clouds.neighbors import KdTree
from cello3d_ros.geometry.se3 import Array


class Cloud(NamedTuple):
    """A filtered scan with its local shape, computed once and used in both roles.

    points: (N, 3), metres, sensor frame; normals: (N, 3), unit, sign arbitrary;
    planarity, cylindricality: (N,), in [0, 1]; tree: k-d tree of the points.
    """

    points: Array
    normals: Array
    planarity: Array
    cylindricality: Array
    tree: KdTree
