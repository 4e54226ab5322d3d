"""Undistorts scans: each point moved to where the sensor would have seen it at the stamp."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.recordings.recording import Recording, Scan


def deskew(scan: Scan, track: PoseTrack) -> Scan | None:
    """Return the scan with ``p' = T(stamp)^-1 T(stamp + time) p``, without times.

    Points whose time is damaged are left out.  Returns None when the track does not cover the
    whole scan.  Raises RecordingError when the
    points have no times.
    """
    if scan.time_s is None:
        raise RecordingError("the points have no times that could be recognised")
    scan = scan.only(np.isfinite(scan.time_s))
    assert scan.time_s is not None
    first, last = float(scan.time_s.min(initial=0.0)), float(scan.time_s.max(initial=0.0))
    ends = (scan.stamp_ns + int(np.floor(first * 1e9)), scan.stamp_ns + int(np.ceil(last * 1e9)))
    if not track.covers(*ends):
        return None
    T = track.motion(scan.stamp_ns, scan.time_s)
    points = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3]
    return replace(scan, points=points, time_s=None)


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
