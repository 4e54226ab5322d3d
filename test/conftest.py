"""What several rooms' tests share: synthetic scenes and the optional evaluation data."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

try:
    import open3d  # noqa: F401
except ModuleNotFoundError:
    pass
except (ImportError, OSError) as error:  # it is there but lacks system libraries such as libGL
    print(f"tests that need Open3D are skipped: {error}", file=sys.stderr)
    sys.modules["open3d"] = None  # as if it were not installed


def box_surface(
    rng: np.random.Generator, n: int, size: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return n points on the surface of a box centred on the origin, and their normals."""
    half = np.array(size) / 2
    areas = np.repeat([size[1] * size[2], size[0] * size[2], size[0] * size[1]], 2)
    face = rng.choice(6, n, p=areas / areas.sum())
    axis, sign = face // 2, 2.0 * (face % 2) - 1
    points = rng.uniform(-1, 1, (n, 3)) * half
    points[np.arange(n), axis] = sign * half[axis]
    normals = np.zeros((n, 3))
    normals[np.arange(n), axis] = sign
    return points, normals


@pytest.fixture
def room() -> tuple[np.ndarray, np.ndarray]:
    """Two noisy scans (N, 3) of one furnished room, both in the room's frame."""

    def scan(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        walls, _ = box_surface(rng, 6000, (8.0, 6.0, 3.0))
        table, _ = box_surface(rng, 1500, (1.2, 0.8, 0.7))
        shelf, _ = box_surface(rng, 1500, (0.4, 2.0, 2.0))
        points = np.vstack([walls, table + [1.0, 0.5, -1.1], shelf + [-3.5, -1.0, -0.4]])
        return points + rng.normal(scale=0.005, size=points.shape)

    return scan(1), scan(2)


@pytest.fixture(scope="session")
def evaluation() -> Path:
    """Folder with the evaluation recordings (data/) and reference results (bench/)."""
    folder = os.environ.get("CELLO3D_EVALUATION", "")
    if not folder or not Path(folder).is_dir():
        pytest.skip("CELLO3D_EVALUATION names no folder with bench/ and data/")
    return Path(folder)
