"""What the node does with clouds and odometry, over a recording and without ROS.

Every cloud is worked on, in order, each with the odometry that the node would have waited for;
none is superseded by a newer one.  Imports no ROS.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from cello3d_ros.config import NodeConfig
from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.recordings.bag import BagRecording
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.tracking.guess import CONSTANT_VELOCITY, EXTERNAL, ODOMETRY, Locator, Place
from cello3d_ros.tracking.odometry import PoseSource
from cello3d_ros.tracking.tracker import Answer, Tracker


class Step(NamedTuple):
    """What became of one cloud: an answer, or a reason and a sentence why there is none."""

    scan: Scan
    answer: Answer | None
    reason: str = ""
    sentence: str = ""


def replay(recording: Recording, tracker: Tracker, config: NodeConfig) -> Iterator[Step]:
    """Yield what became of every cloud; the first one's reason is "reference"."""
    for scan, place in _places(recording, config):
        if isinstance(place, Place):
            yield _step(scan, place, tracker)
        else:
            sentence = f"no odometry at the stamp of the cloud: {place}"
            yield Step(scan, None, "no_odometry", sentence)


def _step(scan: Scan, place: Place, tracker: Tracker) -> Step:
    try:
        answer = tracker.step(scan.stamp_ns, scan.points, place)
    except Cello3dError as error:
        return Step(scan, None, error.reason, str(error))
    return Step(scan, answer, "" if answer is not None else "reference")


def _place_of(scan: Scan, has_odometry: bool, config: NodeConfig) -> Place | PoseError:
    """Return the place of a scan by its own pose, or why it has none."""
    guess = EXTERNAL if config.registration == "external" else ODOMETRY
    if scan.T_odom_sensor is None:
        if has_odometry and config.guess_without_odometry != CONSTANT_VELOCITY:
            return PoseError("the recording has none there")
        guess = CONSTANT_VELOCITY
    X = se3.pose(config.T_base_sensor[:3], config.T_base_sensor[3:])
    return Place(scan.T_odom_sensor, X, guess=guess)


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
        for scan in recording:
            yield scan, _place_of(scan, recording.has_odometry, config)
        return
    messages = recording.odometry()
    for scan in recording:
        while source.poses.newest_ns is None or source.poses.newest_ns < scan.stamp_ns:
            message = next(messages, None)
            if message is None:
                break
            source.hear(*message, "odom", "", config.max_odometry_speed_m_s)
        try:
            yield scan, locator.place(scan.stamp_ns, "lidar", is_late=True)
        except PoseError as error:
            yield scan, error
