"""Livox's CustomMsg to points, as livox_ros_driver and livox_ros_driver2 publish it.

Works on any object with the fields of the message, so that nothing here imports ROS.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

TYPES = ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg")
TIME = "offset_time"  # nanoseconds after the message's stamp

#: Definition of the message for bags that do not bring it; after Livox's driver, ROS 2 names.
DEFINITION = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
{package}/CustomPoint[] points
================================================================================
MSG: {package}/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""

_COLUMNS = {"x": "<f4", "y": "<f4", "z": "<f4", "reflectivity": "u1", TIME: "<u4"}


def read_livox(message: Any) -> dict[str, NDArray[Any]]:
    """Return x, y, z (metres), reflectivity and offset_time (ns), each (N,).

    Points that are not finite, or at the sensor's origin as those without a return, are left out.
    """
    points = message.points
    found = {
        name: np.array([getattr(point, name) for point in points], dtype=kind)
        for name, kind in _COLUMNS.items()
    }
    xyz = np.stack([found[axis] for axis in "xyz"])
    kept = np.isfinite(xyz).all(axis=0) & xyz.any(axis=0)
    return {name: values[kept] for name, values in found.items()}
