"""CELLO-3D: the covariance of ICP registrations, sampled, learned and predicted.

>>> import cello3d_ros as cello
>>> model = cello.load_model("general")
>>> model.shape
'sandwich'

The names below are the interface for Python; everything else may change.  They are imported when
they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cello3d_ros.covariance.estimator import Estimate as Estimate
    from cello3d_ros.covariance.estimator import Estimator as Estimator
    from cello3d_ros.covariance.estimator import Trust as Trust
    from cello3d_ros.covariance.model import Model as Model
    from cello3d_ros.covariance.model import load_model as load_model
    from cello3d_ros.errors import Cello3dError as Cello3dError
    from cello3d_ros.evaluation.evaluate import EvaluationSettings as EvaluationSettings
    from cello3d_ros.evaluation.evaluate import evaluate as evaluate
    from cello3d_ros.learning.sample import sample as sample
    from cello3d_ros.learning.train import train as train
    from cello3d_ros.recordings.files import read_cloud as read_cloud
    from cello3d_ros.recordings.opening import open_recording as open_recording

__version__ = "0.1.0"

_MODULES = {
    "Estimator": "covariance.estimator",
    "Estimate": "covariance.estimator",
    "Trust": "covariance.estimator",
    "Model": "covariance.model",
    "load_model": "covariance.model",
    "read_cloud": "recordings.files",
    "open_recording": "recordings.opening",
    "sample": "learning.sample",
    "train": "learning.train",
    "evaluate": "evaluation.evaluate",
    "EvaluationSettings": "evaluation.evaluate",
    "Cello3dError": "errors",
}
__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
