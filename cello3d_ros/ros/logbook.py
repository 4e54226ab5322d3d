"""Warnings that do not flood the log.  Imports no ROS."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable

_PERIOD_S = 5.0  # warnings of one kind come at most this often
_MAX_KINDS = 100  # kinds of warnings remembered


class Logbook:
    """Logs a warning, but sentences that differ only in numbers at most once a while."""

    def __init__(self, log: Callable[[str], object]) -> None:
        self._log = log
        self._warned_s: dict[str, float] = {}
        self._told: set[str] = set()

    def warn_once(self, sentence: str) -> None:
        """Log a sentence, unless its like has ever been logged."""
        if (key := re.sub(r"[0-9.]+", "", sentence)) not in self._told:
            self._told.add(key)
            self._log(sentence)

    def warn(self, kind: str, sentence: str) -> None:
        """Log a sentence of some kind, unless its like was logged a moment ago."""
        key, now_s = kind + re.sub(r"[0-9.]+", "", sentence), time.monotonic()
        if now_s - self._warned_s.get(key, -math.inf) >= _PERIOD_S:
            if len(self._warned_s) >= _MAX_KINDS:
                self._warned_s.clear()
            self._warned_s[key] = now_s
            self._log(sentence)
