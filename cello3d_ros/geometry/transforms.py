"""Transforms between named frames, as /tf and /tf_static tell them.

/tf and /tf_static are ordinary topics of ordinary messages, so a bag and a node read them alike
and tf2's C++ buffer is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import GaussianPose, to_left
from cello3d_ros.geometry.pose_track import (
    GAP_S,
    PoseError,
    PoseNotYetError,
    PoseTrack,
    checked_pose,
)
from cello3d_ros.geometry.se3 import Array

Edge = tuple[str, str]  # parent and child

_MAX_FRAMES = 10_000
_N_NAMED = 20  # frames that an error names


class UnknownFrameError(PoseNotYetError):
    """No transform leads from one frame to another at a stamp; it may still come."""

    reason = "unknown_frame"


class NotConnectedError(UnknownFrameError):
    """No transforms connect two frames, at any time."""


class TransformTree:
    """Transforms between named frames: static ones for good, others over time."""

    def __init__(self, gap_s: float = GAP_S, length_s: float = math.inf) -> None:
        """Remember ``length_s`` seconds; do not interpolate between poses ``gap_s`` apart."""
        self._gap_s, self._length_s = gap_s, length_s
        self._edges: dict[Edge, Array | PoseTrack] = {}
        self._ways: dict[Edge, list[tuple[Edge, bool]] | None] = {}

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({frame for edge in self._edges for frame in edge})

    def clear(self) -> None:
        """Forget the transforms that depend on time: time has jumped."""
        for held in self._edges.values():
            if isinstance(held, PoseTrack):
                held.clear()

    def add(self, message: Any, static: bool) -> list[str]:
        """Remember the transforms of a TFMessage; return why some were rejected."""
        rejected = []
        for item in message.transforms:
            try:
                self._add(item, static)
            except PoseError as error:
                edge = f"{item.header.frame_id!r} to {item.child_frame_id!r}"
                rejected.append(f"transform from {edge} rejected: {error}")
        return rejected

    def at(self, parent: str, child: str, stamp_ns: int) -> Array:
        """Return T_parent_child (4, 4) at a stamp.  Raises UnknownFrameError, never guesses."""
        T: Array = np.eye(4)
        for edge, forward in self._way(parent, child):
            held = self._edges[edge]
            try:
                step = held.pose(stamp_ns) if isinstance(held, PoseTrack) else held
            except PoseError as error:
                raise UnknownFrameError(
                    f"no transform from {parent!r} to {child!r} at the stamp of the cloud: {error}"
                ) from None
            T = T @ (step if forward else se3.inverse(step))
        return T

    def leads_through(self, parent: str, child: str, frame: str) -> bool:
        """Return whether a third frame lies on the way from one frame to another."""
        try:
            steps = self._way(parent, child)
        except NotConnectedError:
            return False
        return frame.strip("/") in {end for edge, _ in steps for end in edge}

    def constant(self, parent: str, child: str) -> Array | None:
        """Return T_parent_child (4, 4) where it is the same at all times, else None.

        It is where each transform between the two is static or has been repeated unchanged.
        """
        try:
            steps = self._way(parent, child)
        except NotConnectedError:
            return None
        T: Array = np.eye(4)
        for edge, forward in steps:
            held = self._edges[edge]
            if isinstance(held, PoseTrack):
                if not held.is_constant():
                    return None
                held = next(iter(held))[1]
            T = T @ (held if forward else se3.inverse(held))
        return T

    def _way(self, parent: str, child: str) -> list[tuple[Edge, bool]]:
        if (parent, child) not in self._ways:
            self._ways[parent, child] = way(parent, child, self._edges)
        steps = self._ways[parent, child]
        if steps is None:
            names = ", ".join(self.frames[:_N_NAMED]) or "none"
            raise NotConnectedError(
                f"no transforms connect {parent!r} and {child!r}; frames are {names}"
            )
        return steps

    def _add(self, item: Any, static: bool) -> None:
        T = checked_pose(item.transform.translation, item.transform.rotation)
        edge = (item.header.frame_id.strip("/"), item.child_frame_id.strip("/"))
        if edge not in self._edges:
            self._connect(edge)
        if static:
            self._edges[edge] = T
            return
        held = self._edges[edge]
        if not isinstance(held, PoseTrack):
            what = f"transform from {edge[0]!r} to {edge[1]!r}"
            held = self._edges[edge] = PoseTrack(self._gap_s, self._length_s, what=what)
        stamp = item.header.stamp
        held.add(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec), T)

    def _connect(self, edge: Edge) -> None:
        """Make room for a new edge; a frame has one parent, the last."""
        if edge[0] == edge[1] or not all(edge):
            raise PoseError("a frame cannot be its own parent or nameless")
        for old in [other for other in self._edges if other[1] == edge[1]]:
            del self._edges[old]
        if len(self._edges) >= _MAX_FRAMES:
            raise PoseError(f"there are more than {_MAX_FRAMES} frames")
        self._edges[edge] = np.eye(4)
        self._ways.clear()


def way(parent: str, child: str, edges: Iterable[Edge]) -> list[tuple[Edge, bool]] | None:
    """Return the edges that lead from one frame to another, or None; of several ways a shortest.

    Each comes with whether it is walked downward, from parent to child.
    """
    start, goal, ordered = parent.strip("/"), child.strip("/"), sorted(edges)
    ways: dict[str, list[tuple[Edge, bool]]] = {start: []}
    queue = [start]
    for frame in queue:
        for edge in ordered:
            for here, there, forward in ((edge[0], edge[1], True), (edge[1], edge[0], False)):
                if here == frame and there not in ways:
                    ways[there] = [*ways[frame], (edge, forward)]
                    queue.append(there)
    return ways.get(goal)


def seen_from_base(T: Array, Y: Array, T_base_ref: Array, T_base_read: Array) -> GaussianPose:
    """Return the pose between the bases from the pose between their sensors.

    With ``T exp(xi)``, xi ~ N(0, Y), between the sensors and X the extrinsic at each of the two
    scans, ``X_ref T exp(xi) X_read^-1 = (X_ref T X_read^-1) exp(Ad(X_read) xi)``.
    T, T_base_ref, T_base_read: (4, 4); Y: (6, 6), reading side, and so is the one returned.
    """
    return GaussianPose(T_base_ref @ T @ se3.inverse(T_base_read), to_left(T_base_read, Y))
