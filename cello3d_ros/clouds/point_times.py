"""Per-point times under the many names and units that lidar drivers use."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.geometry.se3 import Array

NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp", "time_in_sec")
INTENSITIES = ("intensity", "intensities", "reflectivity")

_NS_PER = (1, 1_000, 1_000_000_000)  # units tried: ns, us, s
_NEAR_NS = 60 * 10**9  # an absolute time is this near the stamp of its scan
_EARLIEST_NS = 1000 * 10**9  # before this, absolute and relative look alike


class TimeLaw(NamedTuple):
    """How a time field is to be read: its unit, and whether it counts from the scan's stamp."""

    ns_per_unit: int
    absolute: bool


def recognise(values: NDArray[Any], stamp_ns: int) -> TimeLaw | None:
    """Return the law of a scan's times, or None where they cannot be told.

    Floats up to 100 in size are seconds after the stamp.  Else times are absolute, if in ns, us
    or s their median is within a minute of the stamp.  Else they are relative: nanoseconds from
    3e6 on (a scan of 3 ms), microseconds from 3e3 to 3e6 (a scan of up to 3 s).
    """
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return None
    largest = float(np.abs(known.astype(np.float64)).max())
    if values.dtype.kind == "f" and largest <= 100.0:
        return TimeLaw(1_000_000_000, absolute=False)
    middle = float(np.median(known))
    for unit in _NS_PER:
        if abs(middle * unit - stamp_ns) < _NEAR_NS and stamp_ns > _EARLIEST_NS:
            return TimeLaw(unit, absolute=True)
    if 3e6 <= largest < 1e11:
        return TimeLaw(1, absolute=False)
    return TimeLaw(1_000, absolute=False) if 3e3 <= largest < 3e6 else None


def relative_s(values: NDArray[Any], law: TimeLaw, stamp_ns: int) -> Array:
    """Return the times (N,) in seconds after the stamp, without losing digits of large ones."""
    per_second = 1_000_000_000 // law.ns_per_unit
    if not law.absolute:
        return np.asarray(values.astype(np.float64) / per_second)
    whole, rest_ns = divmod(stamp_ns, law.ns_per_unit)
    if values.dtype.kind in "iu":
        since = (values.astype(np.int64) - whole).astype(np.float64)
    else:
        since = values.astype(np.float64) - float(whole)
    return np.asarray(since / per_second - 1e-9 * rest_ns)
