"""The process of covariance_node: a signal ends it within a second, status 0, whatever it does.

Handlers of signals stand before the imports, which take a second, so that this module imports
nothing heavy at its top.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from cello3d_ros.ros.node import CovarianceNode

NAME = "covariance_node"

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_GRACE_S = 0.8  # left to a node that is told to stop, before its process ends under it


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Run the node until it is told to stop and end the process: status 0, 1 for an error."""
    _on_signals(lambda *_: os._exit(0))  # nothing is there yet that could be put away
    _end_in_time(_GRACE_S)
    from cello3d_ros.errors import Cello3dError

    status = 1
    try:
        status = _run(args)
    except Cello3dError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
    except Exception:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # all is put away; Python's own tidying up would take half a second


def _run(args: Sequence[str] | None) -> int:
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from threadpoolctl import threadpool_limits

    from cello3d_ros.ros.node import CovarianceNode

    node: CovarianceNode | None = None

    def interrupt(*_: Any) -> None:  # while the node spins, rclpy's own handler ends it
        if node is None or node.is_configuring:
            raise KeyboardInterrupt

    _on_signals(interrupt)
    try:
        _initialise(args)
        with threadpool_limits(1, user_api="blas"):  # its waiting threads take the kernels' cores
            node = CovarianceNode(NAME)
            if node.autostart:
                node.start()
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except Exception:  # what rclpy raises when a signal ends its context in mid-callback
        if node is None or rclpy.ok():
            raise
    finally:
        _on_signals(signal.SIG_IGN)  # impatience does not change the status
        with contextlib.suppress(RuntimeError):  # rclpy's own handler may be at it, too
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
    return 0


def _initialise(args: Sequence[str] | None) -> None:
    import rclpy

    from cello3d_ros.errors import ConfigError

    try:
        rclpy.init(args=None if args is None else list(args))
    except (RuntimeError, ValueError) as error:
        text = " ".join(str(error).split())
        if "logging" in text:
            raise ConfigError(
                f"cannot write ROS logs; set ROS_LOG_DIR to a folder that can be written: {text}"
            ) from None
        raise ConfigError(f"cannot start with these ROS arguments: {text}") from None


def _on_signals(handler: Callable[..., Any] | signal.Handlers) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


def _end_in_time(grace_s: float) -> None:
    """End the process ``grace_s`` after the first signal, even from within compiled code."""
    heard, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)

    def watch() -> None:
        os.read(heard, 1)
        time.sleep(grace_s)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    main()
