"""Poses of another program for the scans of any recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.recordings import tables
from cello3d_ros.recordings.poses import read_tum, rigid
from cello3d_ros.recordings.recording import Recording, Scan


def start_track(path: Path, recording: Recording) -> PoseTrack:
    """Return the poses of a TUM file, by stamp, or of a KITTI file, a row a scan.

    Between two poses farther apart than ``pose_track.GAP_S`` there is none.  Raises RecordingError
    where no scan has a pose.
    """
    data = tables.read_bytes(path)
    words = next((line.split() for line in data.splitlines() if line.split(b"#")[0].strip()), [])
    if len(words) == 12:
        T = rigid(tables.numbers(data, 12, path).reshape(-1, 3, 4), path).T
        if len(T) != len(recording):
            raise RecordingError(f"{path}: has {len(T)} poses for {len(recording)} scans")
        return PoseTrack.of_poses([scan.stamp_ns for scan in recording], T)
    track = PoseTrack.of_rows(*read_tum(data, path))
    if all(track.at(scan.stamp_ns) is None for scan in recording):
        raise RecordingError(f"{path}: no pose has the time of any scan of {recording.name}")
    return track


@dataclass(frozen=True)
class PosedRecording:
    """A recording with the poses of another program as its ground truth, and no odometry."""

    recording: Recording
    poses: PoseTrack

    has_odometry = False
    n_projected = 0

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name

    def __len__(self) -> int:
        return len(self.recording)

    def __iter__(self) -> Iterator[Scan]:
        for scan in self.recording:
            T = self.poses.at(scan.stamp_ns)
            yield replace(scan, T_world_sensor=T, T_odom_sensor=None)

    def track(self) -> PoseTrack:
        """Return the poses."""
        return self.poses
