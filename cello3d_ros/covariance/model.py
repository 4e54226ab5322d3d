"""The learned model: from what describes a pair, and its cheap shape, to a covariance.

``F(d) = sum_k w_k Y_k`` with ``w_k`` proportional to ``exp(-rho_k)`` and
``rho_k = |Theta (d - d_k)|^2`` over the training examples (d_k, Y_k); a share of the training mean
is mixed in, and the Y_k may be relative to the pair's own shape S (Hessian or sandwich).
Covariances are ordered (u, omega) and belong to the reading side, ``T_hat = T_mean exp(xi)``.
Source: Landry et al. 2019, Sec. IV-B; relative covariances are this project's own.
"""

from __future__ import annotations

import importlib.resources
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.config import (
    PIPELINE,
    UNSEEN,
    Config,
    Pipeline,
    SamplingConfig,
    config_from,
    config_to,
    pipeline_of,
    sections_of,
)
from cello3d_ros.covariance.archive import read_arrays, write_arrays
from cello3d_ros.covariance.features import FEATURES, KINDS
from cello3d_ros.covariance.heading import FRAMES, blended, out_of_motion
from cello3d_ros.covariance.lost import Lost
from cello3d_ros.covariance.sums import pack, squared_distances, unpack, weighted_sum
from cello3d_ros.errors import ConfigError, ModelError
from cello3d_ros.geometry.gaussian import (
    INDEPENDENT,
    Bias,
    is_positive_definite,
    matrix_sqrt,
    symmetrized,
)
from cello3d_ros.geometry.se3 import Array

FORMAT = "cello3d-model"
FORMAT_VERSION = 4
_READABLE = (2, 3, FORMAT_VERSION)
CONVENTIONS = {
    "order": "u omega",
    "side": "reading: T_hat = T_mean exp(xi)",
    "relative": "S^-1/2 Y S^-1/2, symmetric root",
    "weight": "exp(-|Theta (d - d_k)|^2)",
}
SHIPPED = ("general", "paper")
SHAPES = ("none", "hessian", "sandwich")

_MAX_HEADER_BYTES = 16 * 1024**2
_BLOCK = 65536  # covariances checked at once, bounds memory
_ARRAYS = ("theta", "mean", "scale", "projections", "covariances", "rho_quantiles")
_NEW_ARRAYS = ("input_range", "rotations_rad", "training_mean")  # since format 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """Theta and the training examples, with the settings they were made with.

    theta: (r, D).  mean, scale: (D,), scaler of the inputs, ``(d - mean) / scale``.
    projections: (N, r), Theta applied to the standardised training inputs.
    covariances: (N, 6, 6), of the sampled registrations; ``S^-1/2 Y S^-1/2`` unless shape is none.
    shape: what they are relative to.  frame: whose axes they have, one of ``heading.FRAMES``.
    mean_weight: share of their mean in every prediction.
    margin: factor on every prediction, for what the training data leave out.
    features: what the inputs are, one of ``features.KINDS``.
    rho_quantiles: (Q,) or empty, evenly spaced quantiles of the nearest rho of the training
    pairs, each seen from other recordings.
    input_range: (2, D), least and largest inputs of the training, to which a prediction clips its
    own; or (0, D), no clipping.
    rotations_rad: (R,), the turns about z of each training pair, side by side in the examples.
    training_mean: (6, 6), mean of the absolute training covariances; or (0, 6), not known.
    lost: how to tell a registration that ended in another minimum; None where nothing is known.
    bias: what the errors of registrations that follow each other have in common.
    provenance: recordings, seeds, versions, settings, figures; anything that JSON can hold.
    Raises ModelError naming what does not fit.  The arrays are read-only.
    """

    theta: Array
    mean: Array
    scale: Array
    projections: Array
    covariances: Array
    rho_quantiles: Array = field(default_factory=lambda: np.zeros(0))
    input_range: Array = field(default_factory=lambda: np.zeros((0, 0)))
    rotations_rad: Array = field(default_factory=lambda: np.zeros(1))
    training_mean: Array = field(default_factory=lambda: np.zeros((0, 6)))
    shape: str = "none"
    frame: str = "sensor"
    features: str = "descriptor"
    mean_weight: float = 0.0
    margin: float = 1.0
    lost: Lost | None = None
    bias: Bias = field(default_factory=Bias)
    pipeline: Pipeline = field(default_factory=Pipeline)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (*_ARRAYS, *_NEW_ARRAYS):
            object.__setattr__(self, name, _frozen(name, getattr(self, name)))
        object.__setattr__(self, "provenance", _as_json(self.provenance))
        _check_extents(self)
        _check_settings(self)
        for name in ("mean_weight", "margin"):
            object.__setattr__(self, name, _number(name, getattr(self, name)))
        if self.lost is not None:
            object.__setattr__(self, "lost", _checked(self.lost))
        object.__setattr__(self, "bias", _checked_bias(self.bias))
        for start in range(0, len(self.covariances), _BLOCK):
            fine = is_positive_definite(self.covariances[start : start + _BLOCK])
            if not fine.all():
                raise ModelError(f"covariance {start + np.argmin(fine)} is not positive definite")

    @property
    def n_examples(self) -> int:
        """Number of training examples N."""
        return len(self.projections)

    @property
    def n_features(self) -> int:
        """Number of inputs D."""
        return int(self.theta.shape[1])

    @cached_property
    def mean_covariance(self) -> Array:
        """Mean of the training covariances (relative ones if shape is not none).  (6, 6)."""
        return symmetrized(self.covariances.mean(axis=0))

    @cached_property
    def packed_covariances(self) -> Array:
        """Upper triangles of the training covariances: fewer bytes to read.  (N, 21)."""
        return pack(self.covariances)


class Prediction(NamedTuple):
    """A covariance and the evidence for trust in it.

    covariance: (6, 6), ordered (u, omega), reading side, exactly symmetric, positive definite.
    nearest_rho: distance of the nearest example.  effective_neighbors: ``1 / sum w_k^2``.
    novelty: share of the training pairs that had, among other recordings, a nearer example: 1 is
    farther than any; 0 where the model does not know.
    """

    covariance: Array
    nearest_rho: float
    effective_neighbors: float
    novelty: float


def project(inputs: ArrayLike, theta: Array, mean: Array, scale: Array) -> Array:
    """Return ``Theta (d - mean) / scale``, a point whose squared distances are rho.

    inputs: (..., D).  Returns (..., r).
    """
    d = np.asarray(inputs, dtype=np.float64)
    return np.asarray(((d - mean) / scale) @ theta.T)


def weigh(rho: Array) -> Array:
    """Return weights proportional to ``exp(-rho)`` that sum to 1.  (..., N) -> (..., N).

    The minimum is subtracted first, so that the nearest example weighs most and never 0/0.
    """
    w = rho.min(axis=-1, keepdims=True) - rho
    np.exp(w, out=w)
    w /= w.sum(axis=-1, keepdims=True)
    return np.asarray(w)


def predict(
    model: Model,
    inputs: ArrayLike,
    S: ArrayLike | None = None,
    motion: ArrayLike | None = None,
) -> Prediction:
    """Return ``F = m S^1/2 [(1 - a) sum_k w_k Y_k + a mean(Y)] S^1/2``.

    m is the model's margin, a the mean's weight.  Weights are those of the inputs clipped to the
    range of the training, beyond which nothing is known of how examples differ; the evidence is
    that of the inputs as they are.

    inputs: (D,), what ``model_inputs`` gives.  S: (6, 6), the pair's shape that ``model.shape``
    names, reading side; not looked at when that is none.  motion: (2,), what ``motion_of`` finds,
    along which the Y_k are turned where ``model.frame`` says so.  Raises ModelError where one of
    them does not fit the model.
    """
    d = np.asarray(inputs, dtype=np.float64)
    if d.shape != (model.n_features,):
        raise ModelError(
            f"the {model.features} input has shape {d.shape}, the model needs "
            f"({model.n_features},)"
        )
    if not np.isfinite(d).all():
        raise ModelError(f"the {model.features} input is not finite")
    rho = _distances2(model, d)
    if not np.isfinite(nearest := float(rho.min())):
        raise ModelError("the pair is too far from every example for a distance")
    if len(model.input_range):
        clipped = np.clip(d, *model.input_range)
        rho = rho if np.array_equal(clipped, d) else _distances2(model, clipped)
    w = weigh(rho)
    F = unpack(weighted_sum(w, model.packed_covariances))
    F = (1.0 - model.mean_weight) * F + model.mean_weight * model.mean_covariance
    F = placed(model, model.margin * F, S, motion)
    return Prediction(F, nearest, float(1.0 / (w @ w)), _rank(nearest, model.rho_quantiles))


def _distances2(model: Model, d: Array) -> Array:
    """Return rho of every example.  (D,) -> (N,)."""
    query = project(d, model.theta, model.mean, model.scale)
    return squared_distances(model.projections, query)


def constant_model(covariance: ArrayLike, n_features: int, **settings: Any) -> Model:
    """Return the model of one example, which predicts it everywhere: the baseline and fallback.

    covariance: (6, 6), relative if ``shape`` says so; settings: the other fields of Model.
    """
    return Model(
        theta=np.zeros((1, n_features)),
        mean=np.zeros(n_features),
        scale=np.ones(n_features),
        projections=np.zeros((1, 1)),
        covariances=np.asarray(covariance, dtype=np.float64)[None],
        **settings,
    )


def save_model(model: Model, path: Path | str) -> None:
    """Write the model as one .npz without pickle, complete or not at all.  Raises ModelError."""
    try:
        header = json.dumps(_header(model), allow_nan=False, indent=1).encode()
    except ValueError as error:
        raise ModelError(f"cannot write {path}: a setting is not finite: {error}") from None
    if len(header) > _MAX_HEADER_BYTES:
        raise ModelError(f"cannot write {path}: provenance of {len(header)} bytes is too long")
    names = (*_ARRAYS, *_NEW_ARRAYS)
    arrays: dict[str, NDArray[Any]] = {name: getattr(model, name) for name in names}
    write_arrays(path, {"header": np.frombuffer(header, dtype=np.uint8), **arrays})


def load_model(name: Path | str = "general") -> Model:
    """Read a model, every bit as saved: a file, or one of ``SHIPPED`` by its name.

    Raises ModelError naming the file and what is wrong.
    """
    path = find_model(name)
    if not path.exists():
        raise ModelError(f"{path}: no such model file; shipped are {', '.join(SHIPPED)}")
    header = _read_header(path)
    is_new = header["format_version"] > 2
    names = (*_ARRAYS, *_NEW_ARRAYS) if is_new else _ARRAYS
    arrays = read_arrays(path, dict.fromkeys(names, "<f8"))
    if not is_new:
        arrays |= _of_format_2(header["provenance"])
    try:
        section, name = UNSEEN  # the default, whatever it was in training
        if isinstance(settings := header["config"].get(section), dict):
            settings.pop(name, None)
        config = config_from(header["config"])
        model = Model(
            **arrays,
            shape=header["shape"],
            frame=header.get("frame", "sensor"),  # since format 4
            features=header["features"],
            mean_weight=header["mean_weight"],
            margin=header["margin"],
            lost=_lost_from(header.get("lost")),
            bias=_bias_from(header.get("bias"), header["shape"]),
            pipeline=pipeline_of(config),
            sampling=config.sampling,
            provenance=header["provenance"],
        )
        if model.features == "global" and model.n_features != len(FEATURES):
            raise ModelError(
                f"it looks at {model.n_features} global features, where this version has "
                f"{len(FEATURES)}: train it again"
            )
    except (ModelError, ConfigError, OverflowError) as error:
        raise ModelError(f"{path}: {error}") from None
    return model


def shipped_model_path(name: str = "general") -> Path:
    """Return the path of a model that comes with the package: one of ``SHIPPED``."""
    return Path(str(importlib.resources.files("cello3d_ros").joinpath("models", f"{name}.npz")))


def find_model(word: str | Path) -> Path:
    """Return the path that a user means: a shipped model's name, a file, nothing for general."""
    return (
        shipped_model_path(str(word) or "general") if str(word) in ("", *SHIPPED) else Path(word)
    )


def _header(model: Model) -> dict[str, Any]:
    config = config_to(Config(**sections_of(model.pipeline), sampling=model.sampling))
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "conventions": CONVENTIONS,
        "config": {name: config[name] for name in (*PIPELINE, "sampling")},
        "shape": model.shape,
        "frame": model.frame,
        "features": model.features,
        "mean_weight": model.mean_weight,
        "margin": model.margin,
        "lost": None if model.lost is None else _lost_to(model.lost),
        "bias": model.bias._asdict(),
        "provenance": model.provenance,
    }


def _of_format_2(provenance: Any) -> dict[str, Any]:
    """Return what models of format 2 kept in their provenance."""
    found = provenance if isinstance(provenance, dict) else {}
    return {
        "rotations_rad": found.get("rotations_rad", [0.0]),
        "training_mean": found.get("mean_covariance", np.zeros((0, 6))),
    }


def _lost_to(lost: Lost) -> dict[str, Any]:
    return {"limit_m": lost.limit_m, "covariance": lost.covariance.tolist()}


def _lost_from(item: object) -> Lost | None:
    """Return what the header holds; models made before decision 11 hold nothing."""
    if item is None:
        return None
    if not isinstance(item, dict) or set(item) != {"limit_m", "covariance"}:
        raise ModelError(f"item 'lost' is not a limit_m and a covariance: {item!r}")
    return Lost(**item)


def _bias_from(item: object, shape: object) -> Bias:
    """Return what the header holds; models made before it was measured have the default.

    Absolute covariances are compounded as independent ones, as in the paper.
    """
    if item is None:
        return INDEPENDENT if shape == "none" else Bias()
    if not isinstance(item, dict) or set(item) != set(Bias._fields):
        raise ModelError(f"item 'bias' is not a share and a way_m: {item!r}")
    return Bias(**item)


def _read_header(path: Path | str) -> dict[str, Any]:
    """Return the structured part, checked for format, version, conventions and completeness."""
    data = read_arrays(path, {"header": "|u1"})["header"]
    if data.size > _MAX_HEADER_BYTES:
        raise ModelError(f"{path}: item 'header' has {data.size} bytes, too many")
    try:
        header = json.loads(data.tobytes())
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path}: the header is not JSON: {error}") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ModelError(f"{path}: the header is not that of a {FORMAT} file")
    if (version := header.get("format_version")) not in _READABLE:
        raise ModelError(
            f"{path}: format version {version!r}, this package reads 2, 3 and 4: train it again"
        )
    wanted = _header(constant_model(np.eye(6), 1))
    if version < FORMAT_VERSION:
        del wanted["frame"]
    _check_items(header, wanted, f"{path}: header")
    if header["conventions"] != CONVENTIONS:
        raise ModelError(f"{path}: conventions are {header['conventions']}, not {CONVENTIONS}")
    return header


def _check_items(found: Mapping[str, Any], wanted: Mapping[str, Any], where: str) -> None:
    """Raise ModelError for a missing item; settings within a section may be missing."""
    for name in wanted:
        if name not in found and name not in ("lost", "bias"):
            raise ModelError(f"{where}: item {name!r} is missing")
    if not isinstance(found["config"], dict):
        raise ModelError(f"{where}: item 'config' holds no sections")
    for name in wanted["config"]:
        if name not in found["config"]:
            raise ModelError(f"{where}: section {name!r} of 'config' is missing")


def placed(model: Model, F: Array, S: ArrayLike | None, motion: ArrayLike | None) -> Array:
    """Return what a covariance of the model's examples is for a pair: along its axes, of its size.

    F: (6, 6); S, motion: as of ``predict``, which says how.
    """
    if model.frame == "motion":
        if motion is None or np.shape(motion) != (2,) or not np.isfinite(motion).all():
            raise ModelError(
                f"the model needs the horizontal motion of a pair, two numbers: {motion!r}"
            )
        m = np.asarray(motion, dtype=np.float64)
        F = out_of_motion(blended(F, m), m)
    if (shape := model.shape) != "none":
        if S is None:
            raise ModelError(f"the model is relative to the {shape} of a pair, and none is given")
        S = np.asarray(S, dtype=np.float64)
        if S.shape != (6, 6) or not is_positive_definite(S):
            raise ModelError(f"the {shape} of the pair is not a positive definite 6x6 matrix")
        try:
            root = matrix_sqrt(S)
        except np.linalg.LinAlgError:
            raise ModelError(f"the {shape} of the pair is singular to rounding") from None
        F = symmetrized(root @ F @ root)
    if not is_positive_definite(F):
        raise ModelError("the predicted covariance is not positive definite")
    return F


def _rank(value: float, quantiles: Array) -> float:
    """Return the share of what the quantiles are of that is below the value; 0 without any."""
    if len(quantiles) == 0:
        return 0.0
    return float(np.interp(value, quantiles, np.linspace(0.0, 1.0, len(quantiles))))


def _frozen(name: str, value: ArrayLike) -> Array:
    """Return a read-only float64 view, and a copy only where one is needed."""
    try:
        array = np.ascontiguousarray(value, dtype=np.float64).view()
    except (TypeError, ValueError) as error:
        raise ModelError(f"{name} is not an array of numbers: {error}") from None
    if not np.isfinite(array).all():
        raise ModelError(f"{name} is not finite")
    array.flags.writeable = False
    return array


def _as_json(provenance: object) -> dict[str, Any]:
    """Return an own copy in the form that a file gives back (lists for tuples)."""
    try:
        copy = json.loads(json.dumps(provenance, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ModelError(f"provenance cannot be written as JSON: {error}") from None
    if not isinstance(copy, dict):
        raise ModelError(f"provenance must be a mapping: {provenance!r}")
    return copy


def _check_extents(model: Model) -> None:
    """Raise ModelError where the shapes of the arrays do not fit together."""
    if model.theta.ndim != 2 or model.projections.ndim != 2 or not model.projections.size:
        raise ModelError(
            "theta and projections must be matrices and not empty: "
            f"{model.theta.shape}, {model.projections.shape}"
        )
    r, D = model.theta.shape
    N = len(model.projections)
    wanted = {
        "mean": (D,),
        "scale": (D,),
        "projections": (N, r),
        "covariances": (N, 6, 6),
    }
    if len(model.input_range):
        wanted["input_range"] = (2, D)
    if len(model.training_mean):
        wanted["training_mean"] = (6, 6)
    if model.rho_quantiles.ndim != 1 or (np.diff(model.rho_quantiles) < 0.0).any():
        raise ModelError("rho_quantiles are not ascending numbers")
    for name, extents in wanted.items():
        if (found := getattr(model, name).shape) != extents:
            raise ModelError(f"{name} has shape {found}, expected {extents}")
    if len(model.input_range) and not (model.input_range[0] <= model.input_range[1]).all():
        raise ModelError("input_range is not the least and the largest inputs")
    turns = model.rotations_rad
    if turns.ndim != 1 or 0.0 not in turns or N % len(turns):
        raise ModelError(f"the model's {N} examples are not turns by {turns.tolist()} rad")


def _check_settings(model: Model) -> None:
    """Raise ModelError for a scale, shape or weight out of range."""
    if not (model.scale > 0).all():
        raise ModelError("scale is not positive")
    if model.shape not in SHAPES:
        raise ModelError(f"shape must be one of {', '.join(SHAPES)}: {model.shape!r}")
    if model.frame not in FRAMES:
        raise ModelError(f"frame must be one of {', '.join(FRAMES)}: {model.frame!r}")
    if model.features not in KINDS:
        raise ModelError(f"features must be one of {', '.join(KINDS)}: {model.features!r}")
    if not 0.0 <= _number("mean_weight", model.mean_weight) <= 1.0:
        raise ModelError(f"mean_weight must be in [0, 1]: {model.mean_weight!r}")
    if not 0.0 < _number("margin", model.margin) < math.inf:
        raise ModelError(f"margin must be positive and finite: {model.margin!r}")


def _checked(lost: Lost) -> Lost:
    """Return an own, read-only copy of what is known of other minima, or raise ModelError."""
    limit_m, covariance = _number("lost.limit_m", lost.limit_m), _frozen("lost", lost.covariance)
    if not 0.0 < limit_m < math.inf:
        raise ModelError(f"lost.limit_m must be positive and finite: {limit_m!r}")
    if covariance.shape != (6, 6) or not is_positive_definite(covariance):
        raise ModelError("lost.covariance is not a positive definite 6x6 matrix")
    return Lost(limit_m, covariance)


def _checked_bias(bias: Bias) -> Bias:
    """Return the bias as numbers, or raise ModelError."""
    if not isinstance(bias, Bias):
        raise ModelError(f"bias must be a Bias: {bias!r}")
    share, way_m = _number("bias.share", bias.share), _number("bias.way_m", bias.way_m)
    if not 0.0 <= share <= 1.0:
        raise ModelError(f"bias.share must be in [0, 1]: {share!r}")
    if not 0.0 < way_m < math.inf:
        raise ModelError(f"bias.way_m must be positive and finite: {way_m!r}")
    return Bias(share, way_m)


def _number(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ModelError(f"{name} must be a number: {value!r}")
    return float(value)
