"""Sample ICP on every pair of recordings into a dataset, which survives any interruption."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from threadpoolctl import threadpool_limits

from cello3d_ros.config import Config, pipeline_of
from cello3d_ros.errors import ConfigError, RecordingError, counted
from cello3d_ros.learning.aligned import AlignedPart, pose_facts
from cello3d_ros.learning.dataset import UNDONE, Dataset, PairRecord, open_dataset
from cello3d_ros.learning.identity import fingerprint, scan_prints
from cello3d_ros.learning.sampling import Progress, pairs, sample_recording
from cello3d_ros.recordings import Recording, open_recording
from cello3d_ros.recordings.deskew import WithoutMotion, without_motion
from cello3d_ros.simulation.rescan import rescannable
from cello3d_ros.simulation.simulation import Simulation


class Status(NamedTuple):
    """How far sampling is.  what: a few words; n_registrations: that are done, of n_total."""

    what: str
    n_registrations: int = 0
    n_total: int = 0
    n_pairs: int = 0
    n_pairs_total: int = 0


#: Samples some pairs of a recording opened at a path, reporting registrations.
Sampler = Callable[[Recording, str, list[tuple[int, int]], Progress], Iterator[PairRecord]]


def sample(
    recordings: Sequence[Path | str | Recording],
    out: Path | str,
    config: Config | None = None,
    n_threads: int = 1,
    report: Callable[[Status], None] = lambda status: None,
    sampler: Sampler | None = None,
) -> Counter[str]:
    """Sample what is missing of recordings into the dataset ``out``; the same call resumes.

    recordings: paths, or what is open already, such as the parts of an alignment.
    config: its pipeline and its section ``sampling`` apply.  sampler: what samples the pairs of a
    recording in place of the threads of this machine.  Returns how many pairs have which outcome:
    "" is accepted, all others are reasons.
    Raises ConfigError, DatasetError, RecordingError; pairs that were done before stand.
    """
    config = config or Config()
    sampling, pipeline = config.sampling, pipeline_of(config)
    opened = _opened(recordings, sampling.noise_m > 0.0 or sampling.n_views > 1)
    for recording in opened.values():
        report(Status(f"reading {recording.name}"))
        _check_usable(recording)
    dataset = open_dataset(out, pipeline, sampling, create=True)
    for recording in opened.values():
        report(Status(f"reading {recording.name}"))
        _add(dataset, recording)

    def here(
        recording: Recording, path: str, todo: list[tuple[int, int]], progress: Progress
    ) -> Iterator[PairRecord]:
        return sample_recording(recording, todo, pipeline, sampling, n_threads, progress)

    with threadpool_limits(1, user_api="blas"):  # its threads take the kernels' cores
        return _sample(opened, dataset, sampler or here, n_threads, report)


def _opened(paths: Sequence[Path | str | Recording], rescan: bool) -> dict[str, Recording]:
    """Return recordings by path, or by name if open.  Raises ConfigError for two of one name."""
    opened: dict[str, Recording] = {}
    for path in paths:
        if isinstance(path, str | Path):
            found = (rescannable if rescan else open_recording)(Path(path))
            opened[str(path)] = without_motion(found)
        else:
            opened[path.name] = path
    names = Counter(recording.name for recording in opened.values())
    if len(opened) < len(paths) or max(names.values(), default=0) > 1:
        name = names.most_common(1)[0][0]
        raise ConfigError(f"two recordings are named {name!r}: their pairs would mix")
    return opened


def _check_usable(recording: Recording) -> None:
    """Raise RecordingError where a recording can give no pair, before a dataset is begun."""
    if (n_scans := len(recording)) < 2:
        raise RecordingError(f"{recording.name} has {counted(n_scans, 'scan')}, a pair needs two")
    if not any(scan.T_world_sensor is not None for scan in recording):
        raise RecordingError(f"{recording.name} has no ground truth, sampling needs it")


def _add(dataset: Dataset, recording: Recording) -> None:
    """Write down what tells this recording from others of its name."""
    facts: dict[str, Any] = {"n_scans": len(recording), "fingerprint": fingerprint(recording)}
    known = dataset.recordings.get(recording.name, {})
    as_recorded = recording.recording if isinstance(recording, WithoutMotion) else recording
    if scans := known.get("scans") or scan_prints(as_recorded):
        facts["scans"] = scans
    source = recording
    if isinstance(recording, WithoutMotion):
        facts["motion"] = UNDONE
    if isinstance(recording, AlignedPart):
        source = recording.recording
        facts |= pose_facts(recording)
    if dataset.sampling.n_views > 1:
        facts["views"] = dataset.sampling.n_views if _can_look(source) else 1
    if dataset.sampling.noise_m > 0.0:
        facts["noise"] = "rescans" if isinstance(source, Simulation) else "added"
    dataset.add_recording(recording.name, facts)


def _can_look(source: Recording) -> bool:
    """Return whether scans of a recording can be taken from elsewhere."""
    return isinstance(source, Simulation) and not (source.drive and source.drive.sweeps)


def _sample(
    opened: dict[str, Recording],
    dataset: Dataset,
    sampler: Sampler,
    n_threads: int,
    report: Callable[[Status], None],
) -> Counter[str]:
    """Sample what is missing of all recordings; return how often each outcome occurs."""
    n_samples, outcomes, todo = dataset.sampling.n_samples, Counter[str](), {}
    report(Status("checking what is done"))
    for path, recording in opened.items():
        wanted = pairs(len(recording), dataset.sampling.max_gap)
        done = dataset.outcomes(recording.name, wanted, n_threads)
        outcomes.update(done.values())
        todo[path] = [ij for ij in wanted if ij not in done]
    n_missing = sum(map(len, todo.values()))
    n_pairs, n_total, n_done, name = outcomes.total() + n_missing, n_samples * n_missing, 0, ""

    def tell() -> None:
        report(Status(name, n_done, n_total, outcomes.total(), n_pairs))

    def progress(n: int) -> None:
        nonlocal n_done
        n_done += n
        tell()

    for path, recording in opened.items():
        name = recording.name
        tell()
        for record in sampler(recording, path, todo[path], progress):
            dataset.write(record)
            outcomes[record.reason] += 1
            n_total -= n_samples - record.n_samples  # rejected, or ended early
            tell()
    return outcomes
