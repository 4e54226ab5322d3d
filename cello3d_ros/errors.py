"""Errors that a user can act on; the command line and the node turn each into one sentence."""

from typing import ClassVar


class Cello3dError(Exception):
    """Root of every error that this package raises on purpose.

    reason: the short name under which the node counts clouds that it skips.
    """

    reason: ClassVar[str] = "internal"


class ConfigError(Cello3dError):
    """A setting has the wrong type, is out of range or is unknown."""


class CloudError(Cello3dError):
    """A point cloud cannot be read, or too little of it is left to work with."""

    reason = "too_few_points"


class PlanarCloudError(CloudError):
    """A cloud is a 2-D scan."""

    reason = "two_dimensional"


class RegistrationError(Cello3dError):
    """ICP has no answer: too few points or a singular system."""

    reason = "registration"


class NotConvergedError(RegistrationError):
    """ICP stopped before it settled."""

    reason = "not_converged"


class FreeDirectionError(RegistrationError):
    """No plane of the overlap holds some direction: any answer would be made up."""

    reason = "free_direction"


class NoOverlapError(RegistrationError):
    """Two registered clouds share too little geometry."""

    reason = "no_overlap"


class CovarianceError(Cello3dError):
    """A covariance cannot be published."""

    reason = "covariance"


class ModelError(Cello3dError):
    """A model file is missing, damaged, of another version or does not fit its use."""

    reason = "beyond_model"


class DatasetError(Cello3dError):
    """A dataset folder is damaged, incomplete or was made with other settings."""


class RecordingError(Cello3dError):
    """A recording cannot be read or written."""


class WriteError(Cello3dError):
    """A file or folder cannot be written."""


def counted(n: int, thing: str) -> str:
    """Return a number of things in words: ``1 scan``, ``2 scans``."""
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


def how_to_install(extra: str, error: Exception) -> str:
    """Return what to do about an optional library that raised an error when imported.

    A library that is there and cannot load lacks libraries of the system.
    """
    if isinstance(error, ModuleNotFoundError):
        return f"pip install 'cello3d_ros[{extra}]' ({error})"
    return (
        f"it is installed, but a library of the system is missing ({error}): "
        "apt-get install libgl1 libegl1 libgomp1 libx11-6 libusb-1.0-0 libidn2-0 libudev1"
    )
