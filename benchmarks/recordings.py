"""Speed and memory of reading and converting recordings, on one core.

    python benchmarks/recordings.py [--gigabytes 2] [--folder /tmp]

Everything is made in a temporary folder and removed.  Megabytes are 1e6 bytes; of clouds their
PointCloud2 data are counted, of the conversion the peak resident memory of its own process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cello3d_ros.geometry import se3
from cello3d_ros.recordings import Scan, open_recording
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.tables import read_csv

N_POINTS = 120_000  # a 64-beam lidar
_CONVERT = """
import json, re, sys, time
from cello3d_ros.cli.main import main
started = time.process_time()
status = main(sys.argv[1:])
peak_kib = int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
print(json.dumps([status, time.process_time() - started, peak_kib * 1024 / 1e6]))
"""


def scans(n: int) -> Iterator[Scan]:
    """Yield scans of random points with odometry and ground truth, 16 bytes a point."""
    rng = np.random.default_rng(0)
    for k in range(n):
        yield Scan(
            stamp_ns=10**18 + k * 100_000_000,
            points=rng.normal(scale=20.0, size=(N_POINTS, 3)),
            intensity=rng.uniform(size=N_POINTS),
            T_world_sensor=se3.exp([0.1 * k, 0, 0, 0, 0, 0]),
            T_odom_sensor=se3.exp([0.1 * k, 0, 0, 0, 0, 0.001 * k]),
        )


def read_bag(path: Path) -> dict[str, float]:
    """Read all clouds of a bag."""
    started_cpu, started = time.process_time(), time.perf_counter()
    n_bytes = sum(16 * len(scan.points) for scan in open_recording(path))
    wall, cpu = time.perf_counter() - started, time.process_time() - started_cpu
    return {
        "mb": n_bytes / 1e6,
        "mb_per_cpu_s": n_bytes / cpu / 1e6,
        "mb_per_s": n_bytes / wall / 1e6,
    }


def read_asl(folder: Path) -> dict[str, float]:
    """Read one ASL cloud of 300 000 points from a file, three times."""
    rng = np.random.default_rng(0)
    n = 300_000
    rows = rng.normal(scale=8.0, size=(n, 3))
    lines = ["Time_in_sec,x,y,z,Intensities,2DscanId,PointId"]
    lines += [
        f"{1314117928.25 + 1e-5 * k:.8f},{x:.8f},{y:.8f},{z:.8f},-1.00000000,{k // 1077},{k}"
        for k, (x, y, z) in enumerate(rows)
    ]
    path = folder / "Hokuyo_0.csv"
    path.write_text("\n".join(lines) + "\n")
    best = np.inf
    for _ in range(3):
        started = time.process_time()
        read_csv(path.read_bytes(), path)
        best = min(best, time.process_time() - started)
    return {"points_per_cpu_s": n / best, "mb_per_cpu_s": path.stat().st_size / best / 1e6}


def convert(source: Path, out: Path, kind: str) -> dict[str, float]:
    """Convert in a process of its own."""
    words = ["convert", str(source), str(out), "--format", kind]
    done = subprocess.run(
        [sys.executable, "-c", _CONVERT, *words], capture_output=True, text=True, check=True
    )
    status, cpu_s, peak_mb = json.loads(done.stdout.splitlines()[-1])
    assert status == 0, done.stderr
    return {"cpu_s": cpu_s, "peak_mb": peak_mb}


def main() -> None:
    """Print one line of JSON for each figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=2.0)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    arguments = parser.parse_args()
    n = max(2, round(arguments.gigabytes * 1e9 / (16 * N_POINTS)))
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        print(json.dumps({"asl_csv": read_asl(folder)}), flush=True)
        write_bag(folder / "bag", scans(n))
        print(json.dumps({"read_mcap": read_bag(folder / "bag")}), flush=True)
        for kind in ("mcap", "kitti", "sqlite3"):
            figures = convert(folder / "bag", folder / kind, kind)
            print(json.dumps({f"convert_to_{kind}": figures}), flush=True)
            subprocess.run(["rm", "-r", str(folder / kind)], check=True)


if __name__ == "__main__":
    main()
