"""What the node does with clouds and odometry, over a recording and without ROS.

Every cloud is worked on, in order, each with the odometry that the node would have waited for;
none is superseded by a newer one.  Imports no ROS.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cello3d_ros.clouds.motion import sweep_of
from cello3d_ros.config import NodeConfig
from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.recordings.bag import BagRecording
from cello3d_ros.recordings.recording import NOT_READ, Recording, Scan
from cello3d_ros.tracking.guess import CONSTANT_VELOCITY, EXTERNAL, ODOMETRY, Locator, Place
from cello3d_ros.tracking.odometry import PoseSource
from cello3d_ros.tracking.tracker import Answer, Tracker

Sweep = tuple[float, float]


class Step(NamedTuple):
    """What became of one cloud: an answer, or a reason and a sentence why there is none."""

    scan: Scan
    answer: Answer | None
    reason: str = ""
    sentence: str = ""


def replay(recording: Recording, tracker: Tracker, config: NodeConfig) -> Iterator[Step]:
    """Yield what became of every cloud; the first one's reason is "reference"."""
    no_times = f"no: {_why_no_times(recording, config)}"
    for scan, place in _places(recording, config):
        if isinstance(place, Place):
            step = _step(scan, place, tracker)
            if step.answer is not None and scan.time_s is None:
                step = step._replace(answer=replace(step.answer, deskewed=no_times))
            yield step
        else:
            sentence = f"no odometry at the stamp of the cloud: {place}"
            yield Step(scan, None, "no_odometry", sentence)


def _step(scan: Scan, place: Place, tracker: Tracker) -> Step:
    try:
        answer = tracker.step(scan.stamp_ns, scan.points, place, scan.time_s)
    except Cello3dError as error:
        return Step(scan, None, error.reason, str(error))
    return Step(scan, answer, "" if answer is not None else "reference")


def _why_no_times(recording: Recording, config: NodeConfig) -> str:
    if not config.deskew:
        return "node.deskew is false"
    is_unread = recording.times.startswith(NOT_READ)
    return f"times {recording.times}" if is_unread else "the points carry no times"


def _scans(recording: Recording, config: NodeConfig) -> Iterator[tuple[Scan, Sweep | None]]:
    """Yield each scan and when its first and last point were seen, where that is of use."""
    for scan in recording:
        if scan.time_s is None or not config.deskew or not np.isfinite(scan.time_s).any():
            yield replace(scan, time_s=None), None
            continue
        scan = scan.only(np.isfinite(scan.time_s))
        assert scan.time_s is not None
        yield scan, sweep_of(scan.time_s)


def _place_of(
    scan: Scan, sweep_s: Sweep | None, odometry: PoseTrack | None, config: NodeConfig
) -> Place | PoseError:
    """Return the place of a scan by its own pose, or why it has none."""
    guess = EXTERNAL if config.registration == "external" else ODOMETRY
    if scan.T_odom_sensor is None:
        if odometry is not None and config.guess_without_odometry != CONSTANT_VELOCITY:
            return PoseError("the recording has none there")
        guess = CONSTANT_VELOCITY
    X = se3.pose(config.T_base_sensor[:3], config.T_base_sensor[3:])
    place = Place(scan.T_odom_sensor, X, guess=guess)
    if sweep_s is None or guess != ODOMETRY or odometry is None:
        return place
    if not odometry.covers_sweep(scan.stamp_ns, *sweep_s):
        return place
    return replace(place, motion=odometry.motion(scan.stamp_ns, *sweep_s))


def _places(recording: Recording, config: NodeConfig) -> Iterator[tuple[Scan, Place | PoseError]]:
    """Yield each scan with its place: by a bag's messages as they are, else by the scans' poses.

    They are taken as registrations when ``registration`` is external.  A recording without
    odometry is worked on at constant velocity.
    """
    if config.registration == "external" and not recording.has_odometry:
        raise RecordingError(
            f"{recording.name} has no odometry, and node.registration external needs poses"
        )
    source = PoseSource(
        PoseTrack(config.odometry_gap_s, config.odometry_buffer_s, what="odometry")
    )
    locator = Locator(config, source)
    if not isinstance(recording, BagRecording) or not recording.has_odometry:
        odometry = recording.track() if recording.has_odometry else None
        for scan, sweep_s in _scans(recording, config):
            yield scan, _place_of(scan, sweep_s, odometry, config)
        return
    messages = recording.odometry()
    for scan, sweep_s in _scans(recording, config):
        end_ns = scan.stamp_ns + (0 if sweep_s is None else math.ceil(1e9 * sweep_s[1]))
        while source.poses.newest_ns is None or source.poses.newest_ns < end_ns:
            message = next(messages, None)
            if message is None:
                break
            source.hear(*message, "odom", "", config.max_odometry_speed_m_s)
        try:
            yield scan, locator.place(scan.stamp_ns, "lidar", True, sweep_s)
        except PoseError as error:
            yield scan, error
