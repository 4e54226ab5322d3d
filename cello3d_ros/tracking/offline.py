"""What the node does with clouds and odometry, over a recording and without ROS.

Every cloud is worked on, in order, each with the odometry that the node would have waited for;
none is superseded by a newer one.  Imports no ROS.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from cello3d_ros.config import NodeConfig
from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.recordings.bag import BagRecording
from cello3d_ros.recordings.odometry import with_odometry
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.tracking.guess import EXTERNAL, ODOMETRY, Locator, Place
from cello3d_ros.tracking.odometry import PoseSource
from cello3d_ros.tracking.tracker import Answer, Tracker


class Step(NamedTuple):
    """What became of one cloud: an answer, or a reason and a sentence why there is none."""

    scan: Scan
    answer: Answer | None
    reason: str = ""
    sentence: str = ""


def replay(recording: Recording, tracker: Tracker, config: NodeConfig) -> Iterator[Step]:
    """Yield the fate of every cloud; the first one's reason is "reference"."""
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


def _places(recording: Recording, config: NodeConfig) -> Iterator[tuple[Scan, Place | PoseError]]:
    """Yield each scan with its place: by a bag's messages as they are, else made of the poses.

    They are taken as registrations when ``registration`` is external.
    """
    source = PoseSource(
        PoseTrack(config.odometry_gap_s, config.odometry_buffer_s, what="odometry")
    )
    locator = Locator(config, source)
    if not isinstance(recording, BagRecording) or recording.topics.odometry is None:
        guess = EXTERNAL if config.registration == "external" else ODOMETRY
        X = se3.pose(config.T_base_sensor[:3], config.T_base_sensor[3:])
        for scan in with_odometry(recording):
            yield scan, Place(scan.T_odom_sensor, X, guess=guess)
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
