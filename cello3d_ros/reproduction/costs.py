"""Processor time of what is kept on disk, kept beside it: what was interrupted adds up."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cello3d_ros.atomic import new_file


class Costs:
    """Seconds of processor time by the name of a step, in a JSON file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._earlier = self._seconds()
        self._used: set[str] = set()

    def earlier(self) -> float:
        """Return what was spent before now on the steps that were used since the last call."""
        total = sum(self._earlier.get(step, 0.0) for step in self._used)
        self._used.clear()
        self._earlier = self._seconds()
        return total

    def _seconds(self) -> dict[str, float]:
        """Return what was spent on each step so far; a damaged file counts as none."""
        try:
            found = json.loads(self._path.read_text(encoding="utf-8"))
            return {str(name): float(seconds) for name, seconds in found.items()}
        except (OSError, ValueError, AttributeError, TypeError):
            return {}

    @contextmanager
    def of(self, step: str) -> Iterator[None]:
        """Add the processor time of the body, of all threads, also when it is interrupted."""
        self._used.add(step)
        start = time.process_time()
        try:
            yield
        finally:
            spent = self._seconds()
            spent[step] = round(spent.get(step, 0.0) + time.process_time() - start, 2)
            with new_file(self._path) as partial:
                partial.write_text(json.dumps(spent, indent=1) + "\n", encoding="utf-8")
