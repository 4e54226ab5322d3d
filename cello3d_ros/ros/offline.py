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
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.recordings.bag import BagRecording
from cello3d_ros.recordings.odometry import with_odometry
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.ros.odometry import OdometryBuffer, OdometryError
from cello3d_ros.ros.tracker import Answer, Tracker, reason_of


class Step(NamedTuple):
    """What became of one cloud: an answer, or a reason and a sentence why there is none."""

    scan: Scan
    answer: Answer | None
    reason: str = ""
    sentence: str = ""


def replay(recording: Recording, tracker: Tracker, config: NodeConfig) -> Iterator[Step]:
    """Yield the fate of every cloud; the first one's reason is "reference"."""
    T_base_sensor = se3.pose(config.T_base_sensor[:3], config.T_base_sensor[3:])
    for scan, T_odom_base in _with_odometry(recording, config):
        if not isinstance(T_odom_base, OdometryError):
            yield _step(scan, T_odom_base @ T_base_sensor, tracker)
        else:
            sentence = f"no odometry at the stamp of the cloud: {T_odom_base}"
            yield Step(scan, None, "no_odometry", sentence)


def _step(scan: Scan, T_odom_sensor: Array, tracker: Tracker) -> Step:
    try:
        answer = tracker.step(scan.stamp_ns, scan.points, T_odom_sensor)
    except Cello3dError as error:
        return Step(scan, None, reason_of(error), str(error))
    return Step(scan, answer, "" if answer is not None else "reference")


def _with_odometry(
    recording: Recording, config: NodeConfig
) -> Iterator[tuple[Scan, Array | OdometryError]]:
    """Yield each scan with its odometry: a bag's messages as they are, else made of the poses."""
    if not isinstance(recording, BagRecording) or recording.topics.odometry is None:
        for scan in with_odometry(recording):
            assert scan.T_odom_sensor is not None
            yield scan, scan.T_odom_sensor
        return
    messages = recording.odometry()
    buffer = OdometryBuffer(config.odometry_buffer_s, config.odometry_gap_s)
    for scan in recording:
        while buffer.newest_ns is None or buffer.newest_ns < scan.stamp_ns:
            message = next(messages, None)
            if message is None:
                break
            buffer.add(*message)
        try:
            yield scan, buffer.at(scan.stamp_ns)
        except OdometryError as error:
            yield scan, error
