"""An alignment in files and in words."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cello3d_ros.atomic import new_file
from cello3d_ros.recordings.poses import kitti_line, tum_line

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cello3d_ros.learning.align import Alignment

KITTI = ".txt"
_MOST_NAMED = 10


def write_poses(path: Path, alignment: Alignment, n_scans: int) -> list[Path]:
    """Write a TUM file for each part, the longest to ``path``; return their paths.

    ``.txt`` is a KITTI file: a row a scan without stamps.  Where not all ``n_scans`` of the
    recording have a pose in one part no such file can be written, and TUM files are.
    """
    if path.suffix == KITTI:
        if len(alignment.members()) == n_scans:
            with new_file(path) as partial:
                partial.write_text("".join(map(kitti_line, alignment.poses)), encoding="utf-8")
            return [path]
        path = path.with_suffix(".tum")
    numbers = range(2, alignment.n_parts + 1)
    paths = [path, *(path.with_suffix(f".{number}.tum") for number in numbers)]
    for part, file in enumerate(paths):
        with new_file(file) as partial:
            lines = (
                tum_line(int(alignment.stamps_ns[k]), alignment.poses[k])
                for k in alignment.members(part)
            )
            partial.write_text("".join(lines), encoding="utf-8")
    return paths


def as_dict(alignment: Alignment) -> dict[str, Any]:
    """Return the report: how good the poses are, and every scan's part or why it is left out.

    sigma_m, sigma_rad: of a scan, roots of the traces of its covariance's halves.
    """
    sigma_m, sigma_rad = alignment.sigmas()
    pairwise_m, pairwise_rad = alignment.pairwise_rms()
    variances = np.diagonal(alignment.covariances, axis1=1, axis2=2)
    sigmas = np.sqrt(np.stack([variances[:, :3].sum(axis=1), variances[:, 3:].sum(axis=1)]))
    scans = [
        {
            "scan": k,
            "stamp_ns": int(alignment.stamps_ns[k]),
            "part": int(alignment.part[k]),
            "reason": alignment.reasons.get(k, ""),
            "sigma_m": float(sigmas[0, k]),
            "sigma_rad": float(sigmas[1, k]),
            "covariance": alignment.covariances[k].ravel().tolist(),
        }
        for k in range(len(alignment.part))
    ]
    return {
        "recording": alignment.name,
        "n_scans": len(alignment.part),
        "n_aligned": int((alignment.part >= 0).sum()),
        "n_parts": alignment.n_parts,
        "step_sigma_m": sigma_m,
        "step_sigma_rad": sigma_rad,
        "pairwise_rms_m": pairwise_m,
        "pairwise_rms_rad": pairwise_rad,
        "moves_m": list(alignment.moves_m),
        "n_contradicted": alignment.n_contradicted,
        "n_searched": alignment.n_searched,
        "motion_compensated": alignment.compensated,
        "carried": None if alignment.carried is None else alignment.carried._asdict(),
        "smear": None if alignment.smear is None else alignment.smear._asdict(),
        "scans": scans,
    }


def sentences(alignment: Alignment) -> Iterator[str]:
    """Yield what a user should know."""
    n, n_aligned = len(alignment.part), int((alignment.part >= 0).sum())
    sigma_m, sigma_rad = alignment.sigmas()
    pairwise_m, _ = alignment.pairwise_rms()
    yield f"{alignment.name}: {n_aligned} of {n} scans aligned in {len(alignment.moves_m)} sweeps"
    yield (
        f"a step is known to {1e3 * sigma_m:.1f} mm and {1e3 * sigma_rad:.2f} mrad; registrations "
        f"of pairs scatter by {1e3 * pairwise_m:.1f} mm about it"
    )
    if pairwise_m < 2.0 * sigma_m:
        yield "warning: these poses are hardly better than registrations of pairs"
    if alignment.n_parts > 1:
        yield (
            f"the recording falls into {alignment.n_parts} parts; no pose between them is known, "
            "each has a file of its own"
        )
    if alignment.n_contradicted:
        n_steps = alignment.n_contradicted
        yield (
            f"the poses to start from are off by more than 0.5 m or 0.2 rad from the clouds in "
            f"{n_steps} {'step' if n_steps == 1 else 'steps'}; the clouds were followed"
        )
    if alignment.compensated:
        yield "the motion within each scan was undone"
    yield from _warnings(alignment)
    grouped: dict[str, list[int]] = {}
    for k, reason in alignment.reasons.items():
        grouped.setdefault(reason, []).append(k)
    for reason, scans in grouped.items():
        more = f" and {len(scans) - _MOST_NAMED} more" if len(scans) > _MOST_NAMED else ""
        named = ", ".join(map(str, scans[:_MOST_NAMED]))
        word = "scan" if len(scans) == 1 else "scans"
        yield f"left out: {word} {named}{more}: {reason}"


def _warnings(alignment: Alignment) -> Iterator[str]:
    """Yield what is wrong with the surroundings or the scans."""
    if not alignment.rests:
        yield (
            "warning: the poses do not come to rest, the last sweep changed the median step by "
            f"{1e3 * alignment.moves_m[-1]:.1f} mm: the surroundings hold the motion weakly, as a "
            "tunnel does, and errors may be far larger than stated; start from odometry or --poses"
        )
    smear = alignment.smear
    if smear is not None and smear.is_smeared and alignment.rests:
        yield (
            f"warning: the sensor's motion smears the scans: {100 * smear.share:.0f} % of the "
            f"{1e3 * smear.moved_m:.0f} mm that surroundings move from scan to scan is within a "
            f"scan, and without it scans would fit to {1e3 * smear.undone_m:.1f} instead of "
            f"{1e3 * smear.as_is_m:.1f} mm; record the times of points, or undo the motion before"
        )
    carried = alignment.carried
    if carried is not None and carried.is_many:
        yield (
            f"warning: {100 * carried.share:.0f} % of the points move with the sensor, most of "
            f"them within {carried.reach_m:.1f} m: what carries it pulls registrations towards no "
            "motion; leave it out by cloud.min_range_m"
        )
