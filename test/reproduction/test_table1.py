"""Table I over several places: the intervals of its means."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.stats import t

from cello3d_ros.reproduction import table1


def test_the_interval_over_places_is_students() -> None:
    means = np.array([[0.8, 0.5], [0.9, 0.7], [1.1, 0.6]])
    said = [float(number) for number in re.findall(r"[\d.]+", table1._interval(means))]
    for k, (mean, off) in enumerate((said[:2], said[2:])):
        low, high = t.interval(
            0.95, 2, means[:, k].mean(), means[:, k].std(ddof=1) / np.sqrt(len(means))
        )
        assert (mean - off, mean + off) == pytest.approx((low, high), abs=0.011)


def test_one_place_has_no_interval() -> None:
    assert table1._interval(np.array([[0.8, 0.5]])) == "0.80 (0.50)"
