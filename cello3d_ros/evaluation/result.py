"""What ``evaluate`` finds, and the JSON file that keeps it.

The file has the names of the fields below, arrays as nested lists, null where there is no figure.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.atomic import new_file
from cello3d_ros.errors import Cello3dError
from cello3d_ros.learning.measures import Figures, PoseCheck

Array = NDArray[np.float64]
T = TypeVar("T")


class EvaluationError(Cello3dError):
    """An evaluation cannot be read."""


@dataclass(frozen=True, kw_only=True)
class Group:
    """The figures of every method on the same pairs, and whether the model has seen those."""

    n_pairs: int
    methods: dict[str, Figures]
    trained_on: bool = False


@dataclass(frozen=True, kw_only=True)
class Pair(PoseCheck):
    """One pair: its pose check, and by method the divergence and ``tr(F^-1 Y) / 6``."""

    recording: str
    i: int
    j: int
    kl: dict[str, float]
    dm2_over_6: dict[str, float]

    def __post_init__(self) -> None:
        if "cello3d" not in self.kl:
            raise ValueError(f"{self.recording} {self.i}-{self.j} has no 'kl' of cello3d")


@dataclass(frozen=True, kw_only=True)
class Poses:
    """The pose checks of a recording: their medians, and the pairs that are suspected."""

    n_pairs: int
    offset_m: float
    scatter_m: float
    offset_rad: float
    scatter_rad: float
    n_flagged: int
    flagged: list[list[int]]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Quantiles of D_M^2 of the sampled errors by method.

    They are those of chi-square with 6 degrees of freedom where covariances hold.
    """

    probabilities: list[float]
    dm2: dict[str, list[float]]


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownPair:
    """A pair as it can be drawn: some samples, which of them were kept, both covariances."""

    recording: str
    i: int
    j: int
    kl: float
    dm2_over_6: float
    flagged: bool
    T_mean: Array
    covariance: Array
    predicted: Array
    xi: Array
    kept: Array

    def __post_init__(self) -> None:
        n = len(self.kept)
        _check_shapes(self, T_mean=(4, 4), covariance=(6, 6), predicted=(6, 6))
        _check_shapes(self, xi=(n, 6), kept=(n,))


@dataclass(frozen=True, kw_only=True, eq=False)
class Paths:
    """The true path and some runs, in the frame of the first scan.

    truth: (L, 3) positions.  positions: runs x (L - 1, 3).  covariances: runs x (L - 1, 3, 3) of
    the position along the axes of that frame, m^2.
    """

    truth: Array
    positions: Array
    covariances: Array

    def __post_init__(self) -> None:
        runs, steps = len(self.positions), len(self.truth) - 1
        if runs:
            _check_shapes(self, positions=(runs, steps, 3), covariances=(runs, steps, 3, 3))
        _check_shapes(self, truth=(steps + 1, 3))


@dataclass(frozen=True, kw_only=True)
class Distances:
    """How far the ends of runs are from the truth, beside what their covariances claim.

    dm_*: mean D_M, 2.35 in 6 dof and 1.60 in 3 if covariances hold; nees_over_6: mean D_M^2 over
    6, 1 if they hold, which ``verdict`` says in words; coverage_95: share of runs within the joint
    95 % ellipsoid; error_m, error_rad: mean norms.  None without a run.
    """

    dm_6dof: float | None = None
    dm_translation: float | None = None
    dm_rotation: float | None = None
    dm_6dof_median: float | None = None
    nees_over_6: float | None = None
    verdict: str = ""
    coverage_95: float | None = None
    error_m: float | None = None
    error_rad: float | None = None


@dataclass(frozen=True, kw_only=True)
class Consistency(Distances):
    """The runs of ICP odometry over a recording.

    n_failed: runs in which a registration had no answer, which enter no figure; n_lost: runs in
    which one ended in another minimum; n_told: runs of which the model said so; n_lost_told: of
    them those that are lost; without_lost: the distances without the lost ones.
    """

    n_runs: int
    n_failed: int
    n_lost: int
    n_told: int
    n_lost_told: int
    without_lost: Distances


@dataclass(frozen=True, kw_only=True)
class Trajectory(Consistency):
    """The same with the length of the path and what there is to draw."""

    length_m: float
    paths: Paths | None = None


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything that ``evaluate`` finds.

    model, shape: its file or name, and what its covariances are relative to; settings: what
    methods assumed.  n_pairs, methods: all recordings together, without the pairs whose poses are
    suspected; with_flagged_pairs: with them, where there are any.  pairs: all of them, flagged or
    not; worst_pairs: those that the model misses most, the worst first.  n_free: pairs with a free
    direction, which have no answer online and are in no figure.
    """

    model: str
    shape: str
    settings: dict[str, float]
    n_pairs: int
    methods: dict[str, Figures]
    recordings: dict[str, Group]
    with_flagged_pairs: Group | None
    pose_check: dict[str, Poses]
    calibration: Calibration
    pairs: list[Pair]
    worst_pairs: list[ShownPair]
    trajectories: dict[str, Trajectory] = field(default_factory=dict)
    n_free: int = 0


def write_evaluation(evaluation: Evaluation, path: Path) -> None:
    """Write an evaluation as JSON.  Raises WriteError where the disk refuses."""
    with new_file(path) as partial:
        text = json.dumps(_plain(evaluation), indent=1, allow_nan=False)
        partial.write_text(text + "\n", encoding="utf-8")


def read_evaluation(path: Path) -> Evaluation:
    """Read an evaluation.  Raises EvaluationError where it is damaged or of another version."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refused)
    except OSError as error:
        raise EvaluationError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise EvaluationError(f"{path} is no JSON of cello3d evaluate: {error}") from None
    if not isinstance(found, dict) or not isinstance(found.get("methods"), dict):
        raise EvaluationError(f"{path} is no JSON of cello3d evaluate: it has no 'methods'")
    try:
        return _built(Evaluation, found, "the evaluation")
    except KeyError as error:
        raise EvaluationError(
            f"{path} is damaged or of another version: {error.args[0]}; run cello3d evaluate again"
        ) from None
    except (TypeError, ValueError) as error:
        raise EvaluationError(f"{path} is damaged: {error}") from None


def _check_shapes(owner: Any, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        if (found := getattr(owner, name).shape) != shape:
            raise ValueError(f"{name!r} has shape {found}, not {shape}")


def _plain(value: Any) -> Any:
    """Return a value in the types of JSON."""
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value


def _built(kind: type[T], value: Any, where: str) -> T:
    """Return the dataclass of a mapping.  Raises KeyError, TypeError, ValueError with a reason."""
    if not isinstance(value, dict):
        raise TypeError(f"{where} is not an object")
    hints = typing.get_type_hints(kind)
    fields = {}
    for f in dataclasses.fields(kind):  # type: ignore[arg-type]
        if f.name in value:
            fields[f.name] = _typed(hints[f.name], value[f.name], f"{f.name!r} of {where}")
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise KeyError(f"{where} lacks {f.name!r}")
    return kind(**fields)


def _typed(hint: Any, value: Any, where: str) -> Any:
    """Return a value of JSON in the type of a field."""
    origin, parameters = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType:
        return None if value is None else _typed(parameters[0], value, where)
    if dataclasses.is_dataclass(hint):
        return _built(typing.cast(type, hint), value, where)
    if origin is np.ndarray:
        return np.array(value, np.float64)
    kind: Any = origin or hint
    if not isinstance(value, kind) and not (kind is float and isinstance(value, int)):
        raise TypeError(f"{where} is not of type {kind.__name__}: {str(value)[:40]}")
    if origin is dict:
        inner = f" of {where}"
        return {key: _typed(parameters[1], v, repr(key) + inner) for key, v in value.items()}
    if origin is list:
        return [_typed(parameters[0], each, f"an entry of {where}") for each in value]
    return value


def _refused(word: str) -> Any:
    raise ValueError(f"{word} is no JSON number")
