"""How well scans taken in motion register, with and without that motion undone.

python benchmarks/motion.py [--scans 8] [--seeds 3]

Each row is a simulated drive.  The error is that of the translation of a step between neighbouring
scans, started at the truth, in mm (root mean square): of frozen scans, of scans as they come, and
of scans undone by the exact track, by the odometry at 100 Hz (it drifts by 0.5 percent) and by the
velocity of the last registration, reading and reference alike.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from cello3d_ros.clouds.motion import undistorted
from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import Pipeline
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.motion import Motion
from cello3d_ros.recordings.deskew import deskew
from cello3d_ros.registration.icp import register
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.products import SCANNERS
from cello3d_ros.simulation.simulation import Simulation

DRIVES = {
    "10 m/s": Drive(speed_m_s=10.0, turn_rad_s=1.0),
    "1 rad/s": Drive(motion="spin", turn_rad_s=1.0),
}
WORLDS = ("street", "parking", "square", "office")
PIPELINE = Pipeline()
ICP = replace(PIPELINE.icp, n_reference_points=0, n_reading_points=5000)


def step(reference, reading, T, k: int):
    """Return the step that a registration started at the truth finds.  Clouds are (N, 3)."""
    clouds = [prepare(c, PIPELINE.cloud, np.random.default_rng(0)) for c in (reading, reference)]
    return register(*clouds, T, ICP, np.random.default_rng(k)).T_ref_read


def errors_m(scans, clouds) -> list[float]:
    """Return the errors of steps between neighbours; ``clouds`` None: by the last velocity."""
    found, velocity = [], None
    for k in range(1, len(scans)):
        a, b = scans[k - 1 : k + 1]
        T = se3.inverse(a.T_world_sensor) @ b.T_world_sensor
        if clouds is not None:
            pair = clouds[k - 1 : k + 1]
        elif velocity is None:
            pair = [a.points, b.points]
        else:
            motion = Motion.constant(velocity)
            pair = [undistorted(s.points, s.time_s, motion) for s in (a, b)]
        T_hat = step(*pair, T, k)
        velocity = se3.log(T_hat) / (1e-9 * (b.stamp_ns - a.stamp_ns))
        found.append(float(np.linalg.norm(se3.log(se3.inverse(T) @ T_hat)[:3])))
    return found[1:]  # the first has no registration before it


def row(world: str, scanner: str, drive: Drive, seeds: int, n_scans: int) -> list[float]:
    """Return the errors of a drive: frozen, as it comes, exact, odometry, last registration."""
    found: list[list[float]] = [[] for _ in range(5)]
    for seed in range(1, seeds + 1):
        still = replace(drive, sweeps=False)
        frozen = list(Simulation(world, seed, n_scans, SCANNERS[scanner], drive=still))
        simulation = Simulation(world, seed, n_scans, SCANNERS[scanner], drive=drive)
        swept = list(simulation)
        tracks = simulation.true_track(), simulation.track()
        undone = [[deskew(scan, track) for scan in swept] for track in tracks]
        kinds = [frozen, swept, *undone]
        for errors, scans in zip(found, kinds):
            errors += errors_m(scans, [scan.points for scan in scans])
        found[4] += errors_m(swept, None)
    return [float(np.sqrt(np.mean(np.square(errors)))) for errors in found]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    print("| drive | frozen | as it comes | exact track | odometry | last registration |")
    print("|---|---|---|---|---|---|", flush=True)
    for motion, drive in DRIVES.items():
        for world in WORLDS:
            for scanner in ("os1_64", "vlp16"):
                found = row(world, scanner, drive, arguments.seeds, arguments.scans)
                mm = [1e3 * e for e in found]
                numbers = " | ".join(f"{e:.1f} ({e / mm[0]:.2f})" for e in mm[1:])
                print(f"| {world}, {scanner}, {motion} | {mm[0]:.1f} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
