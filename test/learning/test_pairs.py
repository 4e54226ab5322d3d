"""Pairs of scans: the reading comes later, at most so many scans after the reference."""

from __future__ import annotations

import pytest

from cello3d_ros.learning.sampling import pairs


@pytest.mark.parametrize(("n_scans", "max_gap"), [(2, 1), (5, 4), (7, 2), (35, 4), (3, 10)])
def test_every_pair_within_the_gap_appears_once(n_scans: int, max_gap: int) -> None:
    wanted = {(i, j) for i in range(n_scans) for j in range(n_scans) if 1 <= j - i <= max_gap}
    found = pairs(n_scans, max_gap)
    assert set(found) == wanted
    assert len(found) == len(wanted)


def test_a_window_of_the_last_scans_suffices() -> None:
    readings = [j for _, j in pairs(20, 4)]
    assert readings == sorted(readings)
    assert pairs(4, 2) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]


@pytest.mark.parametrize("n_scans", [0, 1])
def test_too_few_scans_make_no_pair(n_scans: int) -> None:
    assert pairs(n_scans, 4) == []
