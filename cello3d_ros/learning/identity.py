"""Which recording is which: names in manifests, and fingerprints of what the names stand for."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice

import numpy as np

from cello3d_ros.errors import DatasetError, RecordingError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.dataset import Dataset
from cello3d_ros.recordings.recording import Recording

_N_DIGITS = 16
_N_SCANS = 2  # a second pose differs where only the poses were estimated anew


def fingerprint(recording: Recording) -> str:
    """Return what tells apart recordings of one name: a hash of the first two scans.

    Of each: stamp, points and true pose, to the last bit.  Two are quickly read from any format;
    what is only different later on is not noticed.
    """
    digest = hashlib.sha256()
    for scan in islice(recording, _N_SCANS):
        digest.update(f"{scan.stamp_ns} {len(scan.points)}".encode())
        for array in (scan.points, scan.T_world_sensor):
            if array is not None:
                digest.update(_bytes(array))
    return digest.hexdigest()[:32]


def scan_prints(recording: Recording) -> list[str]:
    """Return a hash of the points of each scan, by which crops of one drive know each other.

    Stamps and poses do not matter, scans without points have none.  Empty for a recording that
    cannot be read to its end: whoever samples it will say what is wrong.
    """
    try:
        clouds = [(len(scan.points), hashlib.sha256(_bytes(scan.points))) for scan in recording]
    except RecordingError:
        return []
    if len(clouds) < len(recording):
        return []
    return [digest.hexdigest()[:_N_DIGITS] for n_points, digest in clouds if n_points]


def prints_of(datasets: Iterable[Dataset], names: Iterable[str] = ()) -> dict[str, set[str]]:
    """Return fingerprints and scan prints of recordings, as far as the manifests know them.

    names: recordings that are there in any case.
    """
    known: dict[str, set[str]] = {name: set() for name in names}
    for dataset in datasets:
        for name, facts in dataset.recordings.items():
            prints = {str(facts.get("fingerprint", "")), *map(str, facts.get("scans", []))}
            known.setdefault(name, set()).update(prints - {""})
    return known


def recordings_of(datasets: Sequence[Dataset]) -> dict[str, set[str]]:
    """Return the recordings that the manifests name, each with its prints.

    Raises DatasetError where a folder holds pairs of a recording that its manifest does not name,
    and where two folders mean different recordings by one name.
    """
    known: dict[str, str] = {}
    for dataset in datasets:
        named = {n: str(f.get("fingerprint", "")) for n, f in dataset.recordings.items()}
        if strange := sorted({key[0] for key in dataset.pair_keys()} - set(named)):
            raise DatasetError(
                f"{dataset.path} holds pairs of {strange[0]!r}, which its manifest does not name; "
                "sample it again"
            )
        for name, found in named.items():
            if found and known.get(name) and found != known[name]:
                raise DatasetError(
                    f"{dataset.path}: {name!r} is another recording than that of this name in an "
                    "earlier dataset; rename one of them and sample it again"
                )
            known[name] = found or known.get(name, "")
    return prints_of(datasets)


def check_apart(known: Mapping[str, set[str]], *uses: Iterable[str]) -> None:
    """Raise DatasetError where recordings of two uses share a scan."""
    seen: dict[str, tuple[str, int]] = {}
    for use, names in enumerate(uses):
        for name in names:
            for print_ in sorted(known[name]):
                twin, its_use = seen.setdefault(print_, (name, use))
                if its_use != use:
                    raise DatasetError(
                        f"{twin!r} and {name!r} are the same recording under two names, or share "
                        "scans: both must be trained on, validated on or excluded"
                    )


def _bytes(array: Array) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()
