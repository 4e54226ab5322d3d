"""Where the sensor is when it takes a cloud: the first guess of a registration.  No ROS."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cello3d_ros.config import InputConfig
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import to_left
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.pose_track import PoseError, PoseNotYetError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.geometry.transforms import TransformTree, UnknownFrameError
from cello3d_ros.tracking.odometry import PoseSource

ODOMETRY, EXTRAPOLATED, CONSTANT_VELOCITY = "odometry", "extrapolated", "constant_velocity"
EXTERNAL = "external"


_SAME = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_FIXED_FRAMES = {"map", "odom", "earth", "world"}  # REP 105, and what simulators call it


class FixedFrameError(PoseError):
    """Clouds are in a frame that does not move with the sensor."""

    reason = "fixed_frame"


def _identity() -> Array:
    return np.eye(4)


@dataclass(frozen=True)
class Place:
    """Where the sensor is at the stamp of a cloud, in which frames and who says so.

    T_odom_sensor: (4, 4), None when nobody says it; Y_odom: (6, 6), its right covariance, None
    when odometry gives none.  T_base_sensor: (4, 4).  T_map_odom: (4, 4), where the frame of the
    odometry is in that of the reference cloud; None when only answers can tell.  guess: ODOMETRY,
    EXTRAPOLATED, CONSTANT_VELOCITY or EXTERNAL.  epoch: as in PoseSource.  motion: of the sensor
    while it took the cloud, None when odometry does not tell it.
    """

    T_odom_sensor: Array | None
    T_base_sensor: Array = field(default_factory=_identity)
    T_map_odom: Array | None = None
    guess: str = ODOMETRY
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    sensor_frame: str = "lidar"
    epoch: int = 1
    Y_odom: Array | None = None
    motion: Motion | None = None


class Locator:
    """Says where the sensor is, from odometry or the external registration and the extrinsic."""

    def __init__(
        self,
        config: InputConfig,
        source: PoseSource,
        transforms: TransformTree | None = None,
        extrinsic_is_given: bool = False,
    ) -> None:
        """source: odometry or external poses.  transforms: /tf, or None for T_base_sensor.

        extrinsic_is_given: whether somebody has said T_base_sensor, be it the identity.
        """
        self.config = config
        self.source = source
        self.transforms = transforms
        self.map_frame = ""  # of the reference cloud, once there is one
        self.warning = ""  # what seems wrong with the frames, in a sentence
        self._extrinsic_is_given = extrinsic_is_given

    def place(
        self,
        stamp_ns: int,
        sensor_frame: str,
        is_late: bool,
        sweep_s: tuple[float, float] | None = None,
    ) -> Place:
        """Return where the sensor is at a stamp.

        sweep_s: when the first and the last point of the cloud were seen, after the stamp; None
        where nobody asks for the motion meanwhile.  is_late: the cloud has waited long enough;
        what comes later is of no use.  Raises PoseNotYetError when waiting may help and
        PoseMissingError when it will not.
        """
        T_odom_base, guess = self._base(stamp_ns, is_late)
        odom_frame = self.source.frame_id or "odom"
        base_frame = self.source.child_frame_id or self.config.base_frame
        self._check_frames(sensor_frame, base_frame, odom_frame)
        T_base_sensor = self._extrinsic(stamp_ns, base_frame, sensor_frame)
        is_odometry = guess == ODOMETRY
        Y = self.source.covariance(stamp_ns) if is_odometry else None
        motion = self._motion(stamp_ns, sweep_s, is_late) if is_odometry and sweep_s else None
        return Place(
            T_odom_sensor=None if T_odom_base is None else T_odom_base @ T_base_sensor,
            T_base_sensor=T_base_sensor,
            T_map_odom=self._map(stamp_ns, odom_frame),
            guess=guess,
            odom_frame=odom_frame,
            base_frame=base_frame,
            sensor_frame=sensor_frame,
            epoch=self.source.epoch,
            Y_odom=None if Y is None else to_left(se3.inverse(T_base_sensor), Y),
            motion=None if motion is None else motion.of_sensor(T_base_sensor),
        )

    def _motion(self, stamp_ns: int, sweep_s: tuple[float, float], is_late: bool) -> Motion | None:
        """Return the motion of the base during a sweep, None where there is a gap.

        Raises PoseNotYetError when waiting may help.
        """
        poses = self.source.poses
        if poses.covers_sweep(stamp_ns, *sweep_s):
            return poses.motion(stamp_ns, *sweep_s)
        end_ns = stamp_ns + int(1e9 * sweep_s[1])
        if not is_late and poses.newest_ns is not None and poses.newest_ns <= end_ns:
            raise PoseNotYetError(f"the newest {poses.what} is older than the last point")
        return None

    def _check_frames(self, sensor_frame: str, base_frame: str, odom_frame: str) -> None:
        """Raise FixedFrameError for clouds that are not in a frame of the sensor, or warn."""
        frame, base, odom = (name.strip("/") for name in (sensor_frame, base_frame, odom_frame))
        fixed = {odom, self.map_frame.strip("/"), *_FIXED_FRAMES} - {""}
        through_odom = self.transforms is not None and self.transforms.leads_through(
            base, frame, odom
        )
        if frame != base and (frame in fixed or through_odom):
            raise FixedFrameError(
                f"the clouds are in {sensor_frame!r}, which does not move with the sensor: "
                "registration needs them as the sensor saw them, in its own frame"
            )
        self.warning = ""
        if self.transforms is not None or self._extrinsic_is_given or not self.source.epoch:
            return
        names_no_child = not self.source.child_frame_id
        if self.config.registration == "external" and names_no_child:
            return
        if not frame:
            self.warning = (
                "the clouds name no frame_id: they are taken as seen from "
                f"T_base_sensor in {base_frame!r}"
            )
        elif frame != base and self.config.T_base_sensor == _SAME:
            self.warning = (
                f"the clouds are in {sensor_frame!r} and the odometry is of {base_frame!r}, but "
                "T_base_sensor is the identity: set node.T_base_sensor, or node.use_tf to take "
                "it from /tf"
            )

    def _base(self, stamp_ns: int, is_late: bool) -> tuple[Array | None, str]:
        config, poses = self.config, self.source.poses
        if (sentence := self.source.rejection) and config.guess_without_odometry == "skip":
            raise PoseNotYetError(sentence)
        if config.registration == "external":
            return poses.nearest(stamp_ns, config.external_tolerance_s), EXTERNAL
        policy = config.guess_without_odometry
        try:
            return poses.pose(stamp_ns), ODOMETRY
        except PoseError as error:
            may_come = isinstance(error, PoseNotYetError) and not is_late
            if policy == "skip" or may_come:
                raise
        if policy == "extrapolate":
            return poses.extrapolated(stamp_ns, config.max_extrapolation_s), EXTRAPOLATED
        return None, CONSTANT_VELOCITY

    def _extrinsic(self, stamp_ns: int, base_frame: str, sensor_frame: str) -> Array:
        if self.transforms is not None:
            return self.transforms.at(base_frame, sensor_frame, stamp_ns)
        return se3.pose(self.config.T_base_sensor[:3], self.config.T_base_sensor[3:])

    def _map(self, stamp_ns: int, odom_frame: str) -> Array | None:
        if not self.map_frame:
            return None
        if self.config.registration == "external" and odom_frame != self.map_frame:
            raise UnknownFrameError(
                f"the {self.source.poses.what} is in {odom_frame!r} but the reference cloud in "
                f"{self.map_frame!r}"
            )
        if odom_frame == self.map_frame or self.transforms is None:
            return None
        return self.transforms.at(self.map_frame, odom_frame, stamp_ns)
