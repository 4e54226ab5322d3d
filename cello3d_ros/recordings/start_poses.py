"""Poses of another program for the scans of any recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.recordings.poses import read_poses
from cello3d_ros.recordings.recording import DerivedRecording, Recording, Scan


def start_track(path: Path, recording: Recording) -> PoseTrack:
    """Return the poses of a TUM file, by stamp, or of a KITTI file, a row a scan.

    Between two poses farther apart than ``pose_track.GAP_S`` there is none.  Raises RecordingError
    where no scan has a pose.
    """
    track, _ = read_poses(path)
    if not isinstance(track, PoseTrack):
        if len(track) != len(recording):
            raise RecordingError(f"{path}: has {len(track)} poses for {len(recording)} scans")
        return PoseTrack.of_poses([scan.stamp_ns for scan in recording], track)
    if all(track.near(scan.stamp_ns) is None for scan in recording):
        raise RecordingError(f"{path}: no pose has the time of any scan of {recording.name}")
    return track


class PosesAsOdometry(DerivedRecording):
    """A recording whose ground truth takes the place of its odometry."""

    has_odometry = True

    def __iter__(self) -> Iterator[Scan]:
        for scan in self.recording:
            yield replace(scan, T_odom_sensor=scan.T_world_sensor)

    def track(self) -> PoseTrack | None:
        """Return the poses at the stamps of the scans."""
        posed = [scan for scan in self if scan.T_odom_sensor is not None]
        T = np.array([scan.T_odom_sensor for scan in posed]).reshape(-1, 4, 4)
        return PoseTrack.of_poses([scan.stamp_ns for scan in posed], T)


class PosedRecording(DerivedRecording):
    """A recording with the poses of another program as its ground truth.

    A scan that they do not cover has none.
    """

    def __init__(
        self, recording: Recording, poses: PoseTrack, keeps_odometry: bool = False
    ) -> None:
        """keeps_odometry: whether the scans keep the odometry of the recording."""
        super().__init__(recording)
        self.poses, self._keeps_odometry = poses, keeps_odometry

    @property
    def has_odometry(self) -> bool:
        """Whether it keeps odometry that the recording has."""
        return self._keeps_odometry and self.recording.has_odometry

    def __iter__(self) -> Iterator[Scan]:
        for scan in self.recording:
            T_odom = scan.T_odom_sensor if self._keeps_odometry else None
            T = self.poses.near(scan.stamp_ns)
            yield replace(scan, T_world_sensor=T, T_odom_sensor=T_odom)

    def track(self) -> PoseTrack | None:
        """Return the odometry that it keeps, else the poses."""
        return self.recording.track() if self.has_odometry else self.poses
