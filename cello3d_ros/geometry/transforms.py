"""Transforms between named frames, as /tf and /tf_static tell them."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from typing import Any

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array

Edge = tuple[str, str]  # parent and child


class PoseLog:
    """Stamped poses as they come, in little memory."""

    def __init__(self) -> None:
        self._stamps, self._rows = array("q"), array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, position: Any, rotation: Any) -> None:
        """Keep one pose of a message."""
        self._stamps.append(stamp_ns)
        self._rows.extend((position.x, position.y, position.z))
        self._rows.extend((rotation.x, rotation.y, rotation.z, rotation.w))

    def track(self) -> PoseTrack:
        """Return all poses.  Raises RecordingError for one that is none."""
        return PoseTrack(
            np.array(self._stamps, dtype=np.int64), np.array(self._rows).reshape(-1, 7)
        )


class TransformTree:
    """Edges parent -> child: static, or tracks over time.  A frame's last parent counts."""

    def __init__(self) -> None:
        self._logs: dict[Edge, PoseLog] = {}
        self._static: dict[Edge, Array] = {}
        self._tracks: dict[Edge, PoseTrack] = {}

    def add(self, message: Any, static: bool) -> None:
        """Keep the transforms of one TFMessage."""
        for item in message.transforms:
            edge = (item.header.frame_id.strip("/"), item.child_frame_id.strip("/"))
            stamp = item.header.stamp
            stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
            log = PoseLog() if static else self._logs.setdefault(edge, PoseLog())
            log.add(stamp_ns, item.transform.translation, item.transform.rotation)
            if static:
                self._static[edge] = next(iter(log.track()))[1]

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({frame for edge in [*self._static, *self._logs] for frame in edge})

    def static(self, parent: str, child: str) -> Array | None:
        """Return T_parent_child (4, 4) of static transforms; None if they do not connect."""
        steps = way(parent, child, self._static)
        T = np.eye(4)
        for edge, forward in steps or []:
            T = T @ (self._static[edge] if forward else se3.inverse(self._static[edge]))
        return None if steps is None else T

    def at(self, parent: str, child: str, stamp_ns: int) -> Array | None:
        """Return T_parent_child (4, 4) at a time; None outside the span of the transforms.

        Raises RecordingError when no transforms connect the two frames.
        """
        steps = way(parent, child, {*self._static, *self._logs})
        if steps is None:
            raise RecordingError(
                f"no transforms connect {parent!r} and {child!r}; frames are "
                f"{', '.join(self.frames) or 'none'}"
            )
        T = np.eye(4)
        for edge, forward in steps:
            step = self._static.get(edge)
            step = self._track(edge).at(stamp_ns) if step is None else step
            if step is None:
                return None
            T = T @ (step if forward else se3.inverse(step))
        return T

    def _track(self, edge: Edge) -> PoseTrack:
        if edge not in self._tracks:
            self._tracks[edge] = self._logs[edge].track()
        return self._tracks[edge]


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
