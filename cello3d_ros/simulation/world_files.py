"""Worlds described by a YAML file: solids, terrain, trees, mesh files, and a way through them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cello3d_ros.errors import RecordingError, how_to_install
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh, block, box, frustum, join, raised, terrain
from cello3d_ros.simulation.outdoor import Ground, clear_of, places, tree, uneven_ground
from cello3d_ros.simulation.paths import Route, smooth

MAX_TRIANGLES = 20_000_000


class _Site:
    """What parts may need to know while a world is built."""

    def __init__(self, folder: Path, rng: np.random.Generator) -> None:
        self.folder, self.rng = folder, rng
        self.ground: Ground = lambda xy: np.zeros(np.shape(xy)[:-1])
        self.route = Route(np.zeros((2, 3)), closed=False)


def load_world(path: Path, rng: np.random.Generator) -> tuple[Mesh, Route]:
    """Return the mesh and the route of a YAML file; what it leaves open is drawn from ``rng``.

    ``parts`` is a list of mappings of one kind each (see docs/simulation.md), ``route`` has
    ``corners`` (x, y[, z]) and ``closed``.  Raises RecordingError naming the part.
    """
    settings = _read(path)
    if unknown := sorted(set(settings) - {"parts", "route"}):
        raise RecordingError(f"{path}: unknown key {unknown[0]!r}; known are parts, route")
    site = _Site(path.parent, rng)
    parts = settings.get("parts")
    if not isinstance(parts, list) or not parts:
        raise RecordingError(f"{path}: 'parts' must be a list with at least one part")
    numbered = [(part, f"{path}: part {k}") for k, part in enumerate(parts, start=1)]
    grounds = [p for p in numbered if isinstance(p[0], dict) and "terrain" in p[0]]
    meshes = [_part(part, site, where) for part, where in grounds]
    site.route = _route(settings.get("route"), site, f"{path}: route")
    meshes += [
        _part(part, site, where) for part, where in numbered if (part, where) not in grounds
    ]
    mesh = join(meshes)
    if not len(mesh.triangles) <= MAX_TRIANGLES or not np.isfinite(mesh.vertices).all():
        raise RecordingError(f"{path}: the world is too large or not finite")
    return clear_of(site.route, mesh), site.route


def _read(path: Path) -> dict[str, Any]:
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise RecordingError(f"{path}: cannot be read ({reason})") from error
    if not isinstance(found, dict):
        raise RecordingError(f"{path}: expected 'parts' and 'route'")
    return found


def _part(part: Any, site: _Site, where: str) -> Mesh:
    if not isinstance(part, dict) or len(part) != 1:
        raise RecordingError(f"{where}: expected one of {', '.join(PARTS)} and its settings")
    ((kind, settings),) = part.items()
    if kind not in PARTS:
        raise RecordingError(f"{where}: unknown kind {kind!r}; known are {', '.join(PARTS)}")
    try:
        return PARTS[kind](site, **(settings or {}))
    except (TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        reason = str(error).replace("_", "", 1).splitlines()[0]
        raise RecordingError(f"{where}: {kind}: {reason}") from error
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from None


def _route(settings: Any, site: _Site, where: str) -> Route:
    """Return the smoothed way, on the ground where corners have no height."""
    try:
        corners = [np.asarray(c, dtype=np.float64) for c in settings["corners"]]
        flat = all(len(c) == 2 for c in corners)
        rows = np.array([[*c, 0.0] if len(c) == 2 else c for c in corners]).reshape(-1, 3)
        closed = bool(settings.get("closed", False))
        if len(rows) < (3 if closed else 2) or not np.isfinite(rows).all():
            raise ValueError("too few corners, or not finite")
        way = smooth(rows, closed)
    except (TypeError, KeyError, ValueError, IndexError) as error:
        raise RecordingError(
            f"{where}: expected corners (x, y[, z]) and closed ({error})"
        ) from error
    if flat:
        heights = site.ground(way.points[:, :2])
        return Route(np.column_stack([way.points[:, :2], heights]), closed)
    return way


def _vector(values: Any, name: str, n: int = 3) -> Array:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (n,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be {n} numbers")
    return vector


def _positive(value: Any, name: str, high: float = 1e4) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value <= high:
        raise ValueError(f"{name} must be a number above 0, at most {high:g}")
    return float(value)


def _box(site: _Site, center: Any, size: Any, yaw_deg: float = 0.0) -> Mesh:
    size = [_positive(v, "size") for v in _vector(size, "size").tolist()]
    return box(_vector(center, "center"), size, np.radians(float(yaw_deg)))


def _cylinder(
    site: _Site, base: Any, height: Any, radius: Any, top_radius: Any = None, sides: int = 16
) -> Mesh:
    base, r = _vector(base, "base"), _positive(radius, "radius")
    top_r = r if top_radius is None else _positive(top_radius, "top_radius")
    if not 3 <= int(sides) <= 1000:
        raise ValueError("sides must be between 3 and 1000")
    return frustum(base, raised(base, _positive(height, "height")), r, top_r, int(sides))


def _stairs(
    site: _Site,
    foot: Any,
    steps: int,
    rise: Any = 0.17,
    tread: Any = 0.28,
    width: Any = 1.2,
    yaw_deg: float = 0.0,
) -> Mesh:
    """Build a flight up along x from the middle of its foot, turned by the yaw."""
    n = int(_positive(steps, "steps", 1000))
    r, t, w = _positive(rise, "rise"), _positive(tread, "tread"), _positive(width, "width")
    flight = join(block([k * t, -w / 2, 0], [(k + 1) * t, w / 2, (k + 1) * r]) for k in range(n))
    c, s = np.cos(np.radians(float(yaw_deg))), np.sin(np.radians(float(yaw_deg)))
    turned = flight.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    return Mesh(turned + _vector(foot, "foot"), flight.triangles)


def _terrain(
    site: _Site,
    size: Any,
    height_std: float = 0.2,
    wavelengths: Any = (3.0, 25.0),
    roughness: float = 0.0,
    step: Any = 0.5,
) -> Mesh:
    """Build ground around the origin and put routes and trees on it."""
    half, spacing = _vector(size, "size", 2) / 2, _positive(step, "step")
    low, high = (_positive(v, "wavelengths") for v in _vector(wavelengths, "wavelengths", 2))
    if not 0 <= float(height_std) <= 100 or not 0 <= float(roughness) <= 100 or low > high:
        raise ValueError("height_std and roughness are 0 to 100, wavelengths increase")
    if half.min() <= 0 or (2 * half / spacing).prod() > MAX_TRIANGLES / 2:
        raise ValueError("size must be above 0, and have no more than 1e7 steps")
    if height_std > 0:
        site.ground = uneven_ground(site.rng, (low, high), float(height_std))
    x, y = (np.arange(-h, h + spacing, spacing) for h in half)
    z = site.ground(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))
    return terrain(x, y, z + float(roughness) * site.rng.normal(size=z.shape))


def _trees(
    site: _Site,
    count: int,
    side: Any = 40.0,
    height: Any = (4.0, 9.0),
    apart: Any = 2.0,
    clear: Any = 1.2,
    leaves: int = 200,
) -> Mesh:
    """Build trees at random places of a square around the origin, clear of the route."""
    n, low_high = int(_positive(count, "count", 10_000)), _vector(height, "height", 2)
    found = []
    for place in places(site.rng, n, _positive(side, "side"), _positive(apart, "apart")):
        tall = float(site.rng.uniform(*low_high))
        if site.route.distance(place) > _positive(clear, "clear"):
            foot = np.array([*place, float(site.ground(place))])
            found.append(tree(foot, tall, int(leaves), site.route, site.rng))
    return join(found)


def _mesh(site: _Site, file: str, scale: Any = 1.0, at: Any = (0.0, 0.0, 0.0)) -> Mesh:
    """Read triangles of .obj, .ply, .stl, .off or .gltf."""
    path = site.folder / str(file)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    o3d = _open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = o3d.io.read_triangle_mesh(str(path))
    vertices, triangles = np.asarray(found.vertices), np.asarray(found.triangles)
    if len(triangles) == 0:
        raise RecordingError(f"{path}: holds no triangle")
    moved = vertices * _positive(scale, "scale") + _vector(at, "at")
    return Mesh(moved, triangles.astype(np.int64))


def _open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise RecordingError(
            f"mesh files need Open3D: {how_to_install('open3d', error)}"
        ) from error
    return open3d


PARTS: dict[str, Callable[..., Mesh]] = {
    "box": _box,
    "cylinder": _cylinder,
    "stairs": _stairs,
    "terrain": _terrain,
    "trees": _trees,
    "mesh": _mesh,
}
