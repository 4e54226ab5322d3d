"""Work shared among threads."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

P = TypeVar("P")
T = TypeVar("T")

_here = threading.local()


def in_threads(task: Callable[[P], T], parts: Sequence[P], n_threads: int) -> list[T]:
    """Return what ``task`` makes of each part, in threads if there are more than one of both.

    The threads stay for the next call.  A task that shares its work does all of it itself.  When
    one raises, those that wait are dropped and those that run are waited for.
    """
    if min(n_threads, len(parts)) <= 1 or hasattr(_here, "is_busy"):
        return [task(part) for part in parts]
    futures = [_pool(n_threads).submit(task, part) for part in parts]
    try:
        return [future.result() for future in futures]
    finally:
        for future in futures:
            future.cancel()
        wait(futures)


@functools.cache
def _pool(n_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n_threads, initializer=setattr, initargs=(_here, "is_busy", True))


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
