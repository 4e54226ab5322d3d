"""Named frames on a robot: /tf remembered for a while, and answers moved to another frame.

/tf and /tf_static are ordinary topics of ordinary messages, so they are heard like the others and
tf2's C++ buffer is not needed.  Imports no ROS.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import GaussianPose, to_left
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.geometry.transforms import Edge, way
from cello3d_ros.tracking.odometry import (
    OdometryBuffer,
    OdometryError,
    OdometryNotYetError,
    checked_pose,
)

_MAX_FRAMES = 10_000


class UnknownFrameError(OdometryNotYetError):
    """No transform leads from one frame to another at a stamp; it may still come."""


class TransformBuffer:
    """Transforms between named frames: static ones for good, others for a while."""

    def __init__(self, length_s: float, gap_s: float) -> None:
        """Remember ``length_s`` seconds; do not interpolate between poses ``gap_s`` apart."""
        self._length_s, self._gap_s = length_s, gap_s
        self._edges: dict[Edge, Array | OdometryBuffer] = {}
        self._ways: dict[Edge, list[tuple[Edge, bool]] | None] = {}

    def clear(self) -> None:
        """Forget the transforms that depend on time: time has jumped."""
        for buffer in self._edges.values():
            if isinstance(buffer, OdometryBuffer):
                buffer.clear()

    def hear(self, message: Any, static: bool) -> list[str]:
        """Remember the transforms of a TFMessage; return why some were rejected."""
        rejected = []
        for item in message.transforms:
            try:
                self._add(item, static)
            except OdometryError as error:
                edge = f"{item.header.frame_id!r} to {item.child_frame_id!r}"
                rejected.append(f"transform from {edge} rejected: {error}")
        return rejected

    def at(self, parent: str, child: str, stamp_ns: int) -> Array:
        """Return T_parent_child (4, 4) at a stamp.  Raises UnknownFrameError, never guesses."""
        T: Array = np.eye(4)
        for edge, forward in self._way(parent, child):
            held = self._edges[edge]
            try:
                step = held.at(stamp_ns) if isinstance(held, OdometryBuffer) else held
            except OdometryError as error:
                raise UnknownFrameError(
                    f"no transform from {parent!r} to {child!r} at the stamp of the cloud: {error}"
                ) from None
            T = T @ (step if forward else se3.inverse(step))
        return T

    def _way(self, parent: str, child: str) -> list[tuple[Edge, bool]]:
        if (parent, child) not in self._ways:
            self._ways[parent, child] = way(parent, child, self._edges)
        steps = self._ways[parent, child]
        if steps is None:
            raise UnknownFrameError(f"no transforms connect {parent!r} and {child!r}")
        return steps

    def _add(self, item: Any, static: bool) -> None:
        p, q = item.transform.translation, item.transform.rotation
        T = checked_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        edge = (item.header.frame_id.strip("/"), item.child_frame_id.strip("/"))
        if edge not in self._edges:
            self._connect(edge)
        held = self._edges[edge]
        if static:
            self._edges[edge] = T
            return
        if not isinstance(held, OdometryBuffer):
            what = f"transform from {edge[0]!r} to {edge[1]!r}"
            held = self._edges[edge] = OdometryBuffer(self._length_s, self._gap_s, what=what)
        stamp = item.header.stamp
        stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
        if held.newest_ns != stamp_ns:  # two publishers of one transform repeat it
            held.add(stamp_ns, T)

    def _connect(self, edge: Edge) -> None:
        """Make room for a new edge; a frame has one parent, the last."""
        if edge[0] == edge[1] or not all(edge):
            raise OdometryError("a frame cannot be its own parent or nameless")
        for old in [other for other in self._edges if other[1] == edge[1]]:
            del self._edges[old]
        if len(self._edges) >= _MAX_FRAMES:
            raise OdometryError(f"there are more than {_MAX_FRAMES} frames")
        self._edges[edge] = np.eye(4)
        self._ways.clear()


def seen_from_base(T: Array, Y: Array, T_base_ref: Array, T_base_read: Array) -> GaussianPose:
    """Return the pose between the bases from the pose between their sensors.

    With ``T exp(xi)``, xi ~ N(0, Y), between the sensors and X the extrinsic at each of the two
    scans, ``X_ref T exp(xi) X_read^-1 = (X_ref T X_read^-1) exp(Ad(X_read) xi)``.
    T, T_base_ref, T_base_read: (4, 4); Y: (6, 6), reading side, and so is the one returned.
    """
    return GaussianPose(T_base_ref @ T @ se3.inverse(T_base_read), to_left(T_base_read, Y))
