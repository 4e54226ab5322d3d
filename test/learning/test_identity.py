"""Which recordings are one, and which share scans."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from cello3d_ros.errors import DatasetError, RecordingError
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.learning.identity import check_apart, fingerprint, prints_of, scan_prints
from cello3d_ros.recordings.recording import Scan


class Drive:
    """Some scans of a drive, or a crop of them."""

    def __init__(self, name: str, scans: list[Scan], n_readable: int = 99) -> None:
        self.name, self.scans, self.n_readable = name, scans, n_readable

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Scan]:
        for k, scan in enumerate(self.scans):
            if k == self.n_readable:
                raise RecordingError("damaged")
            yield scan


def scans(n: int, seed: int = 0) -> list[Scan]:
    rng = np.random.default_rng(seed)
    return [
        Scan(stamp_ns=k, points=rng.normal(size=(50, 3)), T_world_sensor=np.eye(4))
        for k in range(n)
    ]


def facts(drive: Drive) -> dict[str, object]:
    return {"fingerprint": fingerprint(drive), "scans": scan_prints(drive)}


def test_crops_of_one_drive_that_overlap_are_kept_apart_from_no_other_use(tmp_path) -> None:
    drive = scans(10)
    crops = {
        "whole": drive,
        "front": drive[:6],
        "overlapping": [replace(s, stamp_ns=s.stamp_ns + 7) for s in drive[5:]],
        "back": drive[6:],
        "other": scans(10, seed=1),
    }
    dataset = open_dataset(tmp_path / "set", create=True)
    for name, part in crops.items():
        dataset.add_recording(name, facts(Drive(name, part)))
    known = prints_of([open_dataset(tmp_path / "set")])
    check_apart(known, ["front"], ["back", "other"])
    check_apart(known, ["front", "overlapping", "whole"], ["other"])
    for other in ("whole", "overlapping"):
        with pytest.raises(DatasetError, match=f"'front' and '{other}' .* share scans"):
            check_apart(known, ["front"], [other])


def test_scans_without_points_are_no_evidence() -> None:
    empty = Scan(stamp_ns=0, points=np.empty((0, 3)), T_world_sensor=None)
    assert scan_prints(Drive("a", [empty, *scans(2)])) == scan_prints(Drive("b", scans(2)))


def test_a_recording_that_cannot_be_read_to_its_end_has_no_prints_yet() -> None:
    assert scan_prints(Drive("a", scans(4), n_readable=3)) == []
    assert len(scan_prints(Drive("a", scans(4)))) == 4
