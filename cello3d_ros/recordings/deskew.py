"""Scans without the motion within them, by the times of their points and a recording's poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cello3d_ros.clouds.motion import sweep_of, undistorted
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.recordings.recording import NOT_READ, DerivedRecording, Recording, Scan


def deskew(scan: Scan, track: PoseTrack) -> Scan | None:
    """Return the scan with each point as seen from the sensor at the stamp, without times.

    Points whose time is damaged are left out.  Returns None when the track does not cover the
    whole scan.  Raises RecordingError when the points have no times.
    """
    if scan.time_s is None:
        raise RecordingError("the points have no times that could be recognised")
    scan = scan.only(np.isfinite(scan.time_s))
    assert scan.time_s is not None
    sweep_s = sweep_of(scan.time_s)
    if not track.covers_sweep(scan.stamp_ns, *sweep_s):
        return None
    motion = track.motion(scan.stamp_ns, *sweep_s)
    return replace(scan, points=undistorted(scan.points, scan.time_s, motion), time_s=None)


def deskewed(recording: Recording) -> Iterator[Scan]:
    """Yield the scans undistorted; those that the poses do not cover are left out.

    Raises RecordingError when there is no track of poses, or none of the scans is covered.
    """
    track = recording.track()
    if track is None:
        raise RecordingError(f"{recording.name} has no poses over time to undistort scans with")
    n = 0
    for scan in recording:
        if scan.time_s is None and recording.times:
            raise RecordingError(f"{recording.name}: times of points are {recording.times}")
        if (straight := deskew(scan, track)) is not None:
            n += 1
            yield straight
    if n == 0:
        raise RecordingError(f"the poses of {recording.name} do not cover any of its scans")


class WithoutMotion(DerivedRecording):
    """A recording whose scans are without the motion within them, where its poses cover them."""

    def __init__(self, recording: Recording, track: PoseTrack) -> None:
        super().__init__(recording)
        self._track = track

    @property
    def times(self) -> str:
        """Nothing: they have served."""
        return ""

    def __iter__(self) -> Iterator[Scan]:
        for scan in self.recording:
            straight = None if scan.time_s is None else deskew(scan, self._track)
            yield scan if straight is None else straight

    def track(self) -> PoseTrack:
        """As of the recording."""
        return self._track


def without_motion(recording: Recording) -> Recording:
    """Return the recording without the motion within its scans.

    It is returned as it is where its points have no times that can be read, or it has no poses.
    """
    if not recording.times or recording.times.startswith(NOT_READ):
        return recording
    track = recording.track()
    return recording if track is None else WithoutMotion(recording, track)
