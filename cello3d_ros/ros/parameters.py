"""ROS parameters from the configuration: declared by walking its sections, checked by it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from cello3d_ros.config import PIPELINE, PIPELINES, SECTIONS, Config, IcpConfig
from cello3d_ros.errors import ConfigError
from cello3d_ros.registration.backends import check_installed

MODEL, AUTOSTART, PIPELINE_NAME = "node.model", "node.autostart", "pipeline"
T_BASE_SENSOR = "node.T_base_sensor"

_SECTIONS = {name: SECTIONS[name] for name in (*PIPELINE, "node")}  # others are the tools'
_FIXED = {PIPELINE_NAME, "cloud", "grid"}  # sections read once, by configure
_FIXED_SETTINGS = {
    *(MODEL, AUTOSTART),
    *(T_BASE_SENSOR, "node.odometry_buffer_s", "node.seed"),
    *("node.pairing", "node.registration", "node.use_tf", "node.publish_tf", "node.points_type"),
}
_ELSEWHERE = {"sampling", "training", "qos_overrides"}  # read by the tools, and by ROS
_PIPELINE_FIELD: Any = dataclasses.field(
    default="",
    metadata={
        "doc": "where cloud, icp, overlap and grid are from; empty is the model's pipeline",
        "low": -math.inf,
        "high": math.inf,
        "choices": tuple(PIPELINES),
    },
)
_INT64 = 2**63 - 1


def declare_first(node: Node) -> None:
    """Declare what is needed to configure: the defaults of the others come from the model."""
    _declare(node, PIPELINE_NAME, _PIPELINE_FIELD, "")
    for field in dataclasses.fields(_SECTIONS["node"]):
        if (name := f"node.{field.name}") in (MODEL, AUTOSTART):
            _declare(node, name, field, field.default)


def release(node: Node, defaults: Config) -> None:
    """Undeclare the settings still at their defaults: the next model brings its own."""
    for section in _SECTIONS:
        for field in dataclasses.fields(_SECTIONS[section]):
            name, value = (
                f"{section}.{field.name}",
                getattr(getattr(defaults, section), field.name),
            )
            if name in (MODEL, AUTOSTART) or not node.has_parameter(name):
                continue
            if _plain(node.get_parameter(name).value) == value:
                node.undeclare_parameter(name)


def declare(node: Node, defaults: Config) -> Config:
    """Declare every setting as ``section.name`` and return what they are set to.

    A setting that is declared keeps its value.  Raises ConfigError naming the parameter, its
    value and what is allowed.
    """
    given = overrides(node)
    values: dict[str, Any] = {}
    for section in _SECTIONS:
        _built(section, _of(section, given))
        for field in dataclasses.fields(_SECTIONS[section]):
            name = f"{section}.{field.name}"
            default = getattr(getattr(defaults, section), field.name)
            if node.has_parameter(name):
                values[name] = node.get_parameter(name).value
            else:
                values[name] = _declare(node, name, field, default)
    return _config(defaults, values)


def changed(config: Config, parameters: Iterable[Parameter]) -> Config:
    """Return the configuration with some parameters set anew.

    Raises ConfigError for a value out of range and for a setting that only configure reads.
    """
    parameters = list(parameters)
    for name in (parameter.name for parameter in parameters):
        if name.split(".")[0] in _FIXED or name in _FIXED_SETTINGS:
            raise ConfigError(
                f"parameter {name} is read when the node is configured: "
                "clean the node up, set it and configure again"
            )
    new = {parameter.name: parameter.value for parameter in parameters}
    return _config(config, {name: new.get(name, v) for name, v in _values(config).items()})


def check(node: Node, given: Iterable[Parameter]) -> None:
    """Raise ConfigError for a parameter of a node that is not configured and can never be good."""
    new = {parameter.name: parameter.value for parameter in given}
    for section in _SECTIONS:
        fields = (f"{section}.{field.name}" for field in dataclasses.fields(_SECTIONS[section]))
        old = {name: node.get_parameter(name).value for name in fields if node.has_parameter(name)}
        if old or _of(section, new):
            _built(section, _of(section, {**old, **new}))


def overrides(node: Node) -> dict[str, Any]:
    """Return the parameters given to the node from outside, by files or ``-p``."""
    return {name: given.value for name, given in node._parameter_overrides.items()}


def unknown(node: Node) -> list[str]:
    """Return the names given from outside that the node does not have."""
    return sorted(
        name
        for name in overrides(node)
        if not node.has_parameter(name) and name.split(".")[0] not in _ELSEWHERE
    )


def _declare(node: Node, name: str, field: dataclasses.Field[Any], default: Any) -> Any:
    value = list(default) if isinstance(default, tuple) else default
    try:
        return node.declare_parameter(name, value, _descriptor(name, field)).value
    except InvalidParameterTypeException:
        given = overrides(node)[name]
        kind = _kind(field.default)
        hint = " (write a decimal point, such as 1.0)" if "float" in kind else ""
        raise ConfigError(f"parameter {name} must be of type {kind}{hint}: {given!r}") from None
    except ParameterException as error:
        raise ConfigError(f"parameter {name}: {error}") from None


def _descriptor(name: str, field: dataclasses.Field[Any]) -> ParameterDescriptor:
    low, high = field.metadata["low"], field.metadata["high"]
    descriptor = ParameterDescriptor(name=name, description=field.metadata["doc"])
    if field.metadata["choices"]:
        descriptor.additional_constraints = "one of " + ", ".join(field.metadata["choices"])
    elif isinstance(field.default, tuple) and (low, high) != (-math.inf, math.inf):
        descriptor.additional_constraints = f"each in [{low:g}, {high:g}]"
    elif type(field.default) is float:
        span = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        descriptor.floating_point_range = [span]
    elif type(field.default) is int:
        ends = (int(max(-_INT64, min(_INT64, end))) for end in (low, high))
        descriptor.integer_range = [IntegerRange(from_value=next(ends), to_value=next(ends))]
    return descriptor


def _kind(default: Any) -> str:
    if isinstance(default, tuple):
        return f"list of {type(default[0]).__name__}"
    return type(default).__name__


def _of(section: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values whose names are settings of one section, by their short names."""
    known = {field.name for field in dataclasses.fields(_SECTIONS[section])}
    return {name: values[f"{section}.{name}"] for name in known if f"{section}.{name}" in values}


def _values(config: Config) -> dict[str, Any]:
    """Return every setting by its name as a parameter."""
    return {
        f"{section}.{field.name}": getattr(getattr(config, section), field.name)
        for section in _SECTIONS
        for field in dataclasses.fields(_SECTIONS[section])
    }


def _config(others: Config, values: dict[str, Any]) -> Config:
    """Return the settings of the values; those that are no parameters come from another."""
    built = {section: _built(section, _of(section, values)) for section in _SECTIONS}
    return dataclasses.replace(others, **built)


def _built(section: str, values: dict[str, Any]) -> Any:
    """Build a section; ConfigError speaks of parameters as they are called in ROS."""
    kind = _SECTIONS[section]
    try:
        built = kind(**{name: _plain(value) for name, value in values.items()})
        if isinstance(built, IcpConfig):
            check_installed(built)
        return built
    except ConfigError as error:
        text = str(error).replace(f"{kind.__name__}.", f"parameter {section}.")
        raise ConfigError(text) from None


def _plain(value: Any) -> Any:
    """Return a parameter's value as the configuration has it."""
    return value if isinstance(value, (bool, int, float, str)) else tuple(value)
