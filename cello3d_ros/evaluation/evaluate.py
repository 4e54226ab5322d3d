"""Judge a model and every baseline on sampled pairs, on clouds and over trajectories."""

from __future__ import annotations

import dataclasses
import fnmatch
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.covariance.model import Model, find_model, load_model
from cello3d_ros.errors import ConfigError, DatasetError, RecordingError
from cello3d_ros.evaluation.comparison import (
    Predictions,
    add_answers,
    calibration,
    compare,
    divergences,
    fits,
    from_dataset,
    mean_of,
    seen_recordings,
    training_mean,
)
from cello3d_ros.evaluation.online import answers, prepared
from cello3d_ros.evaluation.result import Evaluation, Group, Pair, Poses, ShownPair, Trajectory
from cello3d_ros.evaluation.trajectories import consistency, length_m, odometry_runs, shown
from cello3d_ros.learning.align_sweeps import AlignSettings
from cello3d_ros.learning.aligned import aligned_parts, joint_folder
from cello3d_ros.learning.dataset import UNDONE, Dataset, open_dataset
from cello3d_ros.learning.examples import Examples, are_held, load_examples
from cello3d_ros.learning.identity import prints_of
from cello3d_ros.learning.measures import pose_check, select
from cello3d_ros.recordings import Recording, open_recording
from cello3d_ros.recordings.deskew import without_motion

Key = tuple[str, int, int]  # recording, i, j
Progress = Callable[[str, int, int], None]  # recording, pairs done, pairs in all

_N_WORST = 6  # pairs shown
_MOST_SAMPLES = 500  # of a pair shown


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """What to evaluate beside the defaults.

    only, exact_poses: patterns of recordings: those to evaluate, all by default; those with exact
    ground truth (simulation), of which the pose check flags no pair.  allow_seen: also recordings
    that the model was trained or validated on.  baseline: folders of datasets whose mean
    covariance is the baseline in place of the one that the model was trained on.
    recordings: bags or data sets with the clouds, for the methods that need them, which run on
    ``n_online_pairs`` pairs of each (0 is all), and for ``n_trajectories`` runs of ICP odometry.
    sensor_sigma_m: noise of a point; n_registrations: of Monte Carlo and fused.
    """

    only: Sequence[str] = ()
    exact_poses: Sequence[str] = ()
    allow_seen: bool = False
    baseline: Sequence[Path | str] = ()
    recordings: Sequence[Path | str] = ()
    n_online_pairs: int = 0
    n_trajectories: int = 0
    sensor_sigma_m: float = 0.01
    n_registrations: int = 12
    seed: int = 0
    n_threads: int = 1

    def __post_init__(self) -> None:
        if self.n_trajectories and not self.recordings:
            raise ConfigError("trajectories need clouds: name their recordings (--recordings)")
        if not self.sensor_sigma_m > 0.0:
            raise ConfigError(f"the sensor's noise must be positive: {self.sensor_sigma_m:g}")


@dataclass(frozen=True)
class _Judged:
    """What all steps of an evaluation look at; keys in the order of the examples."""

    datasets: Sequence[Dataset]
    keys: Sequence[Key]
    examples: Examples
    predictions: Predictions


def evaluate(
    datasets: Sequence[Path | str],
    model: Path | str = "general",
    settings: EvaluationSettings | None = None,
    progress: Progress = lambda name, done, total: None,
) -> Evaluation:
    """Judge a model, by file or shipped name, and every baseline on the pairs of datasets.

    datasets: folders that ``sample`` wrote.  Returns the figures of every method over all pairs
    and by recording, the pose checks, calibration, the worst pairs and trajectories.
    Raises DatasetError for recordings that the model has seen or a pattern that matches nothing.
    """
    settings = settings or EvaluationSettings()
    path = find_model(model)
    opened = [open_dataset(folder) for folder in dict.fromkeys(map(Path, datasets))]
    loaded = load_model(path)
    names = chosen(opened, settings.only)
    seen = _seen(loaded, opened, names, settings.allow_seen)
    recordings = _recordings(settings.recordings, names, opened)
    baseline = [open_dataset(folder) for folder in settings.baseline]
    mean = mean_of(baseline) if baseline else training_mean(loaded)
    examples, keys, n_free = _answered(opened, names)
    methods = MethodSettings(
        settings.sensor_sigma_m, settings.n_registrations, widen_unknown=False
    )
    judged = _Judged(opened, keys, examples, from_dataset(loaded, examples, mean, methods))
    for recording in recordings:
        _add_online(judged, recording, loaded, methods, settings, progress)
    found = _judge(judged, methods, settings.exact_poses, seen)
    return dataclasses.replace(
        found,
        model=str(path),
        shape=loaded.shape,
        n_free=n_free,
        trajectories={
            recording.name: _trajectory(recording, loaded, settings)
            for recording in (recordings if settings.n_trajectories else ())
        },
    )


def chosen(datasets: Sequence[Dataset], only: Sequence[str]) -> list[str]:
    """Return the recordings to evaluate.  Raises DatasetError for a pattern that matches none."""
    names = sorted({key[0] for dataset in datasets for key in dataset.pair_keys()})
    for pattern in only:
        if not any(fnmatch.fnmatchcase(name, pattern) for name in names):
            raise DatasetError(f"no recording matches {pattern!r}: there are {', '.join(names)}")
    names = [name for name in names if not only or _matches(name, only)]
    if not names:
        raise DatasetError(f"{datasets[0].path} holds no pair")
    return names


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _seen(
    model: Model, datasets: Sequence[Dataset], names: Sequence[str], allowed: bool
) -> set[str]:
    """Return the recordings that the model has seen.  Raises DatasetError where not allowed."""
    known = prints_of(datasets, names)
    seen = seen_recordings(model, {name: known[name] for name in names})
    if seen and not allowed:
        named = (n if n == twin else f"{n} (as {twin})" for n, twin in sorted(seen.items()))
        raise DatasetError(
            f"the model was trained or validated on {', '.join(named)}: choose others "
            "with --only, or say --allow-seen"
        )
    return set(seen)


def _recordings(
    paths: Iterable[Path | str], names: Sequence[str], datasets: Sequence[Dataset]
) -> list[Recording]:
    """Open recordings, with the poses that they were sampled about.

    Raises RecordingError for one that is not evaluated.
    """
    found: dict[str, Recording] = {}
    for path in paths:
        recording = open_recording(path)
        if recording.name not in names:
            raise RecordingError(
                f"{path}: recording {recording.name!r} is not among those evaluated, "
                f"{', '.join(names)}"
            )
        found[recording.name] = recording
        for dataset in datasets:
            if dataset.recordings.get(recording.name, {}).get("motion") == UNDONE:
                found[recording.name] = without_motion(recording)
            if dataset.recordings.get(recording.name, {}).get("poses") == "joint":
                folder = joint_folder(dataset.path, recording.name)
                parts = aligned_parts(recording, folder, AlignSettings(dataset.pipeline))
                found |= {part.name: part for part in parts if part.name in names}
    return list(found.values())


def _answered(
    datasets: Sequence[Dataset], names: Sequence[str]
) -> tuple[Examples, list[Key], int]:
    """Return the accepted pairs, their keys, and how many others have a free direction.

    The node gives no answer to those.
    """
    examples, wanted = load_examples(datasets, names), set(names)
    keys = sorted(
        key
        for dataset in datasets
        for key in dataset.pair_keys()
        if key[0] in wanted and dataset.read(*key).accepted
    )
    kept = are_held(examples)
    if not kept.any():
        raise DatasetError(f"{datasets[0].path}: in every pair no plane holds some direction")
    held = [key for key, keep in zip(keys, kept, strict=True) if keep]
    return select(examples, kept), held, len(keys) - len(held)


def _add_online(
    judged: _Judged,
    recording: Recording,
    model: Model,
    methods: MethodSettings,
    settings: EvaluationSettings,
    progress: Progress,
) -> None:
    """Run the methods that need clouds on the pairs of a recording."""
    rows = [row for row, key in enumerate(judged.keys) if key[0] == recording.name]
    if (n := settings.n_online_pairs) and n < len(rows):
        rows = [rows[k] for k in np.linspace(0, len(rows) - 1, n).astype(int)]
    pairs = [judged.keys[row][1:] for row in rows]
    found = []
    for answer in answers(recording, pairs, model, methods, settings.seed):
        found.append(answer)
        progress(recording.name, len(found), len(rows))
    add_answers(judged.predictions, rows, found)


def _judge(
    judged: _Judged, methods: MethodSettings, exact_poses: Sequence[str], seen: set[str]
) -> Evaluation:
    """Return all figures of the pairs, without the flagged ones and with all."""
    predictions, examples = judged.predictions, judged.examples
    pairs = _pairs(judged, exact_poses)
    flagged = np.array([pair.flagged for pair in pairs])
    if flagged.all():
        raise DatasetError("the pose check flags every pair: ground truth is not usable")
    overall, by_recording = compare(predictions, examples, ~flagged, methods)
    everything: Group | None = None
    if flagged.any():
        everything, _ = compare(predictions, examples, np.ones_like(flagged), methods)
    return Evaluation(
        model="",
        shape="",
        settings={"sigma_m": methods.sigma_m, "n_registrations": methods.n_registrations},
        n_pairs=overall.n_pairs,
        methods=overall.methods,
        recordings={
            name: dataclasses.replace(group, trained_on=name in seen)
            for name, group in by_recording.items()
        },
        with_flagged_pairs=everything,
        pose_check=_poses(pairs),
        calibration=calibration(predictions, examples, ~flagged),
        pairs=pairs,
        worst_pairs=_worst_pairs(judged, pairs),
    )


def _pairs(judged: _Judged, exact_poses: Sequence[str]) -> list[Pair]:
    pairs = []
    for k, (name, i, j) in enumerate(judged.keys):
        check = vars(pose_check(judged.examples.xi[k]))
        check["flagged"] &= not _matches(name, exact_poses)
        pairs.append(
            Pair(
                recording=name,
                i=i,
                j=j,
                kl=divergences(judged.predictions, judged.examples, k),
                dm2_over_6=fits(judged.predictions, judged.examples, k),
                **check,
            )
        )
    return pairs


def _poses(pairs: Sequence[Pair]) -> dict[str, Poses]:
    """Return medians of the pose checks of each recording, and its flagged pairs."""
    grouped: dict[str, list[Pair]] = defaultdict(list)
    for pair in pairs:
        grouped[pair.recording].append(pair)
    return {
        name: Poses(
            n_pairs=len(rows),
            offset_m=float(np.median([pair.offset_m for pair in rows])),
            scatter_m=float(np.median([pair.scatter_m for pair in rows])),
            offset_rad=float(np.median([pair.offset_rad for pair in rows])),
            scatter_rad=float(np.median([pair.scatter_rad for pair in rows])),
            n_flagged=sum(pair.flagged for pair in rows),
            flagged=[[pair.i, pair.j] for pair in rows if pair.flagged],
        )
        for name, rows in grouped.items()
    }


def _worst_pairs(judged: _Judged, pairs: Sequence[Pair]) -> list[ShownPair]:
    """Return what there is to see of the pairs that the model misses most, flagged or not."""
    order = sorted(range(len(pairs)), key=lambda k: -pairs[k].kl["cello3d"])
    holders = {key: dataset for dataset in judged.datasets for key in dataset.pair_keys()}
    found = []
    for k in order[:_N_WORST]:
        record = holders[judged.keys[k]].read(*judged.keys[k])
        n = len(record.xi)
        few = np.linspace(0, n - 1, min(n, _MOST_SAMPLES)).astype(int)
        found.append(
            ShownPair(
                recording=record.recording,
                i=record.i,
                j=record.j,
                kl=pairs[k].kl["cello3d"],
                dm2_over_6=pairs[k].dm2_over_6["cello3d"],
                flagged=pairs[k].flagged,
                T_mean=record.T_mean,
                covariance=record.covariance,
                predicted=judged.predictions.covariances["cello3d"][k],
                xi=np.round(record.xi[few], 7),
                kept=record.kept[few].astype(np.float64),
            )
        )
    return found


def _trajectory(recording: Recording, model: Model, settings: EvaluationSettings) -> Trajectory:
    """Run odometry over a recording.  Raises RecordingError for fewer than two scans."""
    n = len(recording)
    if n < 2:
        raise RecordingError(f"{recording.name} has {n} scan: no trajectory")
    clouds, poses = prepared(recording, model.pipeline, range(n), settings.seed)
    T = np.array([poses[k] for k in range(n)])
    runs = odometry_runs(
        [clouds[k] for k in range(n)],
        T,
        model,
        settings.n_trajectories,
        settings.seed,
        settings.n_threads,
    )
    return Trajectory(length_m=length_m(T), paths=shown(T, runs), **vars(consistency(runs)))
