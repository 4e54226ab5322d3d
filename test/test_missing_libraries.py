"""What is said when an optional library is not installed, or is and cannot be loaded."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cello3d_ros.config import IcpConfig
from cello3d_ros.errors import Cello3dError
from cello3d_ros.registration.backends import register
from cello3d_ros.simulation.casting import Solid
from cello3d_ros.simulation.meshes import box
from cello3d_ros.simulation.world_files import PARTS


def simulate() -> None:
    Solid(box([0, 0, 0], [1, 1, 1]))


def read_mesh() -> None:
    site = SimpleNamespace(folder=Path(__file__).parent)
    PARTS["mesh"](site, file=Path(__file__).name)


def by_open3d() -> None:
    config = IcpConfig(backend="open3d_gicp")
    register(None, None, np.eye(4), config, np.random.default_rng(0))


@pytest.mark.parametrize("use", [read_mesh, by_open3d])
@pytest.mark.parametrize("library", ["libGL.so.1", "libX11.so.6"])
def test_a_library_without_its_system_libraries_names_the_packages_of_apt(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, library: str, use
) -> None:
    """Open3D raises OSError where its own loader fails, ImportError where Python's does."""
    kind = "OSError" if library == "libGL.so.1" else "ImportError"
    why = f"{library}: cannot open shared object file: No such file or directory"
    (tmp_path / "open3d.py").write_text(f"raise {kind}({why!r})\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    with pytest.raises(Cello3dError, match=library) as caught:
        use()
    assert "apt-get install libgl1 " in str(caught.value)
    assert "pip install" not in str(caught.value)


@pytest.mark.parametrize(
    ("use", "module", "extra"),
    [
        (simulate, "embreex.mesh_construction", "simulation"),
        (read_mesh, "open3d", "open3d"),
        (by_open3d, "open3d", "open3d"),
    ],
)
def test_a_library_that_is_not_installed_names_its_extra(monkeypatch, use, module, extra) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(Cello3dError, match=rf"pip install 'cello3d_ros\[{extra}\]'") as caught:
        use()
    assert "apt-get" not in str(caught.value)
