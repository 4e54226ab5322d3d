"""What ``cello3d info`` says of a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from cello3d_ros.cli.sources import open_source, with_progress
from cello3d_ros.clouds.filters import is_planar
from cello3d_ros.errors import RecordingError


def is_recording(path: Path) -> bool:
    """Return whether there is a recording at a path, sound or damaged."""
    from cello3d_ros.recordings.opening import kind_of

    try:
        return kind_of(path) is not None
    except RecordingError:
        return True


def describe_recording(path: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Read a recording from end to end and return what is in it.  Raises RecordingError."""
    from cello3d_ros.recordings.bag import BagRecording
    from cello3d_ros.recordings.challenging import ChallengingRecording, sequence_of
    from cello3d_ros.recordings.opening import kind_of

    recording = open_source(path, arguments)
    found: dict[str, Any] = {"recording": kind_of(path), "name": recording.name}
    if isinstance(recording, ChallengingRecording):
        found["sequence"] = sequence_of(recording.name)
    found |= _scans(with_progress(recording, recording.n_declared, recording.name))
    found["times"] = recording.times or None
    found["n_poses_projected"] = recording.n_projected
    found["skipped"] = recording.skipped or None
    if isinstance(recording, BagRecording):
        found["read_as"] = recording.topics._asdict()
        found["topics"] = {
            topic: f"{recording.counts[topic]} {kind}" for topic, kind in recording.types.items()
        }
    return found


def _scans(scans: Any) -> dict[str, Any]:
    """Count what the scans have; ``time_span_s`` is the longest scan's."""
    stamps, sizes, n_truth, n_odometry, n_intensity, n_planar = [], [], 0, 0, 0, 0
    spans, length_m, before = [], 0.0, None
    for scan in scans:
        stamps.append(scan.stamp_ns)
        sizes.append(len(scan.points))
        n_planar += is_planar(scan.points)
        n_odometry += scan.T_odom_sensor is not None
        n_intensity += scan.intensity is not None
        if scan.time_s is not None and len(scan.time_s):
            spans.append(float(np.ptp(scan.time_s)))
        if (T := scan.T_world_sensor) is not None:
            n_truth += 1
            length_m += 0.0 if before is None else float(np.linalg.norm(T[:3, 3] - before))
            before = T[:3, 3]
    return {
        "n_scans": len(stamps),
        "first_stamp_ns": stamps[0] if stamps else None,
        "duration_s": 1e-9 * (stamps[-1] - stamps[0]) if stamps else 0.0,
        "points_per_scan": {
            "min": min(sizes, default=0),
            "median": float(np.median(sizes)) if sizes else 0.0,
            "max": max(sizes, default=0),
            "total": sum(sizes),
        },
        "n_scans_2d": n_planar,
        "n_scans_with_ground_truth": n_truth,
        "n_scans_with_odometry": n_odometry,
        "n_scans_with_intensity": n_intensity,
        "n_scans_with_point_times": len(spans),
        "time_span_s": max(spans, default=None),
        "path_length_m": length_m if n_truth else None,
    }
