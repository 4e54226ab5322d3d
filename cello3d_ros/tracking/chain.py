"""Scans that have been answered, one after the other, and where they are.  Imports no ROS."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from cello3d_ros.clouds.motion import undistorted
from cello3d_ros.clouds.shape import Cloud, filtered, with_shape
from cello3d_ros.config import CloudConfig
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import Chained
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.tracking.guess import Place


@dataclass
class Frame:
    """A filtered scan and where its sensor was.

    T_odom_sensor: (4, 4), in the frame of the odometry, as it says or, without it, as the
    registration made of it; None when there has been no odometry since the chain began.
    sweep: the points (N, 3) and their times (N,), where odometry does not tell the motion within
    the scan: it is undone anew by the velocity that the scan's registration tells.
    """

    stamp_ns: int
    cloud: Cloud
    place: Place
    T_odom_sensor: Array | None
    sweep: tuple[Array, Array] | None = None
    velocity: Array | None = None  # (6,), by which the motion is to be undone

    @functools.cached_property
    def range_m(self) -> float:
        """Median range of its points."""
        return float(np.median(np.linalg.norm(self.cloud.points, axis=1)))

    def shaped(self, config: CloudConfig, n_threads: int) -> Cloud:
        """Return the cloud with its local shape, which is found once, when it is needed."""
        if self.sweep is not None and self.velocity is not None:
            points = undistorted(*self.sweep, Motion.constant(self.velocity))
            rng = np.random.default_rng(self.stamp_ns % 2**63)
            self.cloud = filtered(points, config, rng)
            self.sweep = None
        self.cloud = with_shape(self.cloud, config, n_threads)
        return self.cloud

    def at(self, T_odom_sensor: Array | None) -> Frame:
        """Return the same scan at another place in the frame of the odometry."""
        return replace(self, T_odom_sensor=T_odom_sensor)


@dataclass(frozen=True)
class Link:
    """A scan of a chain and its accumulated pose, with its right covariance."""

    frame: Frame
    pose: Chained

    @classmethod
    def first(cls, frame: Frame, T_predicted: Array) -> Link:
        """Return the start of a chain, where odometry puts it or, without it, as predicted."""
        T = T_predicted if frame.T_odom_sensor is None else frame.T_odom_sensor
        return cls(frame, Chained.start(T))


class Chain:
    """The newest scan of a chain of answered scans, and how the sensor has moved last."""

    def __init__(self) -> None:
        self.newest: Link | None = None
        self.is_at_first = False  # nothing has been registered to its first scan yet
        self.velocity: Array | None = None  # (6,), m/s and rad/s; None before two scans

    def begin(self, link: Link) -> None:
        """Start with a scan."""
        self.add(link)
        self.is_at_first = True

    def add(self, link: Link) -> None:
        """Go on with a scan."""
        stamp_ns = link.frame.stamp_ns
        if self.newest is not None and stamp_ns > self.newest.frame.stamp_ns:
            span_s = 1e-9 * (stamp_ns - self.newest.frame.stamp_ns)
            self.velocity = se3.log(se3.inverse(self.newest.pose.T) @ link.pose.T) / span_s
        self.newest = link
        self.is_at_first = False

    def predicted(self, stamp_ns: int) -> Array:
        """Return the pose ``T_last exp(dt v)`` at constant velocity; identity of none.  (4, 4)."""
        if self.newest is None:
            return np.eye(4)
        if self.velocity is None:
            return self.newest.pose.T
        dt_s = 1e-9 * (stamp_ns - self.newest.frame.stamp_ns)
        return np.asarray(self.newest.pose.T @ se3.exp(dt_s * self.velocity))
