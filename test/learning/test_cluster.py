"""Sampling on real Dask schedulers and workers: processes of their own, on loopback."""

import dataclasses
import os
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from cello3d_ros.cli.main import main
from cello3d_ros.config import IcpConfig, Pipeline, SamplingConfig, load_config, pipeline_of
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.learning.cluster import (
    ClusterError,
    Job,
    connected,
    sample_recording_on,
)
from cello3d_ros.learning.cluster_tasks import _Reader
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.learning.sampling import pairs, sample_recording
from cello3d_ros.recordings import open_recording

pytestmark = pytest.mark.skipif(
    find_spec("distributed") is None, reason="distributed is not installed: extra 'cluster'"
)

SAMPLING = SamplingConfig(n_samples=60, variance=0.01, max_gap=2, n_rotations=2)
PIPELINE = pipeline_of(load_config(Path(__file__).parents[2] / "config" / "cello3d.yaml"))
PIPELINE = Pipeline(
    cloud=dataclasses.replace(PIPELINE.cloud, voxel_m=0.1),
    icp=IcpConfig(n_reading_points=400, n_reference_points=1500),
)
CONFIG = """
cloud: {voxel_m: 0.1}
icp: {n_reading_points: 400, n_reference_points: 1500}
sampling: {n_samples: 60, variance: 0.01, max_gap: 2, n_rotations: 2}
"""


@contextmanager
def process(*arguments: str, until: str):
    """Start ``dask ...``; give the process and its first line that holds ``until``."""
    started = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments, "--no-dashboard"],
        stderr=subprocess.PIPE,
        text=True,
    )
    lines = iter(started.stderr.readline, "")
    try:
        line = next((line for line in lines if until in line), "")
        assert line, f"dask {arguments} ended: {started.wait(10)}"
        threading.Thread(target=lambda: list(lines), daemon=True).start()
        yield started, line
    finally:
        with suppress(ProcessLookupError):
            started.kill()
        started.wait(30)


@contextmanager
def a_scheduler():
    arguments = ("scheduler", "--host", "127.0.0.1", "--port", "0")
    with process(*arguments, until="Scheduler at:") as (started, line):
        yield started, line.split()[-1]


def a_worker(address: str, threads: int = 1):
    arguments = ("worker", address, "--nworkers", "1", "--nthreads", str(threads), "--no-nanny")
    return process(*arguments, until="Registered to:")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A KITTI folder of 5 scans of a room from a short path."""
    folder = tmp_path_factory.mktemp("data") / "room"
    (folder / "velodyne").mkdir(parents=True)
    rng = np.random.default_rng(3)
    half = np.array([4.0, 3.0, 1.5])
    points = rng.uniform(-1, 1, (6000, 3)) * half
    face = rng.integers(3, size=len(points))
    points[np.arange(len(points)), face] = rng.choice([-1, 1], len(points)) * half[face]
    poses = [exp([0.2 * k, 0.1 * k, 0, 0, 0, 0.1 * k]) for k in range(5)]
    for k, T in enumerate(poses):
        seen = transform(inverse(T), points + rng.normal(scale=0.01, size=points.shape))
        scan = np.column_stack([seen, np.zeros(len(seen))]).astype("<f4")
        scan.tofile(folder / "velodyne" / f"{k:06d}.bin")
    np.savetxt(folder / "poses.txt", [T[:3].ravel() for T in poses])
    return folder


@pytest.fixture(scope="module")
def cluster():
    """A scheduler with two workers, of one and of two threads: address and processes."""
    with ExitStack() as stack:
        _, address = stack.enter_context(a_scheduler())
        for threads in (1, 2):
            stack.enter_context(a_worker(address, threads))
        yield address


@pytest.fixture(scope="module")
def local(recording):
    """What one machine and one thread find."""
    return by_key(sample_recording(open_recording(recording), pairs(5, 2), PIPELINE, SAMPLING), 7)


def by_key(records, n):
    found = {}
    for record in records:
        assert record.key not in found, "a pair came twice"
        found[record.key] = record
    assert len(found) == n
    return found


def assert_same(found, wanted):
    assert found.keys() == wanted.keys()
    for key, record in found.items():
        for field in dataclasses.fields(record):
            a, b = getattr(record, field.name), getattr(wanted[key], field.name)
            if isinstance(a, dict):
                assert a.keys() == b.keys()
                assert all(a[name].tobytes() == b[name].tobytes() for name in a)
            elif isinstance(a, np.ndarray):
                assert a.tobytes() == b.tobytes(), (key, field.name)
            else:
                assert a == b


def job(recording, sampling=SAMPLING, **settings):
    settings = {"name": "room", "path": str(recording), "pipeline": PIPELINE, **settings}
    return Job(sampling=sampling, **settings)


@pytest.mark.parametrize(("block", "ship"), [(7, False), (60, True), (1000, False)])
def test_blocks_workers_and_ways_of_reading_do_not_change_a_bit(
    recording, cluster, local, block, ship
):
    todo, counts = pairs(5, 2), []
    with connected(cluster) as client:
        records = sample_recording_on(
            client,
            open_recording(recording),
            todo,
            job(recording, block=block, ship_clouds=ship),
            counts.append,
        )
        assert_same(by_key(records, 7), local)
    assert sum(counts) == 7 * SAMPLING.n_samples


def test_workers_keep_blas_to_one_thread(recording, cluster):
    def blas_threads():  # travels by value: workers do not know this module
        return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}

    with connected(cluster) as client:
        records = sample_recording_on(
            client, open_recording(recording), pairs(5, 2), job(recording, block=20)
        )
        by_key(records, 7)
        used = list(client.run(blas_threads).values())
    assert len(used) == 2
    assert {1} in used
    assert all(found in ({1}, {os.cpu_count()}) for found in used)  # or was given no task


@pytest.mark.parametrize("ship", [False, True])
def test_simulated_worlds_are_scanned_anew_as_on_one_machine(tmp_path, cluster, ship):
    pytest.importorskip("embreex")
    folder, config = tmp_path / "bag", tmp_path / "config.yaml"
    config.write_text(CONFIG)
    flags = ["--seed", "2", "--scans", "2", "--scanner", "spinning16"]
    assert main(["simulate", "rooms", *flags, "--out", str(folder)]) == 0
    sets = [tmp_path / "here", tmp_path / "there", tmp_path / "plain"]
    there = ["--scheduler", cluster, "--block", "25", *(["--ship-clouds"] if ship else [])]
    for out, more in zip(sets, (["--noise", "0.02"], ["--noise", "0.02", *there], [])):
        command = ["sample", str(folder), "--config", str(config), "--samples", "60"]
        assert main([*command, "--out", str(out), *more]) == 0
    one, two, plain = ({p.name: p.read_bytes() for p in s.rglob("pairs/*")} for s in sets)
    assert one == two
    assert len(one) == 1
    assert one != plain
    facts = [open_dataset(path).recordings["bag"] for path in sets]
    assert facts[0]["noise"] == "rescans"
    assert "noise" not in facts[2]
    assert facts[0]["fingerprint"] == facts[1]["fingerprint"]


def test_only_what_is_asked_for_is_sampled(recording, cluster, local):
    todo = [(1, 3), (2, 3)]
    with connected(cluster) as client:
        records = sample_recording_on(
            client, open_recording(recording), todo, job(recording, block=30)
        )
        assert_same(by_key(records, 2), {k: v for k, v in local.items() if k[1:] in todo})
        nothing = sample_recording_on(
            client, open_recording(recording), [], job(recording, block=30)
        )
        assert list(nothing) == []


def test_adaptive_sampling_is_that_of_one_machine(recording, cluster):
    sampling = dataclasses.replace(SAMPLING, precision=0.3, min_samples=50)
    todo = [(0, 1), (1, 2)]
    wanted = by_key(sample_recording(open_recording(recording), todo, PIPELINE, sampling), 2)
    assert all(record.n_samples < 60 for record in wanted.values())
    counts = []
    with connected(cluster) as client:
        found = sample_recording_on(
            client,
            open_recording(recording),
            todo,
            job(recording, sampling, block=10),
            progress=counts.append,
        )
        assert_same(by_key(found, 2), wanted)
    assert sum(counts) == sum(record.n_samples for record in wanted.values())


def test_a_worker_killed_at_any_moment_loses_no_pair_and_doubles_none(recording, local):
    """Five times, one of two workers dies when the n-th task ends, and another one comes."""
    moments = np.random.default_rng(0).integers(1, 30, size=5)
    with ExitStack() as stack:
        _, address = stack.enter_context(a_scheduler())
        workers = [stack.enter_context(a_worker(address))[0] for _ in range(2)]
        for moment in moments:
            n_ended = 0

            def kill_one(_, moment=moment):
                nonlocal n_ended
                n_ended += 1
                if n_ended == moment:
                    workers.pop(0).kill()
                    workers.append(stack.enter_context(a_worker(address))[0])

            with connected(address) as client:
                records = sample_recording_on(
                    client,
                    open_recording(recording),
                    pairs(5, 2),
                    job(recording, block=15, ship_clouds=bool(moment % 2)),
                    progress=kill_one,
                )
                assert_same(by_key(records, 7), local)
            assert n_ended > moment


def test_a_scheduler_that_dies_is_one_error_and_the_folder_is_resumed(
    recording, tmp_path, capsys, monkeypatch
):
    (tmp_path / "config.yaml").write_text(CONFIG)
    command = ["sample", str(recording), "--config", str(tmp_path / "config.yaml"), "--jobs", "1"]
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    from cello3d_ros.learning.dataset import Dataset

    with a_scheduler() as (scheduler, address), a_worker(address):
        write, n_written = Dataset.write, []

        def kill_at_third(self, record):
            write(self, record)
            n_written.append(record.key)
            if len(n_written) == 3:
                scheduler.kill()

        monkeypatch.setattr(Dataset, "write", kill_at_third)
        monkeypatch.setattr("cello3d_ros.learning.cluster._FEWEST_UNDER_WAY", 6)
        capsys.readouterr()
        flags = ["--out", str(tmp_path / "cut"), "--scheduler", address, "--block", "20"]
        assert main([*command, *flags]) == 1
        error = capsys.readouterr().err
        assert "lost the Dask scheduler at tcp://127.0.0.1" in error
        assert error.count("\n") == 1
        assert 3 <= len(n_written) < 7
    monkeypatch.undo()
    assert main([*command, "--out", str(tmp_path / "cut")]) == 0
    for file in sorted((tmp_path / "whole").rglob("*.*")):
        twin = tmp_path / "cut" / file.relative_to(tmp_path / "whole")
        assert file.read_bytes() == twin.read_bytes()
    assert len(list((tmp_path / "cut" / "pairs").iterdir())) == 7


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:{port}", "nonsense", "tcp://no.invalid:1"])
def test_an_unreachable_scheduler_is_one_sentence(
    recording, tmp_path, capsys, monkeypatch, address
):
    monkeypatch.setattr("cello3d_ros.learning.cluster.CONNECT_TIMEOUT_S", 0.5)
    with socket.socket() as bound:  # bound and not listening: refuses
        bound.bind(("127.0.0.1", 0))
        address = address.format(port=bound.getsockname()[1])
        out = tmp_path / "set"
        assert main(["sample", str(recording), "--out", str(out), "--scheduler", address]) == 1
    error = capsys.readouterr().err
    assert f"no Dask scheduler answers at {address}" in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_a_port_where_something_else_listens_is_one_sentence():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with (
            pytest.raises(ClusterError, match=f"no Dask scheduler answers at .*{port}"),
            connected(f"tcp://127.0.0.1:{port}", timeout_s=0.5),
        ):
            pass


def test_workers_of_other_versions_are_refused(recording, cluster):
    versions = (("numpy", "0.9"),)
    with connected(cluster) as client:
        records = sample_recording_on(
            client,
            open_recording(recording),
            [(0, 1)],
            job(recording, versions=versions, block=30),
        )
        with pytest.raises(ClusterError, match=r"a worker has numpy .*, this machine 0.9"):
            list(records)


@pytest.mark.parametrize("ship", [False, True])
def test_a_recording_that_ends_early_keeps_the_pairs_before(recording, cluster, local, ship):
    found = []
    with connected(cluster) as client:
        records = sample_recording_on(
            client,
            open_recording(recording),
            [(0, 1), (3, 4), (4, 5)],
            job(recording, block=30, ship_clouds=ship),
        )
        with pytest.raises(RecordingError, match="ends early, after 5 scans: scan 5 is missing"):
            found.extend(records)
    assert_same(
        {record.key: record for record in found},
        {key: local[key] for key in [("room", 0, 1), ("room", 3, 4)]},
    )


def test_a_recording_that_the_workers_cannot_see_is_one_sentence(recording, cluster):
    with connected(cluster) as client:
        records = sample_recording_on(
            client, open_recording(recording), [(0, 1)], job("/nowhere/room", block=30)
        )
        with pytest.raises(RecordingError, match="/nowhere/room: no such file"):
            list(records)


def test_the_reader_gives_each_scan_whatever_the_order(recording):
    wanted = list(open_recording(recording))
    reader = _Reader(str(recording))
    for index in (0, 2, 1, 4, 0, 3, 3):
        np.testing.assert_array_equal(reader.scan(index).points, wanted[index].points)
    with pytest.raises(RecordingError, match="ends early"):
        reader.scan(5)
