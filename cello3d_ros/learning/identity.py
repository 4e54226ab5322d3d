"""Which recording is which: names in manifests, and fingerprints of what the names stand for."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from itertools import islice

import numpy as np

from cello3d_ros.errors import DatasetError
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.recordings.recording import Recording

_N_SCANS = 2  # a second pose differs where only the poses were estimated anew


def fingerprint(recording: Recording) -> str:
    """Return what tells apart recordings of one name: a hash of the first two scans.

    Of each: stamp, points and true pose, to the last bit.  Two are quickly read from any format;
    what is only different later on is not noticed: crops of one drive that begin at the same
    scan are one recording, and crops that begin elsewhere are not known to overlap.
    """
    digest = hashlib.sha256()
    for scan in islice(recording, _N_SCANS):
        digest.update(f"{scan.stamp_ns} {len(scan.points)}".encode())
        for array in (scan.points, scan.T_world_sensor):
            if array is not None:
                digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()[:32]


def recordings_of(datasets: Iterable[Dataset]) -> dict[str, str]:
    """Return the recordings that the manifests name: name -> fingerprint, "" if not known.

    Raises DatasetError where a folder holds pairs of a recording that its manifest does not name,
    and where two folders mean different recordings by one name.
    """
    known: dict[str, str] = {}
    for dataset in datasets:
        named = {n: str(f.get("fingerprint", "")) for n, f in dataset.recordings.items()}
        if strange := sorted({key[0] for key in dataset.pair_keys()} - set(named)):
            raise DatasetError(
                f"{dataset.path} holds pairs of {strange[0]!r}, which its manifest does not name: "
                "whence they are is not known"
            )
        for name, found in named.items():
            if found and known.get(name) and found != known[name]:
                raise DatasetError(
                    f"{dataset.path}: {name!r} is another recording than that of this name in an "
                    "earlier dataset; rename one of them and sample it again"
                )
            known[name] = found or known.get(name, "")
    return known


def check_apart(known: dict[str, str], *uses: Iterable[str]) -> None:
    """Raise DatasetError where recordings of two uses are one recording under two names."""
    seen: dict[str, tuple[str, int]] = {}
    for use, names in enumerate(uses):
        for name in names:
            twin, its_use = seen.setdefault(known[name] or name, (name, use))
            if its_use != use:
                raise DatasetError(
                    f"{twin!r} and {name!r} are the same recording under two names: both must be "
                    "trained on, validated on or excluded"
                )
