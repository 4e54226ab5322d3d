"""Scanners by name: patterns for trials, and scanners as they are sold.

Elevations, fields of view, steps of azimuth, ranges and noise are those of the makers' manuals.
Where a manual gives the range at 10 percent reflectance it is ``reach_m``; noise that grows with
range and the width of a beam are typical of the kind, as manuals seldom say them.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from cello3d_ros.simulation.scanner import Scanner

_SOLD = Scanner(  # what differs from this is said below
    azimuth_step_deg=0.2,
    max_range_m=100.0,
    range_noise_m=0.015,
    range_noise_per_m=0.0003,
    missing_share=0.01,
    grazing_deg=88.0,
    reach_m=60.0,
    divergence_deg=0.15,
)


def _even(first: float, last: float, n: int) -> tuple[float, ...]:
    return tuple(np.linspace(first, last, n).round(4).tolist())


_VLP32C = (
    *(-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333),
    *(-3.0, -2.667, -2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0),
    *(1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0),
)
_VLS128 = (
    *(-25.0, -19.582, -16.042, -13.565, -11.742, -10.346, -9.244, -8.352, -7.65, -7.15, -6.85),
    *(-6.65, *_even(-6.5, 4.83, 104), 4.98, 5.18, 5.43, 5.73, 6.08, 6.48, 6.98, 7.58, 8.43, 9.7),
    *(11.75, 15.0),
)
_PANDAR40P = (
    *(-25.0, -19.0, *_even(-14.0, -7.0, 8)),
    *(*_even(-6.0, 2.0, 25), 3.0, 5.0, 8.0, 11.0, 15.0),
)
_HDL64E = (*_even(-24.33, -8.83, 32), *_even(-8.33, 2.0, 32))
_OUSTER = replace(_SOLD, n_columns=1024, azimuth_step_deg=0.3515625, divergence_deg=0.1)

SCANNERS = MappingProxyType(
    {
        "spinning16": Scanner(
            n_beams=16, min_elevation_deg=-15, max_elevation_deg=15, azimuth_step_deg=0.4
        ),
        "spinning32": Scanner(),
        "spinning64": Scanner(
            n_beams=64, min_elevation_deg=-22.5, max_elevation_deg=22.5, azimuth_step_deg=0.36
        ),
        "wide": Scanner(
            n_beams=90, min_elevation_deg=-50, max_elevation_deg=85, azimuth_step_deg=1.2
        ),
        "tilting_hokuyo": Scanner(  # UTM-30LX on a tilting unit, thinned to a quarter
            pattern="tilting",
            n_beams=172,
            min_elevation_deg=-60,
            max_elevation_deg=60,
            azimuth_step_deg=0.5,
            azimuth_span_deg=270,
            sweep_s=4.3,
            min_range_m=0.1,
        ),
        "narrow": Scanner(  # the field of view of a Livox Avia
            n_beams=110,
            min_elevation_deg=-38.6,
            max_elevation_deg=38.6,
            azimuth_step_deg=0.7,
            azimuth_span_deg=70.4,
            max_range_m=100.0,
            range_noise_m=0.02,
        ),
        "vlp16": replace(_SOLD, elevations_deg=_even(-15, 15, 16), reach_m=50.0),
        "vlp32c": replace(_SOLD, elevations_deg=_VLP32C, max_range_m=200.0, reach_m=100.0),
        "hdl32e": replace(_SOLD, elevations_deg=_even(-30.67, 10.67, 32), azimuth_step_deg=0.16),
        "hdl64e": replace(_SOLD, elevations_deg=_HDL64E, azimuth_step_deg=0.17, max_range_m=120.0),
        "vls128": replace(_SOLD, elevations_deg=_VLS128, max_range_m=200.0, reach_m=150.0),
        "os0_128": replace(
            _OUSTER, elevations_deg=_even(-45, 45, 128), max_range_m=75.0, reach_m=35.0
        ),
        "os1_64": replace(
            _OUSTER, elevations_deg=_even(-22.5, 22.5, 64), max_range_m=170.0, reach_m=90.0
        ),
        "os2_128": replace(
            _OUSTER, elevations_deg=_even(-11.25, 11.25, 128), max_range_m=200.0, reach_m=200.0
        ),
        "xt32": replace(
            _SOLD, elevations_deg=_even(-16, 15, 32), azimuth_step_deg=0.18,
            max_range_m=120.0, range_noise_m=0.005, reach_m=80.0,
        ),
        "pandar40p": replace(
            _SOLD, elevations_deg=_PANDAR40P, max_range_m=200.0, reach_m=200.0, range_noise_m=0.01
        ),
        "bpearl": replace(  # a hemisphere
            _SOLD, elevations_deg=_even(2.31, 89.5, 32), reach_m=30.0, min_range_m=0.2
        ),
        "m1": replace(  # solid state, 120 by 25 degrees
            _SOLD, elevations_deg=_even(-12.5, 12.5, 125), azimuth_span_deg=120.0,
            max_range_m=200.0, reach_m=150.0, range_noise_m=0.025,
        ),
        "e1r": replace(  # solid state, 120 by 90 degrees
            _SOLD, elevations_deg=_even(-45, 45, 144), azimuth_span_deg=120.0, n_columns=192,
            min_range_m=0.1, max_range_m=75.0, reach_m=30.0, range_noise_m=0.025,
        ),
        "mid360": replace(
            _SOLD, pattern="ring_rosette", n_beams=4, n_columns=5000, min_elevation_deg=-7,
            max_elevation_deg=52, min_range_m=0.1, max_range_m=70.0, reach_m=40.0,
        ),
        "avia": replace(
            _SOLD, pattern="rosette", n_beams=6, n_columns=4000, min_elevation_deg=-38.6,
            max_elevation_deg=38.6, azimuth_span_deg=70.4, min_range_m=1.0, max_range_m=200.0,
            reach_m=190.0,
        ),
        "tilting_line": replace(  # UTM-30LX, 40 lines a second, nodding once in 3 s
            _SOLD, pattern="tilting", n_beams=120, min_elevation_deg=-45, max_elevation_deg=45,
            azimuth_step_deg=0.25, azimuth_span_deg=270.0, sweep_s=3.0, min_range_m=0.1,
            max_range_m=30.0, reach_m=20.0, range_noise_m=0.01, divergence_deg=0.3,
        ),
    }
)  # fmt: skip


def calibrated(scanner: Scanner, rng: np.random.Generator) -> Scanner:
    """Return an individual of a scanner, with the errors that calibration leaves in its beams.

    Their size is that of real scanners, measured on the planes of single scans
    (``docs/simulation.md``).
    """
    factor = float(np.exp(rng.normal(0.0, _SPREAD)))
    return replace(
        scanner,
        range_offset_m=factor * _OFFSET_M,
        elevation_error_deg=factor * _ELEVATION_DEG,
        serial=int(rng.integers(2**31)),
    )


_OFFSET_M, _ELEVATION_DEG = 0.008, 0.02  # of the beams of a scanner, its geometric mean
_SPREAD = 0.6  # of its logarithm, between scanners
