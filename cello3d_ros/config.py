"""Settings: frozen dataclasses, one section a room, validated when built, YAML in and out.

The same YAML file serves the tools and, as a ROS parameter file, the node: the sections may stand
at the top level or below ``/**: ros__parameters:``.  Every setting is a bool, int, float, str or a
tuple of one of them, so that each is also a ROS parameter (``section.name``).  Cloud, icp, overlap
and grid, the pipeline, start from the one that the key ``pipeline`` names.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import yaml

from cello3d_ros.errors import ConfigError


def _setting(
    default: Any,
    doc: str,
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
) -> Any:
    return field(
        default=default, metadata={"doc": doc, "low": low, "high": high, "choices": choices}
    )


def _checked(setting: dataclasses.Field[Any], value: Any, owner: str) -> Any:
    """Return ``value`` in the type of the setting's default, or raise ConfigError."""
    name = f"{owner}.{setting.name}"
    default = setting.default
    if isinstance(default, tuple):
        if not isinstance(value, (tuple, list)):
            raise ConfigError(f"{name} must be a list of {type(default[0]).__name__}: {value!r}")
        return tuple(_checked_scalar(setting, item, default[0], name) for item in value)
    return _checked_scalar(setting, value, default, name)


def _checked_scalar(setting: dataclasses.Field[Any], value: Any, default: Any, name: str) -> Any:
    wanted = type(default)
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise ConfigError(f"{name} must be of type {wanted.__name__}: {value!r}")
    choices = setting.metadata["choices"]
    if choices and value not in choices:
        raise ConfigError(f"{name} must be one of {', '.join(choices)}: {value!r}")
    low, high = setting.metadata["low"], setting.metadata["high"]
    if wanted in (int, float) and not low <= value <= high:
        allowed = f"at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        raise ConfigError(f"{name} must be {allowed}: {value!r}")
    return value


#: The covariance methods that the node, ``estimate --method`` and ``Estimator`` offer.
COVARIANCE_MODES = ("cello3d", "fused", "sigma_points", "censi", "hessian", "constant")


class Section:
    """Base of every section: checks type and range of each field when built."""

    def __post_init__(self) -> None:
        for setting in dataclasses.fields(self):  # type: ignore[arg-type]
            value = _checked(setting, getattr(self, setting.name), type(self).__name__)
            object.__setattr__(self, setting.name, value)


@dataclass(frozen=True, kw_only=True)
class CloudConfig(Section):
    """Filters of a scan and the neighbourhood of its normals and features."""

    min_range_m: float = _setting(0.5, "points nearer to the sensor are dropped", 0.0)
    max_range_m: float = _setting(100.0, "points farther from the sensor are dropped", 0.0)
    min_support: float = _setting(
        0.1,
        "in snow, rain and dust a point is dropped unless this share of the points in its "
        "direction is about as far away; 0 drops none",
        0.0,
        1.0,
    )
    voxel_m: float = _setting(0.1, "side of the cubes in which density is bounded", 1e-3)
    max_points_per_voxel: int = _setting(4, "points kept in one cube, drawn at random", 1)
    n_neighbors: int = _setting(20, "neighbours of a normal and its features", 3, 64)
    min_spread: float = _setting(
        0.4,
        "least second spread of the neighbours, against the first, that makes a plane: else two "
        "and three times as many are tried; 0 takes any (the paper)",
        0.0,
        1.0,
    )


@dataclass(frozen=True, kw_only=True)
class IcpConfig(Section):
    """ICP (Table I of the paper lists what it is made of)."""

    backend: str = _setting(
        "icp",
        "what registers; icp is this package's own and follows all settings below",
        choices=("icp", "open3d_point_to_plane", "open3d_gicp", "small_gicp"),
    )
    max_distance_m: float = _setting(
        2.0, "largest distance of associated points, for other backends than icp", 1e-3
    )
    error_metric: str = _setting(
        "point_to_plane", "what ICP minimises", choices=("point_to_plane", "point_to_point")
    )
    n_neighbors: int = _setting(3, "associations of each reading point", 1, 16)
    trim_ratio: float = _setting(0.7, "share of the associations kept, the closest", 0.01, 1.0)
    max_iterations: int = _setting(80, "iterations before ICP gives up", 1, 10000)
    rotation_epsilon_rad: float = _setting(1e-3, "mean rotation step that ends ICP", 0.0)
    translation_epsilon_m: float = _setting(1e-3, "mean translation step that ends ICP", 0.0)
    n_smoothed: int = _setting(3, "steps over which those means are taken", 1, 100)
    n_reading_points: int = _setting(5000, "random subsample of the reading; 0 is all of it", 0)
    n_reference_points: int = _setting(
        0, "random subsample of the reference; 0 is all of it, with the tree it has", 0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("n_reading_points", "n_reference_points"):
            if 0 < getattr(self, name) < 10:
                raise ConfigError(f"IcpConfig.{name} must be 0 or at least 10")


@dataclass(frozen=True, kw_only=True)
class OverlapConfig(Section):
    """Points of the two registered clouds that have a neighbour in the other."""

    radius_m: float = _setting(0.316, "largest distance of overlapping points", 1e-3)
    min_points: int = _setting(100, "fewest overlapping points of an answer", 1)
    min_ratio: float = _setting(0.1, "smallest share of overlapping reading points", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class GridConfig(Section):
    """Voxel grid over the overlap, centred on the reading frame (Sec. V-A)."""

    n_cells: tuple[int, ...] = _setting((4, 4, 4), "cells along x, y, z", 1, 32)
    extent_m: tuple[float, ...] = _setting((25.0, 25.0, 10.0), "size along x, y, z", 1e-3)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("n_cells", "extent_m"):
            if len(getattr(self, name)) != 3:
                raise ConfigError(f"GridConfig.{name} needs three numbers: {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class SamplingConfig(Section):
    """Brute-force sampling of ICP on one pair (Sec. IV-D, V-A)."""

    n_samples: int = _setting(5000, "registrations of each pair", 50)
    variance: float = _setting(0.05, "a of the starts T_mean exp(xi), xi ~ N(0, a I)", 0.0, 10.0)
    max_gap: int = _setting(4, "largest j - i of a pair", 1)
    seed: int = _setting(0, "seed of every random draw", 0)
    max_offset_m: float = _setting(1.0, "a mean farther from the truth rejects the pair", 0.0)
    max_offset_rad: float = _setting(1.0, "a mean farther from the truth rejects the pair", 0.0)
    cluster_scale_m: float = _setting(0.1, "translation that a cluster spans at least", 1e-6)
    cluster_scale_rad: float = _setting(0.05, "rotation that a cluster spans at least", 1e-6)
    n_rotations: int = _setting(4, "turns about z of each example, 1 is none", 1, 64)
    cluster_min_share: float = _setting(
        0.05, "share of the samples below which a cluster is passed over", 0.0, 1.0
    )
    precision: float = _setting(
        0.0, "relative standard error of the eigenvalues that ends a pair; 0 takes all", 0.0, 1.0
    )
    min_samples: int = _setting(200, "fewest registrations before precision ends a pair", 50)
    noise_m: float = _setting(
        0.0, "standard deviation of range noise added at each registration", 0.0, 10.0
    )
    n_views: int = _setting(
        1, "places about the recorded ones from which a simulated pair is scanned", 1, 1000
    )


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Section):
    """Learning of Theta (Sec. IV-B)."""

    shape: str = _setting(
        "sandwich",
        "what covariances are relative to; none is the paper",
        choices=("none", "hessian", "sandwich"),
    )
    frame: str = _setting(
        "motion",
        "whose axes examples have: x along the horizontal motion, or those of the sensor (paper)",
        choices=("motion", "sensor"),
    )
    features: str = _setting(
        "global",
        "what Theta is learned over; descriptor is the paper's, global a few numbers of the pair",
        choices=("descriptor", "global", "both"),
    )
    standardize: bool = _setting(
        True, "scale each input to mean 0 and deviation 1; the paper takes them as they are"
    )
    start_rho: float = _setting(
        1.0, "median rho of the Theta that training starts from; near 0 all weights are equal", 0.0
    )
    theta: str = _setting(
        "diagonal", "form of Theta", choices=("upper_triangular", "diagonal", "low_rank")
    )
    rank: int = _setting(16, "rows of a low-rank Theta", 1, 10000)
    loss: str = _setting("log_det", "paper is the printed det F", choices=("log_det", "paper"))
    regularization: float = _setting(0.03, "lambda of lambda |Theta|^2", 0.0)
    mean_weight: float = _setting(0.02, "share of the training mean in a prediction", 0.0, 1.0)
    margin: float = _setting(
        1.0, "factor on every predicted covariance, for what training data leave out", 1e-3, 1e3
    )
    optimizer: str = _setting(
        "lbfgs", "what searches Theta; sgd is the paper's", choices=("lbfgs", "sgd")
    )
    learning_rate: float = _setting(
        1e-5, "of sgd: Theta goes down this times each pair's gradient", 1e-12
    )
    max_iterations: int = _setting(100, "optimiser steps; of sgd, passes over all pairs", 1)
    seed: int = _setting(0, "seed of the initial Theta", 0)


@dataclass(frozen=True, kw_only=True)
class InputConfig(Section):
    """What the node hears, and where and when the sensor is."""

    points_type: str = _setting(
        "PointCloud2",
        "type of the clouds: sensor_msgs/PointCloud2 or livox_ros_driver2/CustomMsg",
        choices=("PointCloud2", "CustomMsg"),
    )
    T_base_sensor: tuple[float, ...] = _setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "sensor in the odometry's child frame: x y z qx qy qz qw",
    )
    use_tf: bool = _setting(
        False, "take the sensor in the odometry's child frame from /tf, not from T_base_sensor"
    )
    base_frame: str = _setting("base_link", "the child frame of odometry that names none")
    registration: str = _setting(
        "icp",
        "who registers: this node, or another program (external_odometry or external_pose)",
        choices=("icp", "external"),
    )
    external_tolerance_s: float = _setting(
        1e-3, "largest distance in time of an external pose and its cloud", 0.0, 1.0
    )
    guess_without_odometry: str = _setting(
        "skip",
        "what to do with a cloud for which no odometry came in time",
        choices=("skip", "constant_velocity", "extrapolate"),
    )
    max_extrapolation_s: float = _setting(0.5, "odometry is not extrapolated farther", 0.0, 60.0)
    max_odometry_speed_m_s: float = _setting(
        50.0, "odometry that moves faster has jumped: the chain starts again", 1e-3
    )
    odometry_timeout_s: float = _setting(0.5, "wait for odometry after a cloud's stamp", 0.0, 60.0)
    odometry_gap_s: float = _setting(1.0, "odometry farther apart is not interpolated", 0.0)
    odometry_buffer_s: float = _setting(10.0, "odometry remembered", 0.1, 3600.0)
    deskew: bool = _setting(
        True,
        "undo the motion of the sensor within a cloud whose points have times, by odometry or the "
        "last registration; false where the driver has done it",
    )
    cloud_time_offset_s: float = _setting(
        0.0, "added to the stamps of clouds: a constant delay, or a clock of PTP or since boot"
    )
    future_tolerance_s: float = _setting(0.5, "a cloud stamped later than now + this", 0.0)


@dataclass(frozen=True, kw_only=True)
class PairingConfig(Section):
    """What a scan is registered to, and when an answer is none."""

    pairing: str = _setting(
        "keyframe",
        "what a cloud is registered to: a keyframe, the last that moved or reference_points",
        choices=("keyframe", "consecutive", "topics"),
    )
    keyframe_distance_ratio: float = _setting(
        0.15,
        "distance that makes a new keyframe, relative to the median range of its points",
        0.0,
    )
    keyframe_angle_rad: float = _setting(0.35, "rotation that makes a new keyframe", 0.0)
    keyframe_min_overlap: float = _setting(
        0.5, "overlap below which a new keyframe is made", 0.0, 1.0
    )
    reference_range_m: float = _setting(
        60.0, "points of reference_points used around the sensor", 1.0, 1e4
    )
    max_reference_points: int = _setting(
        50_000, "more points of them are thinned out", 1000, 10_000_000
    )
    max_external_offset: float = _setting(
        0.5, "an external pose that ICP would move farther (m, rad) is refused; 0 is no look", 0.0
    )
    max_odometry_deviation_m: float = _setting(
        1.0,
        "a registration farther from its odometry is refused, "
        "unless odometry tells a covariance; 0 is no look",
        0.0,
    )
    max_odometry_deviation_rad: float = _setting(0.5, "the same for rotations", 0.0)
    publish_disagreeing: bool = _setting(
        False, "publish what disagrees with odometry, with a warning, instead of refusing it"
    )
    planar: bool = _setting(
        False, "z, roll and pitch of the base by odometry alone: for robots that stay on a floor"
    )
    max_pair_gap_s: float = _setting(10.0, "scans farther apart are not paired", 0.0)
    max_failures: int = _setting(3, "failed pairs before the reference is given up", 1)
    seed: int = _setting(0, "seed of the random subsamples", 0)


@dataclass(frozen=True, kw_only=True)
class CovarianceConfig(Section):
    """How the covariance of a registration is found."""

    covariance_mode: str = _setting(
        "cello3d",
        "how the covariance is found; fused is experimental",
        choices=COVARIANCE_MODES,
    )
    sensor_sigma_m: float = _setting(
        0.01, "range noise that censi, hessian and sigma_points assume", 1e-6, 10.0
    )
    n_registrations: int = _setting(12, "extra runs of ICP of the mode fused", 1, 200)
    scale: float = _setting(1.0, "every covariance is multiplied by this", 1e-6, 1e6)
    unknown_quantile: float = _setting(
        0.99,
        "share of the model's examples nearer to another recording than a known pair",
        0.0,
        1.0,
    )
    inflate_unknown: bool = _setting(
        True, "widen the model's prediction for an unknown pair to the mean of its examples"
    )


@dataclass(frozen=True, kw_only=True)
class OutputConfig(Section):
    """What the node publishes."""

    output_frame: str = _setting(
        "sensor",
        "whose motion is published: the sensor's or the odometry's child frame's",
        choices=("sensor", "base"),
    )
    warn_sigma_m: float = _setting(0.3, "3 sigma along the weakest axis that warns", 0.0)
    error_sigma_m: float = _setting(1.0, "3 sigma along the weakest axis that is an error", 0.0)
    floor_sigma_m: float = _setting(1e-4, "smallest published standard deviation", 1e-9)
    floor_sigma_rad: float = _setting(1e-4, "smallest published standard deviation", 1e-9)
    ceiling: float = _setting(900.0, "largest published eigenvalue (m^2, rad^2)", 1e-6, 1e3)
    marker_scale: float = _setting(1.0, "~/markers are drawn this many times as large", 1e-3, 1e6)
    marker_lifetime_s: float = _setting(10.0, "~/markers vanish after this; 0 is never", 0.0)
    publish_tf: bool = _setting(False, "publish ~/pose on /tf as well; needs tf2_msgs")


@dataclass(frozen=True, kw_only=True)
class NodeConfig(OutputConfig, CovarianceConfig, PairingConfig, InputConfig):
    """What only the node needs."""

    model: str = _setting("", "model file or name of a shipped one; empty is general")
    autostart: bool = _setting(
        True, "configure and activate at once; false waits for a life cycle manager"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        norm = math.hypot(*self.T_base_sensor[3:])
        if len(self.T_base_sensor) != 7 or abs(norm - 1.0) > 1e-3:
            raise ConfigError(
                "NodeConfig.T_base_sensor needs x y z and a unit quaternion qx qy qz qw: "
                f"{self.T_base_sensor}"
            )
        for name in ("floor_sigma_m", "floor_sigma_rad"):
            if (floor := getattr(self, name)) ** 2 >= self.ceiling:
                raise ConfigError(
                    f"NodeConfig.{name} must be below the root of NodeConfig.ceiling, "
                    f"{math.sqrt(self.ceiling):g}: {floor}"
                )
        if self.use_tf and self.publish_tf and self.output_frame == "sensor":
            raise ConfigError(
                "NodeConfig.publish_tf with NodeConfig.use_tf would give the sensor a second "
                "parent and cut it from the base: set NodeConfig.output_frame to base"
            )


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """The settings from which a covariance follows: a model carries those it was trained with."""

    cloud: CloudConfig = field(default_factory=CloudConfig)
    icp: IcpConfig = field(default_factory=IcpConfig)
    overlap: OverlapConfig = field(default_factory=OverlapConfig)
    grid: GridConfig = field(default_factory=GridConfig)


@dataclass(frozen=True, kw_only=True)
class Config(Pipeline):
    """All sections."""

    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    node: NodeConfig = field(default_factory=NodeConfig)


#: What a model is trained and used with: ``robot`` for robots, ``paper`` for Table I of the paper.
PIPELINES = {
    "robot": Pipeline(),
    "paper": Pipeline(
        cloud=CloudConfig(voxel_m=0.2, min_support=0.0, min_spread=0.0),
        icp=IcpConfig(n_reading_points=2000, n_reference_points=10000),
    ),
}

SECTIONS: dict[str, type[Any]] = {
    "cloud": CloudConfig,
    "icp": IcpConfig,
    "overlap": OverlapConfig,
    "grid": GridConfig,
    "sampling": SamplingConfig,
    "training": TrainingConfig,
    "node": NodeConfig,
}

PIPELINE = ("cloud", "icp", "overlap", "grid")
UNSEEN = ("cloud", "min_support")  # what a model knows nothing of: it learned in clear weather
_SCATTER = ("variance", "noise_m")  # of sampling: what the registrations of a model scattered by

S = TypeVar("S", bound=Section)


def named_pipeline(name: Any, where: str) -> Pipeline:
    """Return one of ``PIPELINES``.  Raises ConfigError."""
    if not isinstance(name, str) or name not in PIPELINES:
        raise ConfigError(f"{where}: pipeline must be one of {', '.join(PIPELINES)}: {name!r}")
    return PIPELINES[name]


def pipeline_name(pipeline: Pipeline) -> str:
    """Return the name in ``PIPELINES`` of what is the same or, ``changed``, the most alike."""
    n_unlike = {name: len(differences(pipeline, other)) for name, other in PIPELINES.items()}
    name = min(n_unlike, key=n_unlike.__getitem__)
    return f"{name}, changed" if n_unlike[name] else name


def config_from(tree: dict[str, Any], where: str = "configuration") -> Config:
    """Build a Config from nested mappings; what is not named is that of ``pipeline`` (robot)."""
    base = Config(**sections_of(named_pipeline(tree.get("pipeline", "robot"), where)))
    sections = {name: values for name, values in tree.items() if name != "pipeline"}
    if unknown := sorted(set(sections) - set(SECTIONS)):
        raise ConfigError(
            f"{where}: unknown section {unknown[0]!r}; known are pipeline, {', '.join(SECTIONS)}"
        )
    for name, values in sections.items():
        if not isinstance(values, dict):
            raise ConfigError(f"{where}: section {name!r} must hold settings, not {values!r}")
        sections[name] = _section_from(getattr(base, name), values, f"{where}: {name}")
    return dataclasses.replace(base, **sections)


def _section_from(base: S, values: dict[str, Any], where: str) -> S:
    """Return a section with some values set anew.  Raises ConfigError naming what is wrong."""
    known = {setting.name for setting in dataclasses.fields(base)}  # type: ignore[arg-type]
    if unknown := sorted(set(values) - known):
        raise ConfigError(
            f"{where}: unknown setting {unknown[0]!r}; known are {', '.join(sorted(known))}"
        )
    try:
        return dataclasses.replace(base, **values)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def config_to(config: Pipeline) -> dict[str, dict[str, Any]]:
    """Return the nested mappings from which ``config_from`` builds an equal Config."""
    return {
        name: {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in dataclasses.asdict(getattr(config, name)).items()
        }
        for name in SECTIONS
        if hasattr(config, name)
    }


def sections_of(config: Pipeline) -> dict[str, Any]:
    """Return the sections from which a covariance follows, by their names."""
    return {name: getattr(config, name) for name in PIPELINE}


def pipeline_of(config: Pipeline) -> Pipeline:
    """Return only the sections from which a covariance follows."""
    return Pipeline(**sections_of(config))


def differences(ours: Pipeline, theirs: Pipeline) -> list[str]:
    """Name each setting that differs and matters: ``icp.trim_ratio is 0.8, not 0.7``.

    Those of the pipeline, and of two whole Configs the variances of sampling.
    """
    settings = [
        (name, field.name)
        for name in PIPELINE
        for field in dataclasses.fields(getattr(ours, name))
        if (name, field.name) != UNSEEN
    ]
    if isinstance(ours, Config) and isinstance(theirs, Config):
        settings += [("sampling", key) for key in _SCATTER]
    return [
        f"{name}.{key} is {value}, not {other}"
        for name, key in settings
        if (value := getattr(getattr(ours, name), key))
        != (other := getattr(getattr(theirs, name), key))
    ]


def pipeline_warning(model: Pipeline, used: Pipeline) -> str:
    """Return what to say where a pipeline is not the one that a model was trained with, or ""."""
    if not (found := differences(used, model)):
        return ""
    return (
        f"the model was trained with the pipeline {pipeline_name(model)}, this is "
        f"{pipeline_name(used)}: {'; '.join(found)}"
    )


def load_config(path: Path | str, pipeline: str = "") -> Config:
    """Read a YAML file, plain or a ROS parameter file.  Raises ConfigError.

    pipeline: one of ``PIPELINES`` in place of the file's, whose sections still win.
    """
    try:
        with open(path, encoding="utf-8") as stream:
            tree = yaml.safe_load(stream) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"cannot read the configuration {path}: {why}") from None
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected sections such as 'icp:', found {tree!r}")
    for value in tree.values():
        if isinstance(value, dict) and "ros__parameters" in value:
            tree = value["ros__parameters"] or {}
            break
    return config_from({**tree, "pipeline": pipeline} if pipeline else tree, str(path))
