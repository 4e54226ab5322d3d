"""Per-point times under the many names, units and clocks that lidar drivers use."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.errors import CloudError, ConfigError
from cello3d_ros.geometry.se3 import Array

NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp", "time_in_sec")
N_FIRST = 10  # clouds from which it is seen how times are to be read
INTENSITIES = ("intensity", "intensities", "reflectivity")
UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

STAMP, EPOCH, FIRST = "stamp", "epoch", "first"  # what times count from

_EARLIEST_NS = 1000 * 10**9  # before this, clocks and times after the stamp look alike,
_NEAR_NS = 60 * 10**9  # later a clock this near the stamps tells its unit
_MAX_SPAN_S = 100.0  # of a scan, where the time between clouds is not known,
_MAX_SCAN_S = 10.0  # and where it is
_MOST = 1.5  # times the time between clouds is the most that a scan spans
_WHOLE = (0.2, 1.2)  # and what the scan of a lidar that turns all the time spans
_UNKNOWN_PERIOD_S = 1.0  # the time between clouds of which only one has come is at most about this
_SHORTEST_S = 0.1  # a scan is at least so long when clocks are compared


class PointTimesError(CloudError):
    """The times of points cannot be read; the text says why."""


@dataclass(frozen=True, kw_only=True)
class Clock:
    """What a user knows of the times in a recording; by default all is found in the data.

    field: name of the points' times.  unit: theirs, of UNITS.  cloud_offset_s: added to the stamps
    of the clouds, so that they are on the clock of the poses.
    """

    field: str | None = None
    unit: str | None = None
    cloud_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if self.unit is not None and self.unit not in UNITS:
            raise ConfigError(f"a unit of time is one of {', '.join(UNITS)}, not {self.unit!r}")
        if not abs(self.cloud_offset_s) < 1e10:
            raise ConfigError(f"an offset of time must be finite: {self.cloud_offset_s}")

    @property
    def is_given(self) -> bool:
        """Whether a user has said how the times of points are read."""
        return self.field is not None or self.unit is not None

    @property
    def offset_ns(self) -> int:
        """The offset of the clouds' stamps in nanoseconds."""
        return round(self.cloud_offset_s * 1e9)

    def column(self, names: Iterable[str]) -> str | None:
        """Return which of some names is that of the times, None if none is.

        Raises PointTimesError where the field that was asked for is missing.
        """
        present = {name.lower(): name for name in names}
        if self.field is None:
            return next((present[name] for name in NAMES if name in present), None)
        if self.field.lower() not in present:
            raise PointTimesError(
                f"the points have no field {self.field!r}; they have {', '.join(present)}"
            )
        return present[self.field.lower()]


class TimeLaw(NamedTuple):
    """How times are to be read.

    origin: STAMP, relative to the scan's stamp; EPOCH, on the clock of the stamps; FIRST, on
    another clock: relative to the scan's first point, which is taken to be at the stamp.
    reach_s: a time farther from the middle of its scan is damaged.
    """

    ns_per_unit: int
    origin: str = STAMP
    reach_s: float = _MAX_SPAN_S

    @property
    def sentence(self) -> str:
        """The law in words."""
        unit = next(name for name, ns in UNITS.items() if ns == self.ns_per_unit)
        origins = {
            STAMP: "after the stamp of the cloud",
            EPOCH: "on the clock of the stamps",
            FIRST: "after the first point of the cloud: their clock is not that of the stamps",
        }
        return f"in {unit} {origins[self.origin]}"


def law_of(
    scans: Iterable[tuple[NDArray[Any] | None, int]], unit: str | None = None
) -> TimeLaw | None:
    """Return the law of a recording from the times and stamps of its first clouds.

    The last of them decides: near the start of a clock at 0 relative and absolute look alike.
    Returns None where no cloud has times.  Raises PointTimesError where they fit no law.
    """
    scans = list(scans)
    steps = np.diff([stamp_ns for _, stamp_ns in scans])
    period_s = 1e-9 * float(np.median(steps[steps > 0])) if (steps > 0).any() else None
    problem: PointTimesError | None = None
    for values, stamp_ns in reversed(scans):
        if values is None or len(values) == 0:
            continue
        try:
            return recognise(values, stamp_ns, period_s, unit)
        except PointTimesError as error:
            problem = problem or error
    if problem is not None:
        raise problem
    return None


def recognise(
    values: NDArray[Any], stamp_ns: int, period_s: float | None = None, unit: str | None = None
) -> TimeLaw:
    """Return the law of one scan's times.  Raises PointTimesError where they fit none.

    values: (N,).  period_s: the time between clouds, if known.  unit: of UNITS, if known.

    The unit: that in which they are on the clock of the stamps, to a minute; else seconds for
    floats that then span at most 1.5 periods; else that in which they span 0.2 to 1.2 periods;
    else for whole numbers nanoseconds from a span of 3e6 on, microseconds from 3e3.
    The origin: the stamp where the times are within two scans of it, then the clock of the
    stamps where they are within two scans of that, else the first point.
    """
    base, middle, span = _extent(values)

    def after_stamp_ns(ns: int) -> float:
        return _exact_ns(base, ns, stamp_ns) + ns * middle

    if unit is not None:
        candidates = [UNITS[unit]]
    else:
        near = [n for n in UNITS.values() if abs(after_stamp_ns(n)) < _NEAR_NS]
        candidates = near if stamp_ns > _EARLIEST_NS else []
        candidates = candidates or _units(span, values.dtype.kind == "f", period_s)
    if not candidates or 1e-9 * candidates[0] * span > _longest_s(period_s):
        raise PointTimesError(
            f"the times of the points span {span:g}, no scan in any unit"
            + ("" if period_s is None else f" when clouds are {period_s:.3g} s apart")
            + "; name their unit (--time-unit) or another field (--time-field)"
        )
    ns = candidates[0]
    reach_s = 2.0 * max(period_s or 0.0, 1e-9 * ns * span, _SHORTEST_S)
    if abs(1e-9 * ns * (float(base) + middle)) <= reach_s:
        return TimeLaw(ns, STAMP, reach_s)
    return TimeLaw(ns, EPOCH if abs(1e-9 * after_stamp_ns(ns)) <= reach_s else FIRST, reach_s)


class TimesOfClouds:
    """Reads the times of clouds as they come, by the law of a recording that begins with them.

    The law of each of the first ten clouds is that of the clouds so far; then it stays.
    """

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._law: TimeLaw | None = None
        self._kind: Any = None

    def read(self, values: NDArray[Any], stamp_ns: int) -> Array:
        """Return the times (N,) of the next cloud, as ``relative_s``.

        Raises PointTimesError where they fit no law; the next cloud is looked at afresh.
        """
        if self._kind != values.dtype or (self._stamps and stamp_ns < self._stamps[-1]):
            self._stamps, self._law, self._kind = [], None, values.dtype
        if self._law is None:
            self._stamps = [*self._stamps, stamp_ns][-N_FIRST:]
            steps = np.diff(self._stamps)
            steps = steps[steps > 0]
            period_s = 1e-9 * float(np.median(steps)) if len(steps) else _UNKNOWN_PERIOD_S
            law = recognise(values, stamp_ns, period_s)
            if len(self._stamps) < N_FIRST:
                return relative_s(values, law, stamp_ns)
            self._law = law
        return relative_s(values, self._law, stamp_ns)


def relative_s(values: NDArray[Any], law: TimeLaw, stamp_ns: int) -> Array:
    """Return the times (N,) in seconds after the stamp, without losing digits of large ones.

    A time farther from the middle of its scan than the law's reach is NaN: it is damaged.
    """
    signed = _signed(values)
    per_second = 1_000_000_000 // law.ns_per_unit
    if law.origin == STAMP:
        time_s = signed.astype(np.float64) / per_second
    elif law.origin == EPOCH:
        whole, rest_ns = divmod(stamp_ns, law.ns_per_unit)
        time_s = (signed - whole).astype(np.float64) / per_second - 1e-9 * rest_ns
    else:
        finite = signed[np.isfinite(signed)]
        time_s = (signed - (finite[0] if len(finite) else 0)).astype(np.float64) / per_second
    is_known = np.isfinite(time_s)
    if not is_known.any():
        return time_s
    middle = np.median(time_s[is_known])
    with np.errstate(invalid="ignore"):
        time_s[~(np.abs(time_s - middle) <= law.reach_s)] = np.nan
    return time_s - np.nanmin(time_s) if law.origin == FIRST else time_s


def _extent(values: NDArray[Any]) -> tuple[Any, float, float]:
    """Return the first time, how long after it the middle is, and the span of 99 % of all.

    Raises PointTimesError where there is no span.
    """
    known = _signed(values)
    known = known[np.isfinite(known)]
    if len(known) == 0:
        raise PointTimesError("no point has a finite time")
    low, middle, high = np.quantile((known - known[0]).astype(np.float64), [0.005, 0.5, 0.995])
    if low == high:
        raise PointTimesError("all points of a cloud have the same time")
    return known[0], float(middle), float(high - low)


def _signed(values: NDArray[Any]) -> NDArray[Any]:
    """Return times as int64 or float64; a counter that wraps below 0 is continued there."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    if values.dtype.kind == "u" and len(values):
        signed = values.view(f"{values.dtype.byteorder}i{values.dtype.itemsize}")
        if np.ptp(signed.astype(np.float64)) < np.ptp(values.astype(np.float64)):
            return signed.astype(np.int64)
    return values.astype(np.int64)


def _exact_ns(time: Any, ns_per_unit: int, stamp_ns: int) -> float:
    """Return how many ns a time on the clock of the stamps is after a stamp."""
    whole, rest_ns = divmod(stamp_ns, ns_per_unit)
    return float(time - whole) * ns_per_unit - rest_ns


def _longest_s(period_s: float | None) -> float:
    return _MAX_SPAN_S if period_s is None else min(_MOST * period_s, _MAX_SCAN_S)


def _units(span: float, is_float: bool, period_s: float | None) -> list[int]:
    """Return the units in ns that a span may have, the likeliest first."""
    found = [UNITS["s"]] if is_float and span <= _longest_s(period_s) else []
    if period_s is not None:
        low, high = (1e9 * share * period_s for share in _WHOLE)
        found += [UNITS[name] for name in ("ns", "us", "ms") if low <= span * UNITS[name] <= high]
    if period_s is None or not is_float:
        found += [UNITS["ns"]] if 3e6 <= span < 1e11 else []
        found += [UNITS["us"]] if 3e3 <= span < 3e6 else []
    return found
