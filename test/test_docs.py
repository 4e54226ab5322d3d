"""Examples in docstrings and in README run, and the pages of the Python interface are made."""

from __future__ import annotations

import doctest
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.geometry.se3 import Array, exp, inverse, transform

ROOT = Path(__file__).parents[1]


def modules_with_examples() -> list[str]:
    files = sorted((ROOT / "cello3d_ros").rglob("*.py"))
    paths = [path.relative_to(ROOT) for path in files if ">>> " in path.read_text()]
    return [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in paths]


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_in_docstrings_say_what_happens(name: str) -> None:
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0
    assert found.failed == 0


def test_the_python_of_readme_runs(room: tuple[Array, Array]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    blocks = [block for block in blocks if "cello.Estimator" in block]
    assert blocks
    T = exp([0.3, -0.2, 0.05, 0.01, 0.02, 0.15])
    for block in blocks:
        names = {
            "reading_xyz": transform(inverse(T), room[0]),
            "reference_xyz": room[1],
            "T_init": T @ exp([0.05, 0.02, 0.0, 0.0, 0.0, 0.02]),
        }
        exec(block, names)
        np.testing.assert_allclose(names["r"].T_ref_read, T, atol=0.03)


def test_the_pages_of_the_interface_have_every_name(tmp_path: Path) -> None:
    pytest.importorskip("pdoc")
    import cello3d_ros

    command = [sys.executable, str(ROOT / "docs" / "api.py"), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    assert done.stderr == ""
    page = (tmp_path / "cello3d_ros.html").read_text()
    assert all(f'id="{name}"' in page for name in cello3d_ros.__all__)
