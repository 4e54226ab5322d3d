"""What a node opens, writes and allocates: no more than ROS itself and a stated bound."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import Config
from cello3d_ros.covariance.model import constant_model
from cello3d_ros.ros import messages
from cello3d_ros.ros.process import NodeDiedError, NodeProcess
from cello3d_ros.ros.worker import MAX_CLOUD_BYTES, Worker
from cello3d_ros.tracking.intake import Skip

START_MB = 400.0  # resident memory of a node that has imported everything, with room to spare


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """The folder that a node lives in."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def node(home, tmp_path_factory, domain_id, model_path) -> Iterator[NodeProcess]:
    """A node at home in an empty folder."""
    log, before = tmp_path_factory.mktemp("node") / "log", os.getcwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([before, os.environ.get("PYTHONPATH", "")]))
        for name, value in {"HOME": home, "ROS_HOME": home / ".ros", "TMPDIR": home}.items():
            patch.setenv(name, str(value))
        patch.chdir(home)
        process = NodeProcess(log, domain_id, {"node.model": model_path})
    with process:
        yield process
        assert process.stop() == 0


def sockets(pid: int, kind: str) -> list[int]:
    """Return the local ports of a process; kind: "tcp" or "udp"."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # that of the listing itself
            if (target := os.readlink(link)).startswith("socket:["):
                inodes.add(target[8:-1])
    rows = [
        line.split()
        for name in (kind, f"{kind}6")
        for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]
    ]
    return [int(row[1].split(":")[1], 16) for row in rows if row[9] in inodes]


def test_no_port_but_those_of_dds_and_no_file_but_logs(lone_robot, node, home) -> None:
    """This process has joined the graph as a bare ROS node does."""
    lone_robot.walk(3)
    lone_robot.assert_right_again()
    assert sockets(node.pid, "tcp") == []
    assert len(sockets(node.pid, "udp")) <= len(sockets(os.getpid(), "udp"))
    written = {path.relative_to(home).parts[0] for path in home.rglob("*") if path.is_file()}
    assert written <= {".ros"}


def test_a_cloud_beyond_the_bound_is_refused_before_it_is_read(constant_Y) -> None:
    skips: list[Skip] = []
    worker = Worker(constant_model(constant_Y, 704), Config(), skips.append, print)
    message = messages.cloud_to(1, "lidar", np.ones((MAX_CLOUD_BYTES // 12 + 1, 3)))
    worker.hear_cloud(message, 0)
    assert [skip.reason for skip in skips] == ["malformed"]
    assert f"more than {MAX_CLOUD_BYTES}" in skips[0].sentence
    message.data = message.data[:1200]
    message.width, message.row_step = 100, 1200
    worker.hear_cloud(message, 0)
    assert len(skips) == 1
    assert worker.has_work


def absurd(path: Path) -> None:
    """A model whose directory declares items of 4 GB."""
    np.savez(path, header=np.zeros(8, np.uint8))
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02") + 24  # the uncompressed size in the central directory
    data[at : at + 4] = (2**32 - 2).to_bytes(4, "little")
    path.write_bytes(data)


def pickled(path: Path) -> None:
    """A model with an array of objects, which would have to be unpickled."""
    np.savez(path, header=np.array([{"format": "cello3d-model"}], dtype=object))


@pytest.mark.parametrize("hostile", [absurd, pickled])
def test_a_hostile_model_costs_a_sentence(tmp_path, domain_id, hostile) -> None:
    path = tmp_path / "hostile.npz"
    hostile(path)
    with NodeProcess(tmp_path / "log", domain_id, {"node.model": path}) as process:
        with contextlib.suppress(NodeDiedError):
            while True:
                process.check()
        assert process.wait() == 1
        assert str(path) in process.output().splitlines()[-1]
        assert "Traceback" not in process.output()
        assert (process.peak_memory_mb or 0.0) < START_MB
