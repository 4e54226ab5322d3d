"""What the beams of a scanner meet in a world: exact distances by Embree's ray tracing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cello3d_ros.errors import RecordingError, how_to_install
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.simulation.meshes import Mesh
from cello3d_ros.simulation.movers import Mover
from cello3d_ros.simulation.scanner import Echoes, Scanner

_PANE_COSINE = 0.985  # a pane seen within 10 degrees of head-on returns the beam itself
_PANE_REFLECTANCE = 0.1
_MIRRORED = 0.125  # share of the other beams that is mirrored; the rest go through
_GOLDEN = 0.6180339887498949  # its multiples spread evenly
_OFF_PANE_M = 1e-3


class Hits(NamedTuple):
    """Distance (n,) in metres, inf for none; cosine of incidence (n,); reflectance (n,)."""

    distances: Array
    cosines: Array
    reflectances: Array

    def nearer(self, other: Hits) -> Hits:
        """Return for each ray the nearer of two hits."""
        first = self.distances <= other.distances
        return Hits(*(np.where(first, a, b) for a, b in zip(self, other, strict=True)))


class Solid:
    """Triangles ready for rays.  Raises RecordingError where Embree cannot be imported.

    Embree, in float32, says which triangle a ray meets; where it meets its plane is computed in
    float64, so that distances do not depend on the processor.
    """

    def __init__(self, mesh: Mesh) -> None:
        corners = mesh.vertices[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals / np.where(length > 0.0, length, 1.0)
        self._offsets = np.einsum("ij,ij->i", self._normals, corners[:, 0])
        self._reflectances = mesh.reflectances()
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self.center = 0.5 * (low + high)
        self.radius = 0.5 * float(np.linalg.norm(high - low))
        self._scene = _embree_scene(mesh)

    def meet(self, origins: Array, directions: Array) -> Hits:
        """Return what rays (n, 3), (n, 3) with unit directions meet first."""
        rays = (np.ascontiguousarray(v, dtype=np.float32) for v in (origins, directions))
        triangle = self._scene.run(*rays)
        return self._on(np.asarray(triangle), origins, directions)

    def mirror(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Return the distance (n,) and the mirrored directions (n, 3) of rays that all hit."""
        rays = (np.ascontiguousarray(v, dtype=np.float32) for v in (origins, directions))
        normals = self._normals[np.asarray(self._scene.run(*rays))]
        slope = np.einsum("ij,ij->i", normals, directions)
        return self.meet(origins, directions).distances, directions - 2 * slope[:, None] * normals

    def _on(self, triangle: NDArray[Any], origins: Array, directions: Array) -> Hits:
        hit = np.flatnonzero(triangle >= 0)
        found = triangle[hit]
        normals = self._normals[found]
        slope = np.einsum("ij,ij->i", normals, directions[hit])
        above = self._offsets[found] - np.einsum("ij,ij->i", normals, origins[hit])
        hits = Hits(np.full(len(triangle), np.inf), *np.zeros((2, len(triangle))))
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = above / slope
        hits.distances[hit] = np.where(distance >= 0.0, distance, np.inf)
        hits.cosines[hit] = np.abs(slope)
        hits.reflectances[hit] = self._reflectances[found]
        return hits


class Surroundings:
    """A world made ready for rays: what stands, what moves, glass, and the robot's own body."""

    def __init__(
        self,
        mesh: Mesh,
        glass: Mesh | None = None,
        movers: Sequence[Mover] = (),
        body: Mesh | None = None,
    ) -> None:
        """body: in the sensor frame."""
        self._still = Solid(mesh)
        self._glass = None if glass is None else Solid(glass)
        self._movers = [(mover, Solid(mover.mesh)) for mover in movers]
        self._body = None if body is None else Solid(body)

    def meet(self, origins: Array, directions: Array, time_s: ArrayLike = 0.0) -> Hits:
        """Return what rays (n, 3), (n, 3) meet, each at its own time (n,) or all at one."""
        hits = self._opaque(origins, directions, time_s)
        if self._glass is None:
            return hits
        pane = self._glass.meet(origins, directions)
        met = pane.distances < hits.distances
        plain = met & (pane.cosines > _PANE_COSINE)
        hits.distances[plain], hits.cosines[plain] = pane.distances[plain], pane.cosines[plain]
        hits.reflectances[plain] = _PANE_REFLECTANCE
        chosen = np.arange(len(met)) * _GOLDEN % 1.0 < _MIRRORED
        mirrored = np.flatnonzero(met & ~plain & chosen)
        if len(mirrored):
            self._mirror(hits, mirrored, origins, directions, time_s)
        return hits

    def _mirror(
        self, hits: Hits, rows: NDArray[Any], origins: Array, directions: Array, time_s: ArrayLike
    ) -> None:
        """Replace hits of some rays by what they meet after a pane has mirrored them."""
        assert self._glass is not None
        way, back = self._glass.mirror(origins[rows], directions[rows])
        time = np.broadcast_to(time_s, len(directions))[rows]
        start = origins[rows] + way[:, None] * directions[rows] + _OFF_PANE_M * back
        seen = self._opaque(start, back, time)
        hits.distances[rows] = way + _OFF_PANE_M + seen.distances
        hits.cosines[rows], hits.reflectances[rows] = seen.cosines, seen.reflectances

    def _opaque(self, origins: Array, directions: Array, time_s: ArrayLike) -> Hits:
        hits = self._still.meet(origins, directions)
        time = np.broadcast_to(np.asarray(time_s, dtype=np.float64), len(origins))
        for mover, solid in self._movers:
            rows = _toward(mover, solid, origins, directions, time)
            if len(rows) == 0:
                continue
            T = se3.inverse(mover.poses(time[rows]))
            start = np.einsum("nij,nj->ni", T[:, :3, :3], origins[rows]) + T[:, :3, 3]
            met = solid.meet(start, np.einsum("nij,nj->ni", T[:, :3, :3], directions[rows]))
            nearer = Hits(*(v[rows] for v in hits)).nearer(met)
            for values, new in zip(hits, nearer, strict=True):
                values[rows] = new
        return hits

    def own_body(self, directions: Array) -> Hits | None:
        """Return what rays of the sensor frame meet of the robot, or None if it has no body."""
        if self._body is None:
            return None
        return self._body.meet(np.zeros_like(directions), directions)


def cast(
    around: Surroundings,
    scanner: Scanner,
    T_world_sensor: Array,
    turn: int = 0,
    time_s: ArrayLike = 0.0,
) -> Echoes:
    """Return what the scanner's beams meet.

    T_world_sensor: the pose, or the pose (n, 4, 4) at which each beam is sent.  turn: number of
    the scan.  time_s: of the world, for what moves in it; one, or (n,) for the beams.
    """
    beams = scanner.directions(turn)
    T = np.asarray(T_world_sensor, dtype=np.float64)
    directions = (
        beams @ T[:3, :3].T if T.ndim == 2 else np.einsum("nij,nj->ni", T[:, :3, :3], beams)
    )
    origins = np.broadcast_to(T[..., :3, 3], beams.shape)
    hits = around.meet(origins, directions, time_s)
    body = around.own_body(beams)
    if body is not None:
        hits = body.nearer(hits)
    return Echoes(scanner, hits.distances, hits.cosines, turn, hits.reflectances)


def _toward(
    mover: Mover, solid: Solid, origins: Array, directions: Array, time: Array
) -> NDArray[np.int64]:
    """Return which rays pass through the ball that holds the mover at all the times."""
    middle, span = 0.5 * (time.min() + time.max()), np.ptp(time)
    to = se3.transform(mover.poses(middle), solid.center) - origins
    radius = solid.radius + 0.5 * abs(mover.speed_m_s) * span
    ahead = np.einsum("ij,ij->i", to, directions)
    aside2 = np.einsum("ij,ij->i", to, to) - ahead**2
    return np.flatnonzero((aside2 <= radius**2) & (ahead >= -radius))


def _embree_scene(mesh: Mesh) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except (ImportError, OSError) as error:
        raise RecordingError(
            f"simulated worlds need embreex: {how_to_install('simulation', error)}"
        ) from error
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.triangles.astype(np.int32))
    return scene
