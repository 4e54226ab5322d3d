"""Simulated recordings that can be scanned again: how a bag says what it is a simulation of."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cello3d_ros.errors import Cello3dError, RecordingError
from cello3d_ros.recordings.opening import open_recording
from cello3d_ros.recordings.recording import Recording
from cello3d_ros.simulation.drives import Drive
from cello3d_ros.simulation.scanner import Scanner
from cello3d_ros.simulation.simulation import Simulation

KEY = "simulation"  # of the bag's custom data


def told(simulation: Simulation) -> str:
    """Return the simulation as text, from which ``rescannable`` makes it again."""
    world = simulation.world
    return json.dumps(
        {
            "world": str(Path(world).resolve()) if Path(world).suffix else world,
            "seed": simulation.seed,
            "n_scans": simulation.n_scans,
            "scanner": asdict(simulation.scanner),
            "path": None if simulation.path is None else str(simulation.path.resolve()),
            "drive": None if simulation.drive is None else asdict(simulation.drive),
        }
    )


def rescannable(path: Path | str) -> Recording:
    """Return the recording at a path; one made by ``cello3d simulate`` as its simulation.

    The scans are the same, and have ``echoes``.  A recording that swept while it moved is returned
    as it is, as its scans cannot be taken again at one instant.  Raises RecordingError, also where
    the simulation no longer gives the scans that were recorded.
    """
    recording = open_recording(path)
    text = _custom_data(Path(path)).get(KEY)
    if text is None:
        return recording
    try:
        facts = json.loads(text)
        scanner = Scanner(**facts.pop("scanner"))
        way, told_drive = facts.pop("path"), facts.pop("drive", None)
        drive = None if told_drive is None else Drive(**told_drive)
        if drive is not None and drive.sweeps:
            return recording
        simulation = Simulation(
            **facts,
            scanner=scanner,
            path=None if way is None else Path(way),
            title=recording.name,
            drive=drive,
        )
        again, recorded = (next(iter(source)) for source in (simulation, recording))
    except (ValueError, TypeError, KeyError, AttributeError, Cello3dError) as error:
        raise RecordingError(f"{path}: cannot be simulated again: {error}") from None
    if again.stamp_ns != recorded.stamp_ns or not np.array_equal(again.points, recorded.points):
        raise RecordingError(
            f"{path}: the simulation that it is of gives other scans now: simulate it again"
        )
    return simulation


def _custom_data(path: Path) -> dict[str, Any]:
    """Return what was said of a rosbag2 folder by its writer; nothing where it is none."""
    file = path / "metadata.yaml"
    if not file.is_file():
        return {}
    try:
        information = yaml.safe_load(file.read_text(encoding="utf-8"))
        data = information["rosbag2_bagfile_information"].get("custom_data")
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return {}  # opening has judged it
    return data if isinstance(data, dict) else {}
