"""Which scans of a recording are registered with each other (Sec. V-A)."""

from __future__ import annotations


def pairs(n_scans: int, max_gap: int) -> list[tuple[int, int]]:
    """Return every (i, j) with ``0 <= i < j < n_scans`` and ``j - i <= max_gap``.

    Scan j is the reading, scan i the reference.  Ordered by j, then i: one pass over a recording
    that remembers its last ``max_gap`` scans meets every pair.
    """
    return [(i, j) for j in range(1, n_scans) for i in range(max(0, j - max_gap), j)]
