"""A recording with joint poses as its ground truth, for whatever asks a recording for poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.learning.align import Alignment, Progress, align
from cello3d_ros.learning.align_scans import RawScan, without_motion
from cello3d_ros.learning.align_sweeps import AlignSettings, motion_of
from cello3d_ros.recordings.recording import Recording, Scan

_DEFAULTS = AlignSettings()


@dataclass(frozen=True)
class AlignedPart:
    """The scans of one part of an alignment, with its poses and without the motion within them.

    Scans that are left out are missing.
    """

    recording: Recording
    alignment: Alignment
    part: int = 0

    has_odometry = False
    n_projected = 0
    times = ""  # the motion within the scans has been undone

    @property
    def name(self) -> str:
        """Name of the recording; a part beyond the first has its number, from 2, behind it."""
        return self.recording.name + (f".{self.part + 1}" if self.part else "")

    @property
    def n_declared(self) -> int:
        """How many scans it has."""
        return len(self)

    @property
    def skipped(self) -> dict[str, int]:
        """As of the recording."""
        return self.recording.skipped

    def __len__(self) -> int:
        return len(self.alignment.members(self.part))

    def __iter__(self) -> Iterator[Scan]:
        found, members = self.alignment, self.alignment.members(self.part)
        kept = set(members.tolist())
        for k, scan in enumerate(self.recording):
            if k not in kept:
                continue
            points = scan.points
            if found.compensated and scan.time_s is not None:
                scan = scan.only(np.isfinite(scan.time_s))
                velocity = motion_of(k, found.poses, found.stamps_ns, members)
                points = without_motion(RawScan(scan.points, scan.time_s), velocity)
            T = found.poses[k]
            yield replace(scan, points=points, time_s=None, T_world_sensor=T, T_odom_sensor=None)

    def track(self) -> PoseTrack:
        """Return the joint poses."""
        members = self.alignment.members(self.part)
        return PoseTrack.of_poses(
            self.alignment.stamps_ns[members], self.alignment.poses[members], np.inf
        )


def aligned_parts(
    recording: Recording,
    folder: Path,
    settings: AlignSettings = _DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> list[AlignedPart]:
    """Align a recording, once for a folder, and return its parts.

    folder: keeps the poses; scans are kept there only while they are needed.
    """
    found = align(recording, settings, folder=folder, progress=progress)
    return [AlignedPart(recording, found, part) for part in range(found.n_parts)]


def joint_folder(dataset: Path, name: str) -> Path:
    """Return where the joint poses of a recording are kept: beside the dataset of its samples."""
    return dataset.with_name(f"{dataset.name}.joint") / name


def pose_facts(part: AlignedPart) -> dict[str, Any]:
    """Return what a dataset should know of the poses."""
    sigma_m, sigma_rad = part.alignment.sigmas()
    return {
        "poses": "joint",
        "step_sigma_m": sigma_m,
        "step_sigma_rad": sigma_rad,
        "left_out": {str(k): reason for k, reason in part.alignment.reasons.items()},
    }
