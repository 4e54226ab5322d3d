"""Work shared among threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

P = TypeVar("P")
T = TypeVar("T")


def in_threads(task: Callable[[P], T], parts: Sequence[P], n_threads: int) -> list[T]:
    """Return what ``task`` makes of each part, in threads if there are more than one of both."""
    if min(n_threads, len(parts)) <= 1:
        return [task(part) for part in parts]
    with ThreadPoolExecutor(min(n_threads, len(parts))) as pool:
        return list(pool.map(task, parts))
