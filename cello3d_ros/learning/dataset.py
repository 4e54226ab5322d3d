"""A dataset on disk: one folder, one manifest, one file a pair.

    DATASET/manifest.json                     format, conventions, configuration, recordings
    DATASET/pairs/<recording>_<i>_<j>.npz     one pair, accepted or not: it is done

Files appear whole: they are written under a temporary name and moved into place.  The same
content gives the same bytes.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import platform
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.atomic import new_file
from cello3d_ros.config import Pipeline, SamplingConfig, config_from, config_to, pipeline_of
from cello3d_ros.covariance.archive import read_arrays, write_arrays
from cello3d_ros.covariance.features import FEATURES
from cello3d_ros.errors import ConfigError, DatasetError, ModelError, WriteError
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.geometry.se3 import Array

FORMAT = 2
UNDONE = "undone"  # the fact "motion" of a recording: points are as seen at the stamps
CONVENTIONS = (
    "T_ref_read maps reading points into the reference frame; xi = (u, omega) = "
    "log(inverse(T_mean) T_hat); covariances about ground truth, on the reading side"
)
_PACKAGES = ("cello3d_ros", "numpy", "scipy", "numba")
_ARRAYS = {
    "T_mean": "<f8",
    "xi": "<f8",
    "kept": "|b1",
    "covariance": "<f8",
    "descriptors": "<f4",
    "features": "<f8",
    "rotations_rad": "<f8",
}
_HEADER = ("recording", "i", "j", "accepted", "reason", "n_converged", "n_failed", "overlap_ratio")
_ITEMS = {"header": "|u1", "shapes": "<f8", **_ARRAYS}


@dataclass(frozen=True, kw_only=True)
class PairRecord:
    """What brute force found out about one pair; a rejected pair leaves out what it lacks.

    ``kept`` says which of ``xi`` made the covariance Y, about ground truth, reading side.
    ``features`` are those that ``FEATURES`` names.  ``descriptors[r]`` and, by adjoints, the
    covariance describe the pair turned about z of the reading frame by ``rotations_rad[r]``;
    ``covariance`` and ``shapes`` themselves are not turned.
    """

    recording: str
    i: int  # reference
    j: int  # reading
    accepted: bool
    T_mean: Array  # (4, 4) ground truth
    reason: str = ""  # why rejected: "no_overlap", "offset", "no_cluster", "singular" ...
    xi: Array = field(default_factory=lambda: np.zeros((0, 6)))  # (n, 6) all finite results
    kept: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))  # (n,)
    n_converged: int = 0
    n_failed: int = 0
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (6, 6) Y
    descriptors: NDArray[np.float32] = field(  # (n_rotations, D)
        default_factory=lambda: np.zeros((0, 0), np.float32)
    )
    features: Array = field(default_factory=lambda: np.zeros(0))  # (len(FEATURES),)
    rotations_rad: Array = field(default_factory=lambda: np.zeros(0))  # (n_rotations,)
    shapes: dict[str, Array] = field(default_factory=dict)  # "hessian", "sandwich": (6, 6)
    overlap_ratio: float = 0.0

    @property
    def n_samples(self) -> int:
        """Registrations of the pair, with and without an answer."""
        return len(self.xi) + self.n_failed

    @property
    def key(self) -> tuple[str, int, int]:
        """Name of the pair: recording, reference, reading."""
        return self.recording, self.i, self.j


class Dataset:
    """An open dataset folder; iterating gives the records ordered by recording, i, j."""

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        self.path = path
        self._manifest = manifest
        try:
            config = config_from(manifest["configuration"], str(path / "manifest.json"))
        except (ConfigError, KeyError) as error:
            raise DatasetError(
                f"{path}: the manifest's configuration is damaged: {error}"
            ) from None
        self.pipeline: Pipeline = pipeline_of(config)
        self.sampling: SamplingConfig = config.sampling

    @property
    def recordings(self) -> dict[str, dict[str, Any]]:
        """Facts about each recording as given to ``add_recording``."""
        return dict(self._manifest["recordings"])

    @property
    def versions(self) -> dict[str, str]:
        """Packages with which the folder was begun."""
        return dict(self._manifest["versions"])

    def add_recording(self, name: str, facts: dict[str, Any]) -> None:
        """Enter a recording in the manifest.  Raises DatasetError if its facts have changed.

        Facts that an older manifest does not know are added.
        """
        _check_name(name)
        known = self._manifest["recordings"].get(name, {})
        facts = json.loads(json.dumps(facts))
        if change := _first_difference(known, {n: facts.get(n) for n in known}):
            raise DatasetError(f"{self.path} holds another recording named {name!r}: {change}")
        if known != {**known, **facts} or name not in self._manifest["recordings"]:
            recordings = {**self._manifest["recordings"], name: {**known, **facts}}
            self._manifest["recordings"] = dict(sorted(recordings.items()))
            _write_manifest(self.path, self._manifest)

    def pair_keys(self) -> list[tuple[str, int, int]]:
        """Return the pairs on disk, damaged ones too, ordered by recording, i, j."""
        return sorted(_key_of(path) for path in (self.path / "pairs").glob("[!.]*.npz"))

    def has(self, recording: str, i: int, j: int) -> bool:
        """Return whether the pair is there and undamaged."""
        return self.outcome(recording, i, j) is not None

    def outcome(self, recording: str, i: int, j: int) -> str | None:
        """Return why a pair was rejected, "" if it was not, None if it is missing or damaged."""
        if not self._file(recording, i, j).is_file():
            return None
        try:
            record = self.read(recording, i, j)
        except DatasetError:
            return None
        return "" if record.accepted else record.reason

    def outcomes(
        self, recording: str, pairs: Sequence[tuple[int, int]], n_threads: int = 1
    ) -> dict[tuple[int, int], str]:
        """Return the outcome of each pair (i, j) that is there and undamaged."""
        with ThreadPoolExecutor(max(1, n_threads)) as pool:
            found = pool.map(lambda ij: self.outcome(recording, *ij), pairs)
            return {ij: outcome for ij, outcome in zip(pairs, found) if outcome is not None}

    def read(self, recording: str, i: int, j: int) -> PairRecord:
        """Return one record.  Raises DatasetError if it is missing or damaged."""
        path = self._file(recording, i, j)
        if not path.is_file():
            raise DatasetError(f"{self.path} has no pair {recording} {i} {j}")
        try:
            record = _unpacked(dict(read_arrays(path, _ITEMS)))
            _check(record)
        except (ModelError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise DatasetError(f"{path} is damaged, sample it again: {error}") from None
        if record.key != (recording, i, j):
            raise DatasetError(f"{path} holds another pair: {record.key}")
        return record

    def write(self, record: PairRecord) -> None:
        """Store one record, in place of an older one.

        Raises DatasetError on unfit values, WriteError where the disk refuses.
        """
        path = self._file(*record.key)
        try:
            _check(record)
            path.parent.mkdir(exist_ok=True)
            write_arrays(path, _packed(record))
        except OSError as error:
            raise WriteError(f"cannot write {path}: {error.strerror}") from None
        except ModelError as error:
            raise DatasetError(str(error)) from None
        except (ValueError, TypeError) as error:
            raise DatasetError(f"refused to write {path}: {error}") from None

    def __iter__(self) -> Iterator[PairRecord]:
        for key in self.pair_keys():
            yield self.read(*key)

    def __len__(self) -> int:
        return len(self.pair_keys())

    def _file(self, recording: str, i: int, j: int) -> Path:
        _check_name(recording)
        return self.path / "pairs" / f"{recording}_{i}_{j}.npz"


def open_dataset(
    path: Path | str,
    pipeline: Pipeline | None = None,
    sampling: SamplingConfig | None = None,
    create: bool = False,
) -> Dataset:
    """Open a dataset folder; with ``create``, begin one where there is none.

    Settings that are given must be those of the folder: DatasetError names the first that is not.
    With ``create``, leftovers of interrupted writes are removed: one process at a time samples
    into a folder.
    """
    path = Path(path)
    if create:
        try:
            for leftover in [*path.glob(".*.tmp"), *path.glob("pairs/.*.tmp")]:
                leftover.unlink(missing_ok=True)
            if not (path / "manifest.json").exists():
                _begin(path, pipeline or Pipeline(), sampling or SamplingConfig())
        except OSError as error:
            raise DatasetError(f"cannot write {path}: {error.strerror}") from None
    dataset = Dataset(path, _read_manifest(path))
    theirs = _configuration(dataset.pipeline, dataset.sampling)
    ours = _configuration(pipeline or dataset.pipeline, sampling or dataset.sampling)
    if change := _first_difference(theirs, ours):
        raise DatasetError(f"{path} was made with other settings: there {change}")
    return dataset


def _begin(path: Path, pipeline: Pipeline, sampling: SamplingConfig) -> None:
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise DatasetError(f"{path} exists and is not a dataset: it has no manifest.json")
    path.mkdir(parents=True, exist_ok=True)
    manifest = {
        "format": FORMAT,
        "conventions": CONVENTIONS,
        "features": list(FEATURES),
        "configuration": _configuration(pipeline, sampling),
        "versions": package_versions(),
        "recordings": {},
    }
    _write_manifest(path, manifest)


def _configuration(pipeline: Pipeline, sampling: SamplingConfig) -> dict[str, dict[str, Any]]:
    return {**config_to(pipeline_of(pipeline)), "sampling": dataclasses.asdict(sampling)}


def package_versions() -> dict[str, str]:
    """Return the versions of what numbers depend on: Python and the packages below."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / "manifest.json"
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(f"{path} is not a dataset: it has no manifest.json") from None
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {file}: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        found = manifest.get("format") if isinstance(manifest, dict) else manifest
        hint = ": sample it again, it lacks the global features" if found == 1 else ""
        raise DatasetError(f"{file} has format {found!r}, this version reads {FORMAT}{hint}")
    if manifest.get("features") != list(FEATURES):
        raise DatasetError(f"{file} lists other global features than this version: sample again")
    for name in ("configuration", "versions", "recordings"):
        if not isinstance(manifest.get(name), dict):
            raise DatasetError(f"{file} lacks {name!r}")
    return manifest


def _write_manifest(path: Path, manifest: dict[str, Any]) -> None:
    text = json.dumps(manifest, indent=2, allow_nan=False) + "\n"
    with new_file(path / "manifest.json") as partial:
        partial.write_text(text, encoding="utf-8")


def _packed(record: PairRecord) -> dict[str, NDArray[Any]]:
    """Return the arrays of a record and its other fields as JSON."""
    header = {name: getattr(record, name) for name in _HEADER}
    header["shapes"] = sorted(record.shapes)
    text = json.dumps(header, allow_nan=False, default=np.generic.item).encode()
    shapes = [record.shapes[name] for name in header["shapes"]]
    return {
        "header": np.frombuffer(text, np.uint8),
        "shapes": np.array(shapes, np.float64).reshape(-1, 6, 6),
        **{
            name: np.array(getattr(record, name), dtype, order="C")
            for name, dtype in _ARRAYS.items()
        },
    }


def _unpacked(arrays: dict[str, Any]) -> PairRecord:
    header = json.loads(arrays.pop("header").tobytes())
    shapes = dict(zip(header.pop("shapes"), arrays.pop("shapes"), strict=True))
    return PairRecord(**header, **arrays, shapes=shapes)


def _check(record: PairRecord) -> None:
    """Raise ValueError unless the record may stand in a dataset."""
    arrays = {name: getattr(record, name) for name in _ARRAYS}
    for name, array in {**arrays, **record.shapes}.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    n_samples = len(record.xi)
    if record.xi.shape != (n_samples, 6) or record.kept.shape != (n_samples,):
        raise ValueError(f"xi {record.xi.shape} and kept {record.kept.shape} disagree")
    if record.T_mean.shape != (4, 4):
        raise ValueError(f"T_mean has shape {record.T_mean.shape}, not (4, 4)")
    if not record.accepted:
        if not record.reason:
            raise ValueError("a rejected pair needs a reason")
        return
    shape, n_rotations = record.descriptors.shape, len(record.rotations_rad)
    if n_rotations == 0 or len(shape) != 2 or shape[0] != n_rotations or shape[1] == 0:
        raise ValueError(f"{n_rotations} rotations, descriptors {shape}")
    if record.features.shape != (len(FEATURES),):
        raise ValueError(f"{record.features.size} global features, not {len(FEATURES)}")
    for name, Y in {"covariance": record.covariance, **record.shapes}.items():
        if Y.shape != (6, 6) or not is_positive_definite(Y):
            raise ValueError(f"{name} is not a positive definite 6x6 matrix")


def _check_name(recording: str) -> None:
    if not recording or recording.startswith(".") or set(recording) & set('/\\:*?"<>|\0'):
        raise DatasetError(f"a recording cannot be named {recording!r}: it names files")


def _key_of(path: Path) -> tuple[str, int, int]:
    try:
        recording, i, j = path.stem.rsplit("_", 2)
        return recording, int(i), int(j)
    except ValueError:
        raise DatasetError(f"{path} is not the name of a pair: <recording>_<i>_<j>.npz") from None


def _first_difference(theirs: dict[str, Any], ours: dict[str, Any], where: str = "") -> str:
    """Name the first value that differs: ``sampling.seed is 0, here 1``; empty if none does."""
    for name in [*theirs, *(name for name in ours if name not in theirs)]:
        a, b = theirs.get(name), ours.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            if change := _first_difference(a, b, f"{where}{name}."):
                return change
        elif a != b:
            return f"{where}{name} is {a}, here {b}"
    return ""
