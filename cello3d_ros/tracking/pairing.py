"""What a scan is registered to: the one before, a keyframe or a map.  Imports no ROS."""

from __future__ import annotations

import numpy as np

from cello3d_ros.config import CloudConfig, PairingConfig
from cello3d_ros.covariance.estimator import Estimate
from cello3d_ros.errors import RegistrationError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import Chained, mahalanobis
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.tracking.chain import Chain, Frame, Link
from cello3d_ros.tracking.guess import ODOMETRY
from cello3d_ros.tracking.map import Map

_MOVED = 3.0  # errors of a well calibrated model reach this once in 10^8 scans


class NoReferenceError(RegistrationError):
    """No reference cloud has come."""

    reason = "no_reference"


class Consecutive:
    """Each scan is registered to the one answered before it that was elsewhere.

    While the sensor stands still, all are registered to one scan: small errors of one sign, which
    ICP makes at rest, then do not add up.
    """

    map_frame = ""  # the frame that answers are in where the reference is a map
    needs_chain = True  # whether a pause or a break of the odometry leaves nothing to register to
    knows_odometry = True  # whether odometry says where the scan is, seen from the reference
    adds_each_step = True  # whether each scan in motion is the next reference

    def __init__(self) -> None:
        self._reference: Link | None = None

    @property
    def next_reference(self) -> Frame | None:
        """The scan that the next one will be registered to, where that is known already."""
        return None if self._reference is None else self._reference.frame

    def begin(self, link: Link | None) -> None:
        """Start a chain with a scan, or forget the one there is."""
        self._reference = link

    def reference(
        self, frame: Frame, chain: Chain, config: PairingConfig, clouds: CloudConfig
    ) -> Link | None:
        """Return what a scan is registered to; None: it starts a chain."""
        return self._reference

    def accept(self, link: Link, found: Estimate, config: PairingConfig) -> None:
        """Note an answered scan; one that has moved is the next reference."""
        if has_moved(found) or self._is_far(found, config):
            self._reference = link

    def fail(self, chain: Chain) -> None:
        """Note a scan that did not fit."""
        self._reference = chain.newest

    def _is_far(self, found: Estimate, config: PairingConfig) -> bool:
        return self._reference is None or makes_keyframe(found, self._reference.frame, config)


class Keyframe(Consecutive):
    """Each scan is registered to a keyframe, until it is far from it or did not fit it."""

    adds_each_step = False

    def accept(self, link: Link, found: Estimate, config: PairingConfig) -> None:
        """Note an answered scan; one far enough from the keyframe is the next keyframe."""
        if self._is_far(found, config):
            self._reference = link


class ToMap(Consecutive):
    """Each scan is registered to the part of a map around it.

    Where the odometry is in the map is said by /tf or else by the last answer; until there is
    one, the two are taken to coincide.
    """

    needs_chain = False

    def __init__(self) -> None:
        super().__init__()
        self.knows_odometry = False
        self._map: Map | None = None
        self._T_map_odom: Array = np.eye(4)

    @property
    def map_frame(self) -> str:  # type: ignore[override]
        """The frame of the map."""
        return "" if self._map is None else self._map.frame_id

    def take(self, new: Map) -> bool:
        """Take another map; return whether its frame is another, too.  One like it is ignored."""
        is_other = self._map is None or self._map.frame_id != new.frame_id
        if is_other or self._map is None or not self._map.is_same(new):
            self._map = new
        return is_other

    def begin(self, link: Link | None) -> None:
        """Forget where the odometry is in the map."""
        self._T_map_odom, self.knows_odometry = np.eye(4), False

    def reference(
        self, frame: Frame, chain: Chain, config: PairingConfig, clouds: CloudConfig
    ) -> Link | None:
        """Return the part of the map around the first guess of the sensor."""
        if self._map is None:
            raise NoReferenceError("no cloud has been received on reference_points")
        given = frame.place.T_map_odom
        T_map_odom = self._T_map_odom if given is None else given
        self.knows_odometry |= given is not None
        if frame.T_odom_sensor is None:
            T_map_sensor = chain.predicted(frame.stamp_ns)
        else:
            T_map_sensor = T_map_odom @ frame.T_odom_sensor
        cloud, T_map_crop = self._map.around(T_map_sensor[:3, 3], config, clouds)
        T_odom_crop = se3.inverse(T_map_odom) @ T_map_crop
        crop = Frame(self._map.stamp_ns, cloud, frame.place, T_odom_crop)
        return Link(crop, Chained.start(T_map_crop))

    def accept(self, link: Link, found: Estimate, config: PairingConfig) -> None:
        """Note where an answered scan puts the odometry in the map."""
        place = link.frame.place
        if place.guess == ODOMETRY and place.T_odom_sensor is not None:
            self._T_map_odom = link.pose.T @ se3.inverse(place.T_odom_sensor)
            self.knows_odometry = True

    def fail(self, chain: Chain) -> None:
        """The map stays."""


#: Policies by ``node.pairing``.
PAIRINGS = {"consecutive": Consecutive, "keyframe": Keyframe, "topics": ToMap}


def has_moved(found: Estimate) -> bool:
    """Return whether a scan is farther from its reference than errors explain.

    That is ``_MOVED`` standard deviations along each of six axes, as one number.
    """
    distance = mahalanobis(se3.log(found.T_ref_read), found.covariance)
    return bool(distance > _MOVED * np.sqrt(6.0))


def makes_keyframe(found: Estimate, reference: Frame, config: PairingConfig) -> bool:
    """Return whether a registered scan is far enough from its reference to be the next one.

    Distance is relative to the median range of the reference's points: it scales with the scene.
    """
    way_m = np.linalg.norm(found.T_ref_read[:3, 3])
    angle_rad = np.linalg.norm(se3.log(found.T_ref_read)[3:])
    return bool(
        way_m > config.keyframe_distance_ratio * reference.range_m
        or angle_rad > config.keyframe_angle_rad
        or found.overlap_ratio < config.keyframe_min_overlap
    )
