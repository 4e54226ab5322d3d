"""Recorded and simulated sequences of scans."""

from cello3d_ros.recordings.opening import open_recording
from cello3d_ros.recordings.recording import ReadOptions, Recording, Scan

__all__ = ["ReadOptions", "Recording", "Scan", "open_recording"]
