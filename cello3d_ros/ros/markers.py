"""Ellipsoids of what a registration does not know, as visualization_msgs/MarkerArray.

Four markers an answer, each in a namespace of its own: ``translation``, the ellipsoid of 3
standard deviations of the registration's translation; ``rotation``, that of its rotation, one
radian drawn as ``RADIAN_M`` metres (how far a point at that distance is off); ``weakest``, an
arrow along the translation's longest axis; ``chain``, the translation's ellipsoid of the
accumulated pose.  All stand at the accumulated pose, in its frame.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros.messages import duration_of, pose_to
from cello3d_ros.tracking.covariances import N_SIGMA, principal_axes

RADIAN_M = 10.0
N_TRAIL = 50  # answers shown; older ones are overwritten

_THINNEST_M = 1e-4  # an ellipsoid without thickness is not drawn at all
_GREEN, _ORANGE, _RED = (0.2, 0.8, 0.2), (1.0, 0.6, 0.0), (0.9, 0.1, 0.1)
_COLORS = (_GREEN, _ORANGE, _RED)  # by level of the diagnostics
_YELLOW, _VIOLET = (1.0, 1.0, 0.5), (0.8, 0.2, 0.8)


def markers_to(
    pose: PoseWithCovarianceStamped,
    C_step: Array,
    *,
    number: int,
    level: int = 0,
    scale: float = 1.0,
    lifetime_s: float = 0.0,
) -> MarkerArray:
    """Return the markers of the ``number``-th answer.

    pose: the accumulated one, as it is published.  C_step: (6, 6), covariance of the registration
    along the axes of the pose's frame.  level: 0, 1 or 2, the colour of the registration (green,
    orange, red).  scale: how many times as large as they are ellipsoids and arrow are drawn.
    lifetime_s: when a marker vanishes; 0 is never.
    """
    blank = Marker(header=pose.header, id=number % N_TRAIL, action=Marker.ADD)
    blank.lifetime = duration_of(lifetime_s)
    p, size, color = pose.pose.pose.position, N_SIGMA * scale, _COLORS[level]
    at, C_chain = np.array([p.x, p.y, p.z]), pose.pose.covariance.reshape(6, 6)
    translation, chain = (size**2 * C[:3, :3] for C in (C_step, C_chain))
    rotation = (size * RADIAN_M) ** 2 * C_step[3:, 3:]
    return MarkerArray(
        markers=[
            _ellipsoid(blank, "translation", at, translation, color, 0.6),
            _ellipsoid(blank, "rotation", at, rotation, _YELLOW, 0.25),
            _arrow(blank, at, translation, color),
            _ellipsoid(blank, "chain", at, chain, _VIOLET, 0.15),
        ]
    )


def _ellipsoid(
    blank: Marker, namespace: str, at: Array, C: Array, rgb: tuple[float, ...], alpha: float
) -> Marker:
    """Return the surface of points ``at + C^1/2 e``, e of length 1.  C: (3, 3)."""
    sigma, axes = principal_axes(C)
    marker = _copy(blank, namespace, Marker.SPHERE, rgb, alpha)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes, at
    marker.pose = pose_to(T)
    marker.scale.x, marker.scale.y, marker.scale.z = (
        float(value) for value in np.maximum(2.0 * sigma, _THINNEST_M)
    )
    return marker


def _arrow(blank: Marker, at: Array, C: Array, rgb: tuple[float, ...]) -> Marker:
    """Return an arrow from ``at`` to the end of the longest axis of ``C``.  C: (3, 3)."""
    sigma, axes = principal_axes(C)
    length = max(float(sigma[0]), _THINNEST_M)
    marker = _copy(blank, "weakest", Marker.ARROW, rgb, 1.0)
    marker.pose = pose_to(np.eye(4))
    marker.points = [_point(at), _point(at + length * axes[:, 0])]
    marker.scale.x, marker.scale.y, marker.scale.z = 0.05 * length, 0.1 * length, 0.2 * length
    return marker


def _copy(
    blank: Marker, namespace: str, kind: int, rgb: tuple[float, ...], alpha: float
) -> Marker:
    r, g, b = rgb
    return Marker(
        header=blank.header,
        ns=namespace,
        id=blank.id,
        type=kind,
        action=blank.action,
        lifetime=blank.lifetime,
        color=ColorRGBA(r=r, g=g, b=b, a=alpha),
    )


def _point(p: Array) -> Point:
    return Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))
