"""The ROS parameter file with every setting at its default; config/cello3d.yaml is its output.

python -m cello3d_ros.ros.parameter_file > config/cello3d.yaml
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator
from typing import Any

from cello3d_ros.config import SECTIONS

_HEAD = """\
# Settings of cello3d_ros, each at its default: a ROS parameter file, read by the tools as well.
#   ros2 run cello3d_ros covariance_node --ros-args --params-file cello3d.yaml
# Numbers with a decimal point must keep it.  The node takes cloud, icp, overlap and grid from its
# model unless they, or the name of a pipeline, stand here: leave out what stays as it is.
/**:
  ros__parameters:
    # what cloud, icp, overlap and grid start from: robot, or paper for Table I of the paper
    pipeline: "robot"
"""


def text() -> str:
    """Return the file."""
    return _HEAD + "".join(f"    {line}\n" for line in _lines())


def _lines() -> Iterator[str]:
    for name, section in SECTIONS.items():
        yield f"{name}:  # {(section.__doc__ or '').splitlines()[0]}"
        for setting in dataclasses.fields(section):
            yield f"  # {setting.metadata['doc']}{_range(setting)}"
            yield f"  {setting.name}: {_yaml(setting.default)}"


def _range(setting: dataclasses.Field[Any]) -> str:
    low, high = setting.metadata["low"], setting.metadata["high"]
    if choices := setting.metadata["choices"]:
        return f"; {' | '.join(choices)}"
    if math.isinf(low) and math.isinf(high):
        return ""
    return f"; at least {low:g}" if math.isinf(high) else f"; {low:g} to {high:g}"


def _yaml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_yaml(item) for item in value)}]"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, float):  # YAML takes 1e-05 for a string
        plain = f"{value:.12f}".rstrip("0")
        return plain + "0" if plain.endswith(".") else plain
    return str(value).lower()


if __name__ == "__main__":
    sys.stdout.write(text())
