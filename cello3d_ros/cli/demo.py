"""``cello3d demo``: replay a recording through the node, over real DDS, and judge its answers."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cello3d_ros.atomic import new_file, new_folder
from cello3d_ros.cli.sources import add_source_arguments, open_source
from cello3d_ros.errors import Cello3dError
from cello3d_ros.geometry.gaussian import mahalanobis, to_fixed_axes
from cello3d_ros.geometry.se3 import Array, inverse, log, transform
from cello3d_ros.learning.measures import verdict
from cello3d_ros.recordings import Recording

if TYPE_CHECKING:
    from cello3d_ros.ros.process import NodeProcess
    from cello3d_ros.ros.replay import Replay

_LAST_DOMAIN = 232  # of DDS
_CHI2_6_95 = 12.591587  # 95 % of a chi-squared distribution of 6 degrees of freedom
_SLICE_M, _SLICE_POINTS = 1.0, 3000  # of each scan: what the picture shows of the surroundings
_ROS_IS_MISSING = (
    "the demo needs ROS 2: source /opt/ros/jazzy/setup.bash, or pip install 'cello3d_ros[ros]'; "
    "cello3d replay {} --out answers runs the same without ROS"
)

_WITHOUT_ODOMETRY = (
    "node.guess_without_odometry:=constant_velocity",
    "node.odometry_timeout_s:=0.0",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument(
        "--recording", type=Path, help="bag or KITTI folder; by default the bag of the package"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("build/demo"), help="folder of the results (build/demo)"
    )
    parser.add_argument(
        "--model", default="", help="model file or name of a shipped one (general)"
    )
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="clouds a second (each waits for the answer)"
    )
    parser.add_argument(
        *("-p", "--param"),
        action="append",
        default=[],
        metavar="NAME:=VALUE",
        help="parameter of the node; may be repeated",
    )
    add_source_arguments(parser)
    parser.add_argument(
        "--domain-id", type=_domain, metavar="N", help="ROS domain of the demo (one of its own)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Leave summary.json, trajectory.png and the node's messages; 1 if an answer is missing."""
    if arguments.rate is not None and not arguments.rate > 0:
        raise Cello3dError(f"--rate must be above 0: {arguments.rate}")
    arguments.recording = arguments.recording or demo_bag()
    recording = open_source(arguments.recording, arguments)
    out: Path = arguments.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Cello3dError(f"cannot make {out}: {error.strerror}") from None
    replay, complaint, memory_mb = _replay(recording, arguments)
    summary = judge(replay, len(recording) - 1)
    summary["peak_memory_mb"] = memory_mb
    summary["model"] = replay.last_status.get("model")
    _write_summary(out / "summary.json", summary)
    if replay.raw:
        from cello3d_ros.recordings.bag_writer import write_raw

        with new_folder(out / "bag", replace=True) as folder:
            write_raw(folder, replay.raw)
        draw(replay, recording.name, surroundings(replay, recording), out / "trajectory.png")
    print("\n".join(table(summary, recording.name)))
    print(f"\n{out}: summary.json, trajectory.png, bag, node.log")
    if complaint is None and summary["relative_poses"] < summary["pairs_expected"]:
        last = replay.last_status.get("last_failure") or "clouds were lost on the way"
        n, expected = summary["relative_poses"], summary["pairs_expected"]
        complaint = f"{n} of {expected} pairs were answered; the last failure: {last}"
    if complaint is not None:
        raise Cello3dError(complaint)
    return 0


def _domain(word: str) -> int:
    if not 0 <= (number := int(word)) <= _LAST_DOMAIN:
        raise argparse.ArgumentTypeError(f"must be 0 to {_LAST_DOMAIN}: {word}")
    return number


def demo_bag() -> Path:
    """Return the bag that comes with the package: in its source tree or in share/.

    Raises Cello3dError.
    """
    for folder in Path(__file__).resolve().parents:
        for place in ("bags/demo", "share/cello3d_ros/bags/demo"):
            if (folder / place / "metadata.yaml").exists():
                return folder / place
    raise Cello3dError("the demo bag is not installed: name a recording with --recording")


def judge(replay: Replay, n_pairs: int) -> dict[str, Any]:
    """Compare the answers with ground truth; what cannot be said is None.

    A relative pose is off by ``xi = log(inverse(T_true) T_hat)``, to which its covariance,
    turned back to the reading's side, belongs.
    """
    xi, Y = _errors(replay)
    distances = mahalanobis(xi, Y) if len(xi) else np.empty(0)
    latencies = replay.latencies_ms()
    status = replay.last_status
    matrices = [p.C for p in (*replay.relative.values(), *replay.poses.values())]
    return {
        "pairs_expected": n_pairs,
        "relative_poses": len(replay.relative),
        "poses": len(replay.poses),
        "median_translation_error_m": _or_none(np.median, np.linalg.norm(xi[:, :3], axis=1)),
        "final_translation_error_m": _final_error_m(replay),
        "mean_mahalanobis_6dof": _or_none(np.mean, distances),
        "mean_d2_over_6": _or_none(np.mean, distances**2 / 6.0),
        "coverage_95": _or_none(np.mean, distances**2 < _CHI2_6_95),
        "min_eigenvalue": min((float(np.linalg.eigvalsh(C)[0]) for C in matrices), default=None),
        "latency_ms": {
            "p50": _or_none(np.median, latencies),
            "p95": _or_none(lambda values: np.percentile(values, 95), latencies),
        },
        "dropped": len(replay.published_s)
        - int(status.get("received", 0))
        + int(status.get("dropped", 0)),
        "chain_restarts": int(status.get("chain_restarts", 0)),
    }


def _errors(replay: Replay) -> tuple[Array, Array]:
    """Return the errors (n, 6) of the relative poses and their covariances (n, 6, 6)."""
    xi, Y = [], []
    for stamp_ns, pose in replay.relative.items():
        reference_ns = int(replay.status.get(stamp_ns, {}).get("reference_stamp_ns", -1))
        T_ref, T_read = replay.T_world.get(reference_ns), replay.T_world.get(stamp_ns)
        if T_ref is None or T_read is None:
            continue
        xi.append(log(inverse(inverse(T_ref) @ T_read) @ pose.T))
        Y.append(to_fixed_axes(pose.T[:3, :3].T, pose.C))
    return np.reshape(xi, (-1, 6)), np.reshape(Y, (-1, 6, 6))


def _T_world_odom(replay: Replay) -> Array | None:
    """Return the odometry's frame in that of ground truth, equal at the first scan.

    Without odometry the node starts at the identity.
    """
    first_ns = next(iter(replay.T_odom or replay.T_world), None)
    if first_ns is None or (T_world := replay.T_world.get(first_ns)) is None:
        return None
    return T_world @ inverse(replay.T_odom.get(first_ns, np.eye(4)))


def _final_error_m(replay: Replay) -> float | None:
    T_world_odom = _T_world_odom(replay)
    if T_world_odom is None or not replay.poses:
        return None
    stamp_ns = max(replay.poses)
    if (T_true := replay.T_world.get(stamp_ns)) is None:
        return None
    T_hat = T_world_odom @ replay.poses[stamp_ns].T
    return float(np.linalg.norm(T_hat[:3, 3] - T_true[:3, 3]))


def surroundings(replay: Replay, recording: Recording) -> Array:
    """Return (n, 2) points near the sensor's height, from above, placed by the node's poses."""
    rng, rows = np.random.default_rng(0), [np.empty((0, 2))]
    for scan in recording:
        if (pose := replay.poses.get(scan.stamp_ns)) is not None:
            points = scan.points[np.abs(scan.points[:, 2]) < _SLICE_M]
            points = points[rng.permutation(len(points))[:_SLICE_POINTS]]
            rows.append(transform(pose.T, points)[:, :2])
    return np.vstack(rows)


def draw(replay: Replay, name: str, around: Array, path: Path) -> None:
    """Write the top view: surroundings, truth, odometry, the chain of poses, 3-sigma ellipses.

    around: (n, 2) points in the frame of odometry.  Ellipses too small to be seen are drawn
    10, 100, ... times as large; the legend says so.
    """
    from matplotlib.figure import Figure

    T_world_odom = _T_world_odom(replay)
    M = np.eye(4) if T_world_odom is None else T_world_odom
    truth = np.array([T[:2, 3] for T in replay.T_world.values() if T is not None])
    odometry = np.array([(M @ T)[:2, 3] for T in replay.T_odom.values()])
    poses = [pose for _, pose in sorted(replay.poses.items())]
    start = odometry[0] if len(odometry) else M[:2, 3]
    icp = np.array([start, *((M @ pose.T)[:2, 3] for pose in poses)])
    figure = Figure(figsize=(8, 8), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    points = np.column_stack([around, np.zeros(len(around))])
    axes.plot(*transform(M, points)[:, :2].T, ",", color="0.6", zorder=0)
    axes.plot([], [], ".", color="0.6", label="surroundings")
    if len(truth):
        axes.plot(*truth.T, color="black", linewidth=4, alpha=0.3, label="ground truth")
    if len(odometry):
        axes.plot(*odometry.T, color="tab:orange", linestyle="--", label="odometry")
    axes.plot(*icp.T, color="tab:blue", marker=".", label="ICP (~/pose of the node)")
    B = M[:3, :3]
    _draw_ellipses(axes, icp[1:], [(B @ pose.C[:3, :3] @ B.T)[:2, :2] for pose in poses])
    axes.plot(*icp[0], "o", color="tab:green", markersize=11, label="start")
    axes.plot(*icp[-1], "s", color="tab:purple", markersize=11, label="end")
    center, half = (icp.max(axis=0) + icp.min(axis=0)) / 2, max(1.0, np.ptp(icp, axis=0).max())
    axes.set(xlim=center[0] + [-half, half], ylim=center[1] + [-half, half], aspect="equal")
    axes.set(xlabel="x in m", ylabel="y in m", title=f"{name}: top view")
    axes.grid(alpha=0.3)
    axes.legend()
    with new_file(path) as partial:
        figure.savefig(partial, format="png")


def _draw_ellipses(axes: Any, centers: Array, covariances: list[Array]) -> None:
    """Draw ellipses of 3 standard deviations.  centers: (n, 2); covariances: n times (2, 2)."""
    from matplotlib.patches import Ellipse

    if not len(centers):
        return
    extent = np.ptp(centers, axis=0).max()
    largest = 6.0 * np.sqrt(max(np.linalg.eigvalsh(C)[-1] for C in covariances))
    scale = 1.0
    while 0.0 < largest * scale < 0.05 * extent:
        scale *= 10.0
    label = "3 sigma" if scale == 1.0 else f"3 sigma, drawn {scale:.0f} times as large"
    for i, (center, C) in enumerate(zip(centers, covariances, strict=True)):
        values, vectors = np.linalg.eigh(C)
        axes.add_patch(
            Ellipse(
                (float(center[0]), float(center[1])),
                *(6.0 * scale * np.sqrt(values)),
                angle=float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))),
                fill=False,
                color="tab:red",
                label=label if i == 0 else None,
            )
        )


def table(summary: dict[str, Any], name: str) -> Iterator[str]:
    """Yield the lines that a person reads."""
    latency = summary["latency_ms"]
    rows = [
        ("pairs answered", f"{summary['relative_poses']} of {summary['pairs_expected']}", ""),
        ("clouds dropped", str(summary["dropped"]), ""),
        ("median error of a pair", _text(summary["median_translation_error_m"], "m"), ""),
        ("error at the end", _text(summary["final_translation_error_m"], "m"), ""),
        ("mean Mahalanobis", _text(summary["mean_mahalanobis_6dof"]), "2.35 is ideal"),
        ("95 % coverage", _text(summary["coverage_95"]), "0.95 is ideal"),
        ("latency p50", _text(latency["p50"], "ms"), "from publishing a cloud to its pose"),
        ("latency p95", _text(latency["p95"], "ms"), ""),
        ("node's memory", _text(summary["peak_memory_mb"], "MB"), "at its peak"),
    ]
    yield f"{name}, model {summary['model'] or 'unknown'}"
    for what, value, note in rows:
        yield f"  {what:24}{value:>14}   {note}".rstrip()
    ratio = summary["mean_d2_over_6"]
    if ratio is None and summary["relative_poses"]:
        yield "The recording has no ground truth, so the covariance cannot be judged."
    elif ratio is not None:
        yield f"The covariance is {verdict(ratio)} (D2/6 {ratio:.2g}; 1 is right)."


def _replay(
    recording: Recording, arguments: argparse.Namespace
) -> tuple[Replay, str | None, float | None]:
    """Play into a node of our own.  Returns what was heard, a complaint, the node's memory."""
    from cello3d_ros.covariance.model import find_model
    from cello3d_ros.ros.process import NodeProcess, environment

    domain_id = arguments.domain_id
    if domain_id is None:
        domain_id = 1 + os.getpid() % 100
    os.environ.update(environment(domain_id))
    try:
        from cello3d_ros.ros.replay import Player
    except ImportError as error:
        raise Cello3dError(f"{_ROS_IS_MISSING.format(arguments.recording)} ({error})") from None
    parameters = [*(() if recording.has_odometry else _WITHOUT_ODOMETRY), *arguments.param]
    given = [word for text in parameters for word in ("-p", text)]
    if arguments.model:
        given += ["-p", f"node.model:={find_model(arguments.model).resolve()}"]
    print("Starting covariance_node; its first start compiles for half a minute.", flush=True)
    with (
        NodeProcess(arguments.out / "node.log", domain_id, ros_arguments=given) as node,
        _bar(len(recording)) as bar,
    ):

        def watch() -> None:
            node.check()
            bar.update(0)

        player = Player(domain_id, check=watch)
        try:
            complaint = _play(player, recording, arguments.rate, bar)
        finally:
            player.close()
        memory_mb = node.peak_memory_mb
        return player.replay, complaint or _stopped(node), memory_mb


def _bar(n_scans: int) -> Any:
    """Return a bar of progress whose seconds go on while the node starts."""
    from tqdm import tqdm

    often_s = 0.1 if sys.stdout.isatty() else 5.0
    return tqdm(total=n_scans, unit="scan", file=sys.stdout, mininterval=often_s, miniters=0)


def _play(player: Any, recording: Recording, rate_hz: float | None, bar: Any) -> str | None:
    """Play with a bar of progress; return what went wrong, in one sentence."""
    from cello3d_ros.ros.replay import play

    try:
        play(player, recording, rate_hz, progress=lambda n: bar.update(n - bar.n))
    except Cello3dError as error:
        return str(error)
    return None


def _stopped(node: NodeProcess) -> str | None:
    """Stop the node; return a complaint if it did not leave as it should."""
    status = node.stop()
    return None if status == 0 else f"covariance_node ended with status {status}, not 0"


def _write_summary(path: Path, summary: dict[str, Any]) -> None:
    with new_file(path) as partial:
        partial.write_text(json.dumps(summary, indent=2) + "\n")


def _or_none(function: Any, values: Any) -> float | None:
    return float(function(values)) if len(values) else None


def _text(value: float | None, unit: str = "") -> str:
    return "unknown" if value is None else f"{value:.3g} {unit}".strip()
