"""A signal ends the node with status 0 and no traceback, whatever it does at that moment."""

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cello3d_ros.ros.process import NodeProcess

NUMBERS = [signal.SIGINT, signal.SIGTERM]


def ends_well(process: NodeProcess, number: signal.Signals) -> None:
    process.send(number)
    assert process.wait() == 0
    assert "Traceback" not in process.output()
    assert "ready" not in process.output()


def wait_for(process: NodeProcess, happened: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 60.0
    while not happened():
        process.check()
        assert time.monotonic() < end_s
        time.sleep(0.001)


def catches(process: NodeProcess, number: signal.Signals) -> bool:
    """Whether the process has a handler for a signal."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    caught = int(next(s.split()[1] for s in lines if s.startswith("SigCgt:")), 16)
    return bool(caught >> (number - 1) & 1)


@pytest.mark.parametrize("number", NUMBERS)
def test_while_it_imports(tmp_path, domain_id, model_path, number) -> None:
    parameters = {"node.model": model_path}
    with NodeProcess(tmp_path / "log", domain_id, parameters) as process:
        wait_for(process, lambda: catches(process, signal.SIGTERM))
        ends_well(process, number)
        assert process.output() == ""


@pytest.mark.parametrize("number", NUMBERS)
def test_while_it_compiles(tmp_path, domain_id, model_path, monkeypatch, number) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    parameters = {"node.model": model_path}
    with NodeProcess(tmp_path / "log", domain_id, parameters) as process:
        wait_for(process, lambda: any(cache.rglob("*.nbc")))  # one of many kernels is ready
        ends_well(process, number)
        assert "warming up" in process.output()
