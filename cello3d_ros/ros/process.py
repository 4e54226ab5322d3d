"""covariance_node as a process of its own: started, watched and stopped.  Imports no ROS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import cello3d_ros
from cello3d_ros.errors import Cello3dError

PROFILE = "fastdds_large_clouds.xml"

_STOP_TIMEOUT_S = 10.0


class NodeDiedError(Cello3dError):
    """The node ended by itself."""


def environment(domain_id: int) -> dict[str, str]:
    """Return the variables of a ROS graph on this machine only, fit for large clouds."""
    values = {"ROS_DOMAIN_ID": str(domain_id), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    profile = shared_file("config", PROFILE)
    if profile is not None and "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ:
        values["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
    return values


def shared_file(folder: str, name: str) -> Path | None:
    """Return a file that comes with the package, in the source tree or installed; or None."""
    package = Path(cello3d_ros.__file__).resolve().parent
    roots = [package.parent, Path(sys.prefix) / "share" / "cello3d_ros"]
    roots += [parent / "share" / "cello3d_ros" for parent in package.parents]
    for root in roots:
        if (path := root / folder / name).is_file():
            return path
    return None


class NodeProcess:
    """A context: the node runs within it and is stopped by SIGINT at its end.

    What the node prints goes to ``log``.
    """

    def __init__(
        self,
        log: Path,
        domain_id: int,
        parameters: Mapping[str, object] | None = None,
        ros_arguments: Sequence[str] = (),
    ) -> None:
        """Start the node.  parameters: by name, as given to ``-p``."""
        self.log = log
        command = [sys.executable, "-m", "cello3d_ros.ros.main", "--ros-args", *ros_arguments]
        for name, value in (parameters or {}).items():
            command += ["-p", f"{name}:={value}"]
        with open(log, "wb") as stream:
            self._process = subprocess.Popen(
                command,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env={**os.environ, **environment(domain_id), "PYTHONUNBUFFERED": "1"},
            )
        self._peak_kb = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def output(self) -> str:
        """Return what the node has printed so far."""
        return self.log.read_text(errors="replace")

    def check(self) -> None:
        """Note the memory in use.  Raises NodeDiedError with the node's last words."""
        status = self._process.poll()
        if status is not None:
            words = self.output().strip().splitlines() or ["it said nothing"]
            raise NodeDiedError(f"covariance_node ended with status {status}: {words[-1]}")
        try:
            lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
            self._peak_kb = next(int(s.split()[1]) for s in lines if s.startswith("VmHWM:"))
        except (OSError, StopIteration):
            return  # not Linux, or just gone

    @property
    def peak_memory_mb(self) -> float | None:
        """Largest resident memory seen by ``check``, or None where the system does not say."""
        return self._peak_kb / 1024 if self._peak_kb else None

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the node, if it still runs."""
        if self._process.poll() is None:
            self._process.send_signal(number)

    def stop(self) -> int:
        """Stop the node by SIGINT and return its exit status; -9 when it had to be killed."""
        self.send(signal.SIGINT)
        return self.wait()

    def wait(self, timeout_s: float = _STOP_TIMEOUT_S) -> int:
        """Return the exit status of a node that is ending; kill it when it does not."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
