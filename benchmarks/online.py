"""Time the node from PointCloud2 in to message out, over DDS and in one process; load it.

    pip install '.[bench]'
    python benchmarks/online.py --recording DIR --json FILE
    python benchmarks/online.py --load 10 --minutes 10 --points 130000 --json FILE
    python benchmarks/online.py --load 50 --minutes 1 --points 130000 --json FILE

The first plays a recording to and fro into a node of its own, at a sensor's rate.  ``p50_ms`` and
``p95_ms`` are from publishing a cloud to receiving its ``~/pose`` over DDS with the shipped
profile, mode cello3d; ``fused_p50_ms`` and ``fused_p95_ms`` the same in mode fused.  In one
process, cloud by cloud in turns with KISS-ICP on the same points: ``in_process_*`` is from the
bytes of a message to the published answer, ``registration_ms`` registration and covariance
alone with what is done after the answer for the next one (``finish_ms`` of it), ``kiss_icp_ms``
one call of KISS-ICP's ``register_frame``; each a mean of wall times, as only some scans become
keyframes.  ``cpu_ratio_to_kiss_icp`` is the same ratio of processor times, which other load
disturbs less.

The second sends clouds of a hall at some rate whatever the node does.  ``minutes`` tells the
latency and the node's memory minute by minute (or part of one, where the whole is shorter than
five); ``memory_growth_mb`` is what the last has more than the second, ``answered_share`` that of
the clouds after the first reference, ``dropped`` what had no answer, ``work_ms`` the time between
answers of a node that is never idle.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry import se3
from cello3d_ros.recordings import Scan, open_recording
from cello3d_ros.recordings.odometry import SimulatedOdometry
from cello3d_ros.ros.process import NodeProcess, environment

DOMAIN_ID = 101 + os.getpid() % 100
N_SKIPPED = 5  # answers of the beginning that are not counted: caches fill


def main() -> int:
    """Measure and print; status 1 where there is nothing to measure."""
    os.environ.update(environment(DOMAIN_ID))
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recording", type=Path, help="bag or KITTI folder, played to and fro")
    parser.add_argument("--load", type=float, metavar="HZ", help="send clouds at this rate")
    parser.add_argument("--minutes", type=float, default=1.0, help="how long to load (1)")
    parser.add_argument("--points", type=int, default=130_000, help="of a cloud of the load")
    parser.add_argument("--scans", type=int, default=200, help="scans of the recording (200)")
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second (10)")
    parser.add_argument("--model", type=Path, help="model file (the shipped one)")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if (arguments.recording is None) == (arguments.load is None):
        parser.error("give either --recording or --load")
    parameters = {} if arguments.model is None else {"node.model": arguments.model.resolve()}
    try:
        if arguments.load is None:
            result = recorded(arguments, parameters)
        else:
            result = loaded(arguments.load, arguments.minutes * 60, arguments.points, parameters)
    except Cello3dError as error:
        print(f"online: {error}", file=sys.stderr)
        return 1
    print(json.dumps(result, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    return 0


def recorded(arguments: argparse.Namespace, parameters: dict[str, Any]) -> dict[str, Any]:
    """Return the latencies on a recording, and KISS-ICP's."""
    recording = open_recording(arguments.recording)
    if not recording.has_odometry:
        recording = SimulatedOdometry(recording)
    scans = to_and_fro(list(recording), arguments)
    result = {
        "recording": arguments.recording.name,
        "n_points": int(np.median([len(scan.points) for scan in scans])),
        "cores": len(os.sched_getaffinity(0)),
    }
    for mode, prefix in (("cello3d", ""), ("fused", "fused_")):
        found = over_dds(scans, arguments.rate, {**parameters, "node.covariance_mode": mode})
        result |= {prefix + name: value for name, value in found.items()}
    return result | in_process(scans, parameters)


class InMemory(list[Scan]):
    """Scans as a recording."""

    name = "in memory"
    has_odometry = True


def to_and_fro(scans: list[Scan], arguments: argparse.Namespace) -> InMemory:
    """Return as many scans as are asked for, forwards and backwards, stamped anew from now on."""
    path = [*scans, *scans[-2:0:-1]]
    start_ns, step_ns = time.time_ns() - 3600 * 10**9, int(1e9 / arguments.rate)
    return InMemory(
        replace(path[i % len(path)], stamp_ns=start_ns + i * step_ns)
        for i in range(arguments.scans)
    )


def over_dds(scans: InMemory, rate_hz: float, parameters: dict[str, Any]) -> dict[str, Any]:
    """Return what the node answers to scans at a rate, and how soon."""
    from cello3d_ros.ros.replay import Player, play

    with started(parameters) as node:
        player = Player(DOMAIN_ID, check=node.check)
        replay = play(player, scans, rate_hz)
        player.close()
    return {
        **quantiles(replay.latencies_ms()[N_SKIPPED:]),
        "answered": len(replay.poses),
        "answered_share": len(replay.poses) / (len(scans) - 1),
        "dropped": len(scans) - len(replay.poses) - 1,
        "peak_memory_mb": node.peak_memory_mb,
    }


@contextlib.contextmanager
def started(parameters: dict[str, Any]) -> Iterator[NodeProcess]:
    """A node whose log goes away with it."""
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcess(Path(folder) / "log", DOMAIN_ID, parameters) as node,
    ):
        yield node


def in_process(scans: InMemory, parameters: dict[str, Any]) -> dict[str, Any]:
    """Return times of a node that is called and not spun, in turns with KISS-ICP."""
    import rclpy
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import PointCloud2
    from threadpoolctl import threadpool_limits

    from cello3d_ros.ros import messages
    from cello3d_ros.ros.node import CovarianceNode

    given = [f"-p {name}:={value}" for name, value in parameters.items()]
    rclpy.init(args=["--ros-args", *" ".join(given).split()])
    whole, alone, after, kiss = Clock(), Clock(), Clock(), Clock()
    register_frame = kiss_icp()
    with threadpool_limits(1, user_api="blas"):
        node = CovarianceNode("online_node")
        node.start()
        node._worker.answer = alone.timing(node._worker.answer)  # type: ignore[method-assign]
        node._worker.finish = after.timing(node._worker.finish)  # type: ignore[method-assign]

        def answer(raw: bytes) -> None:
            node._on_cloud(deserialize_message(raw, PointCloud2), {})
            node._work()

        for scan in scans:
            raw = serialize_message(messages.cloud_to(scan.stamp_ns, "lidar", scan.points))
            pose = messages.odometry_to(scan.stamp_ns, "odom", "lidar", scan.T_odom_sensor)
            node._on_pose(pose)
            whole.timing(answer)(raw)
            if register_frame is not None:
                kiss.timing(register_frame)(scan.points, np.zeros(len(scan.points)))
        node.destroy_node()
        rclpy.try_shutdown()
    until_answer = np.subtract(whole.wall_ms, after.wall_ms)
    work_ms, work_cpu_ms = np.add(alone.wall_ms, after.wall_ms), np.add(alone.cpu_ms, after.cpu_ms)
    result: dict[str, Any] = {
        **{f"in_process_{k}": v for k, v in quantiles(until_answer[N_SKIPPED:]).items()},
        "registration_ms": mean(work_ms),
        "finish_ms": mean(after.wall_ms),
        "registration_cpu_ms": mean(work_cpu_ms),
        "kiss_icp_ms": mean(kiss.wall_ms) if register_frame is not None else None,
    }
    if register_frame is not None:
        result["ratio_to_kiss_icp"] = result["registration_ms"] / result["kiss_icp_ms"]
        result["kiss_icp_cpu_ms"] = mean(kiss.cpu_ms)
        result["cpu_ratio_to_kiss_icp"] = mean(work_cpu_ms) / result["kiss_icp_cpu_ms"]
    return result


def kiss_icp() -> Callable[..., Any] | None:
    """Return KISS-ICP's ``register_frame`` at its defaults, or None where it is not installed."""
    try:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        print("online: kiss-icp is not installed, nothing is compared with it", file=sys.stderr)
        return None
    config = load_config(None)
    config.data.deskew = False  # scans of a recording may come without the times of their points
    config.mapping.voxel_size = config.data.max_range / 100.0
    register: Callable[..., Any] = KissICP(config).register_frame
    return register


class Clock:
    """Wall and processor times of calls, in milliseconds."""

    def __init__(self) -> None:
        self.wall_ms: list[float] = []
        self.cpu_ms: list[float] = []

    def timing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, timed."""

        def timed(*values: Any) -> Any:
            wall_s, cpu_s = time.perf_counter(), time.process_time()
            try:
                return function(*values)
            finally:
                self.wall_ms.append(1e3 * (time.perf_counter() - wall_s))
                self.cpu_ms.append(1e3 * (time.process_time() - cpu_s))

        return timed


def loaded(
    rate_hz: float, seconds: float, n_points: int, parameters: dict[str, Any]
) -> dict[str, Any]:
    """Return what becomes of a node to which clouds come at a rate whatever it does."""
    from cello3d_ros.ros.replay import Player

    with started(parameters) as node:
        player = Player(DOMAIN_ID, check=node.check)
        sent = list(send(player, node, hall(n_points), rate_hz, seconds))
        player.spin_until(lambda: player.replay.is_settled(sent[-1][0]), 10.0)
        player.close()
        status = node.stop()
    poses, last = player.replay.poses, player.replay.last_status
    latency_ms = {
        stamp_ns: 1e3 * (poses[stamp_ns].received_s - player.replay.published_s[stamp_ns])
        for stamp_ns, _ in sent
        if stamp_ns in poses
    }
    answered_s = sorted(pose.received_s for pose in poses.values())
    parts = np.array_split(np.arange(len(sent)), max(round(seconds / 60), 5))
    minutes = [
        {
            **quantiles([latency_ms[sent[i][0]] for i in part if sent[i][0] in latency_ms]),
            "answered": sum(sent[i][0] in latency_ms for i in part),
            "sent": len(part),
            "memory_mb": sent[part[-1]][1],
        }
        for part in parts
    ]
    return {
        "rate_hz": rate_hz,
        "n_points": n_points,
        "seconds": seconds,
        "sent": len(sent),
        "received": int(last["received"]),
        "answered": len(poses),
        "answered_share": len(poses) / (len(sent) - int(last["references"])),
        "dropped": len(sent) - len(poses) - int(last["references"]),
        "dropped_by_reason": {
            key.removeprefix("dropped."): int(value)
            for key, value in last.items()
            if key.startswith("dropped.")
        },
        **quantiles(list(latency_ms.values())[N_SKIPPED:]),
        "max_ms": max(list(latency_ms.values())[N_SKIPPED:]),
        "work_ms": 1e3 * float(np.median(np.diff(answered_s)[N_SKIPPED:])),
        "memory_start_mb": sent[min(N_SKIPPED, len(sent) - 1)][1],
        "memory_end_mb": sent[-1][1],
        "memory_growth_mb": minutes[-1]["memory_mb"] - minutes[1]["memory_mb"],
        "minutes": minutes,
        "exit_status": status,
    }


def hall(n_points: int, n_places: int = 20) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return poses on a circle in a hall with a crate in it, and what is seen from each."""
    from cello3d_ros.tracking.warmup import room

    rng, places = np.random.default_rng(0), []
    for angle in np.linspace(0, 2 * np.pi, n_places, endpoint=False):
        T = se3.exp([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0, 0, 0, 0]) @ se3.exp(
            [0, 0, 0, 0, 0, angle]
        )
        points = room(rng, n_points * 4 // 5, 30.0)[:n_points]
        points += rng.normal(scale=0.01, size=points.shape)
        places.append((T, se3.transform(se3.inverse(T), points)))
    return places


def send(
    player: Any,
    node: NodeProcess,
    places: list[tuple[np.ndarray, np.ndarray]],
    rate_hz: float,
    seconds: float,
) -> Iterator[tuple[int, float]]:
    """Send clouds; yield the stamp of each and the memory of the node then, in MB."""
    from rclpy.serialization import serialize_message

    from cello3d_ros.ros import messages

    raw = [bytearray(serialize_message(messages.cloud_to(0, "lidar", p))) for _, p in places]
    player.connect(time.time_ns(), places[0][0], 120.0)
    next_s = time.monotonic()
    for i in range(round(seconds * rate_hz)):
        player.spin_for(next_s - time.monotonic())
        next_s += 1.0 / rate_hz
        stamp_ns, data = time.time_ns(), raw[i % len(raw)]
        stamp = np.array([stamp_ns // 10**9, stamp_ns % 10**9], dtype="<u4")
        data[4:12] = stamp.tobytes()  # the header's, after four bytes of CDR
        player.publish_odometry(stamp_ns, places[i % len(raw)][0])
        player.replay.published_s[stamp_ns] = time.monotonic()
        player.clouds.publish(bytes(data))
        for heard in (player.replay.raw, player.replay.markers, player.replay.odometry):
            heard.clear()  # this process must not grow
        yield stamp_ns, memory_mb(node.pid)


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024


def quantiles(values_ms: list[float]) -> dict[str, float | None]:
    """Return the median and the 95th percentile, None of nothing."""
    if not len(values_ms):
        return {"p50_ms": None, "p95_ms": None}
    p50, p95 = np.percentile(values_ms, [50, 95])
    return {"p50_ms": float(p50), "p95_ms": float(p95)}


def mean(values: Any) -> float:
    """Return the mean without the beginning."""
    return float(np.mean(values[N_SKIPPED:]))


if __name__ == "__main__":
    sys.exit(main())
