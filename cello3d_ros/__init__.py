"""CELLO-3D: the covariance of ICP registrations, sampled, learned and predicted."""

__version__ = "0.1.0"
