"""Draw the markers that the node published, as they came over DDS, among the clouds that it saw.

cello3d demo --out build/demo -p node.marker_scale:=20.0
python benchmarks/ellipses.py build/demo/bag --recording bags/demo --out docs/images/ellipses.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cello3d_ros.geometry import se3
from cello3d_ros.recordings import open_recording

_SPHERE, _ARROW = 2, 0  # visualization_msgs/Marker
_MAX_POINTS = 25_000


def main() -> None:
    """Write a picture of a recorded ~/markers topic."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag", type=Path, help="bag of the node's messages, by cello3d demo")
    parser.add_argument("--recording", type=Path, required=True, help="what the demo played")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    arguments = parser.parse_args()
    arrays, poses = read(arguments.bag)
    points = seen(arguments.recording, poses)
    figure = Figure(figsize=(13, 6), dpi=80)
    span = np.array([T[:3, 3] for T in poses.values()])
    centre, reach = 0.5 * (span.max(0) + span.min(0)), 0.75 * max(np.ptp(span, axis=0).max(), 1.0)
    half = np.array([reach, reach, 0.35 * reach])
    near = points[(np.abs(points - centre) < half).all(axis=1)]
    side: Any = figure.add_subplot(1, 2, 1, projection="3d", computed_zorder=False)
    above = figure.add_subplot(1, 2, 2)
    side.scatter(*near.T, s=0.6, c=near[:, 2], cmap="bone", alpha=0.5, linewidths=0)
    above.scatter(*near.T[:2], s=0.6, c=near[:, 2], cmap="bone", alpha=0.5, linewidths=0)
    for array in arrays:
        for marker in array.markers:
            draw(side, marker)
            draw_from_above(above, marker)
    limits = {f"{name}lim": (c - h, c + h) for name, c, h in zip("xyz", centre, half, strict=True)}
    side.set(**limits, xlabel="x in m", ylabel="y in m")
    side.set_box_aspect(half, zoom=1.2)
    side.view_init(40.0, -60.0)
    del limits["zlim"]
    above.set(**limits, xlabel="x in m", ylabel="y in m", aspect="equal")
    figure.subplots_adjust(left=0.0, bottom=0.09, right=0.99, top=0.94, wspace=0.06)
    figure.suptitle(f"~/markers of {arguments.recording.name}: from the side and from above")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out)


def read(bag: Path) -> tuple[list[Any], dict[int, np.ndarray]]:
    """Return the marker arrays of a bag and the poses of ~/pose by stamp in nanoseconds."""
    arrays, poses = [], {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, raw in reader.messages():
            name = connection.topic.rsplit("/", 1)[-1]
            if name not in ("markers", "pose"):
                continue
            message: Any = reader.deserialize(raw, connection.msgtype)
            if name == "markers":
                arrays.append(message)
            else:
                stamp = message.header.stamp
                poses[stamp.sec * 1_000_000_000 + stamp.nanosec] = pose_of(message.pose.pose)
    return arrays, poses


def seen(recording: Path, poses: dict[int, np.ndarray]) -> np.ndarray:
    """Return points of all answered clouds in the frame of ~/pose.  (N, 3)."""
    clouds = [
        se3.transform(poses[scan.stamp_ns], scan.points)
        for scan in open_recording(recording)
        if scan.stamp_ns in poses
    ]
    points = np.vstack(clouds)
    return points[:: max(1, len(points) // _MAX_POINTS)]


def pose_of(pose: Any) -> np.ndarray:
    """Return a geometry_msgs/Pose as a (4, 4) matrix."""
    p, q = pose.position, pose.orientation
    return se3.pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def draw(axes: Any, marker: Any) -> None:
    """Draw an ellipsoid or an arrow in its own colour; the chain and rotations are left out."""
    color = (marker.color.r, marker.color.g, marker.color.b)
    if marker.type == _ARROW:
        start, end = (np.array([p.x, p.y, p.z]) for p in marker.points)
        axes.quiver(*start, *(end - start), color=color, linewidth=1.2, arrow_length_ratio=0.2)
    elif marker.type == _SPHERE and marker.ns == "translation":
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
        ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
        size = 0.5 * np.array([marker.scale.x, marker.scale.y, marker.scale.z])
        surface = se3.transform(pose_of(marker.pose), (ball * size).reshape(-1, 3))
        X, Y, Z = surface.reshape(*u.shape, 3).transpose(2, 0, 1)
        axes.plot_surface(X, Y, Z, color=color, alpha=marker.color.a, linewidth=0)


def draw_from_above(axes: Any, marker: Any) -> None:
    """Draw the outline of an ellipsoid, or an arrow, as seen from above."""
    color = (marker.color.r, marker.color.g, marker.color.b)
    if marker.type == _ARROW:
        start, end = marker.points
        axes.plot([start.x, end.x], [start.y, end.y], color=color, linewidth=1.0)
    elif marker.type == _SPHERE and marker.ns == "translation":
        T = pose_of(marker.pose)
        size = 0.5 * np.array([marker.scale.x, marker.scale.y, marker.scale.z])
        A = (T[:3, :3] * size)[:2]
        values, vectors = np.linalg.eigh(A @ A.T)  # of the outline, an ellipse
        turn = np.linspace(0.0, 2.0 * np.pi, 60)
        outline = (
            T[:2, 3]
            + np.column_stack([np.cos(turn), np.sin(turn)]) @ (vectors * np.sqrt(values)).T
        )
        axes.fill(*outline.T, facecolor=(*color, 0.3), edgecolor=color, linewidth=1.2)


if __name__ == "__main__":
    main()
