"""The decorator of every compiled function: numba's, with what a user must be told about it.

Kernels are compiled when they are first called and kept in numba's cache.  Where no cache can be
written they are compiled at every start.  A warning says so once, when the first is compiled.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit
from numba.core import event

F = TypeVar("F", bound=Callable[..., Any])

_logger = logging.getLogger("cello3d_ros")


def kernel(**options: Any) -> Callable[[F], F]:
    """Return the decorator that compiles a function without the interpreter's lock.

    options: those of ``numba.njit`` besides ``cache`` and ``nogil``.
    """

    def decorate(function: F) -> F:
        try:
            compiled: F = njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # numba finds no folder for its cache
            _notice.has_cache = False
            compiled = njit(nogil=True, **options)(function)
        return compiled

    return decorate


class _Notice(event.Listener):
    """Says, when the first kernel of this package is compiled, that it takes time."""

    has_cache = True

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("cello3d_ros."):
            _say_once(self.has_cache)

    def on_end(self, event: Any) -> None:
        pass


@functools.cache
def _say_once(has_cache: bool) -> None:
    if has_cache:
        _logger.warning("compiling kernels: once after an installation, 10 to 30 s in all")
    else:
        _logger.warning(
            "compiling kernels, 10 to 30 s at every start: numba can write no cache; "
            "set NUMBA_CACHE_DIR to a folder that can be written"
        )


_notice = _Notice()
event.register("numba:compile", _notice)  # type: ignore[no-untyped-call]
