"""PointCloud2-like messages to points.

Works on any object with the fields of sensor_msgs/PointCloud2 (rclpy's, rosbags' or a test's), so
that nothing here imports ROS.  Nothing that a message says of itself is trusted: not ``is_dense``,
not its sizes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.errors import CloudError
from cello3d_ros.geometry.se3 import Array

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_POINT_STEP = 2**20  # bytes of one point


def read_points(message: Any) -> Array:
    """Return the finite points of a PointCloud2-like message.

    Returns (N, 3) float64, metres, in the message's frame, in memory of its own.
    Raises CloudError when the message contradicts itself or has no float x, y, z.
    """
    fields = read_fields(message, ("x", "y", "z"))
    return np.stack([fields["x"], fields["y"], fields["z"]], axis=1).astype(np.float64)


def read_fields(message: Any, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return fields of a PointCloud2-like message, each (N,), without the rows of no position.

    A row whose x, y or z is NaN or infinite is dropped from every field, so that companions such
    as intensity stay aligned.  Raises CloudError, as ``read_points`` does.
    """
    dtype = _record_type(message, {"x", "y", "z", *names})
    for axis in "xyz":
        if dtype[axis].kind != "f":
            raise CloudError(f"PointCloud2 field {axis!r} is {dtype[axis]}, expected a float")
    records = _records(message, dtype)
    finite = np.isfinite(records["x"]) & np.isfinite(records["y"]) & np.isfinite(records["z"])
    kept = records if finite.all() else records[finite]
    return {name: kept[name].astype(dtype[name].newbyteorder("=")) for name in names}


def _record_type(message: Any, names: set[str]) -> np.dtype[Any]:
    """Return the structured type of one point, restricted to ``names``."""
    if not 0 <= message.point_step <= _MAX_POINT_STEP:
        raise CloudError(f"PointCloud2 point_step {message.point_step} is absurd")
    fields = {field.name: field for field in reversed(message.fields)}
    if missing := sorted(names - set(fields)):
        raise CloudError(
            f"PointCloud2 has no field {missing[0]!r}; it has {', '.join(fields) or 'none'}"
        )
    order = ">" if message.is_bigendian else "<"
    formats, offsets = [], []
    for name in sorted(names):
        field = fields[name]
        if field.datatype not in _TYPES:
            raise CloudError(f"PointCloud2 field {name!r} has unknown datatype {field.datatype}")
        item = np.dtype(order + _TYPES[field.datatype])
        if field.offset < 0 or field.offset + item.itemsize > message.point_step:
            raise CloudError(
                f"PointCloud2 field {name!r} ends at byte {field.offset + item.itemsize}, "
                f"beyond point_step {message.point_step}"
            )
        formats.append(item)
        offsets.append(int(field.offset))
    return np.dtype(
        {
            "names": sorted(names),
            "formats": formats,
            "offsets": offsets,
            "itemsize": int(message.point_step),
        }
    )


def _records(message: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the (height * width,) records of the message's bytes, padding left out."""
    width, height = int(message.width), int(message.height)
    row, row_step = width * dtype.itemsize, int(message.row_step)
    if width == 0 or height == 0:
        return np.empty(0, dtype)
    data = np.frombuffer(message.data, dtype=np.uint8)
    if height == 1 or row_step == 0 or data.size == height * row:
        row_step = row  # some drivers leave it unset or that of another cloud
    if row_step < row:
        raise CloudError(f"PointCloud2 row_step {row_step} is less than width*point_step {row}")
    declared = (height - 1) * row_step + row
    if data.size < declared:
        raise CloudError(f"PointCloud2 declares {declared} bytes but holds {data.size}")
    if row_step == row:
        return data[:declared].view(dtype)
    last = (height - 1) * row_step  # the last row may come without its padding
    rows = data[:last].reshape(height - 1, row_step)[:, :row]
    return np.concatenate([rows.reshape(-1), data[last:declared]]).view(dtype)
