"""Reading what ``cello3d evaluate --json`` wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cello3d_ros.errors import Cello3dError

_NEEDED = {
    "model": str,
    "shape": str,
    "n_pairs": int,
    "methods": dict,
    "recordings": dict,
    "pairs": list,
    "calibration": dict,
    "worst_pairs": list,
    "trajectories": dict,
}


class EvaluationError(Cello3dError):
    """An evaluation cannot be read."""


def read_evaluation(path: Path) -> dict[str, Any]:
    """Return an evaluation.  Raises EvaluationError for one that is damaged or too old."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refused)
    except OSError as error:
        raise EvaluationError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise EvaluationError(f"{path} is no JSON of cello3d evaluate: {error}") from None
    if not isinstance(found, dict) or not isinstance(found.get("methods"), dict):
        raise EvaluationError(f"{path} is no JSON of cello3d evaluate: it has no 'methods'")
    if missing := [name for name in _NEEDED if name not in found]:
        raise EvaluationError(
            f"{path} is of an earlier version: it lacks {missing[0]!r}; run cello3d evaluate again"
        )
    for name, kind in _NEEDED.items():
        if not isinstance(found[name], kind):
            raise EvaluationError(f"{path} is damaged: {name!r} is not a {kind.__name__}")
    return {name: _renamed(value) for name, value in found.items()}


def _renamed(value: Any) -> Any:
    """Return a value with today's names of methods; the model's was once "model"."""
    if isinstance(value, list):
        return [_renamed(item) for item in value]
    if not isinstance(value, dict):
        return value
    names = {"model": "cello3d", "model_widened": "cello3d_widened"}
    return {names.get(name, name): _renamed(item) for name, item in value.items()}


def _refused(word: str) -> Any:
    raise ValueError(f"{word} is no JSON number")
