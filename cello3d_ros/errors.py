"""Errors that a user can act on; the command line and the node turn each into one sentence."""


class Cello3dError(Exception):
    """Root of every error that this package raises on purpose."""


class ConfigError(Cello3dError):
    """A setting has the wrong type, is out of range or is unknown."""


class CloudError(Cello3dError):
    """A point cloud cannot be read, or too little of it is left to work with."""


class RegistrationError(Cello3dError):
    """ICP has no answer: too few points or a singular system."""


class NoOverlapError(RegistrationError):
    """Two registered clouds share too little geometry."""


class ModelError(Cello3dError):
    """A model file is missing, damaged, of another version or does not fit its use."""


class DatasetError(Cello3dError):
    """A dataset folder is damaged, incomplete or was made with other settings."""


class RecordingError(Cello3dError):
    """A recording cannot be read or written."""
