"""The nearest neighbours of ICP for many registrations: a short list of candidates for each place.

Space is an octree of cubes.  Each cube has the list of the points that can be among the k nearest
of any place inside, made when the first query gets there; it is split when its list is long.  A
query finds its cube and looks at the list, sixteen candidates at a time (``lanes.py``).  Making a
list costs as much as many searches, so this pays where many registrations share a reference.

Why the answers are exact:

- *Lists.*  A cube of centre c and half side h has a basis: of its parent's list, the k points
  nearest to c.  A point p is left out when each point q of the basis is nearer than p everywhere
  in the cube: for x = c + u, |q - x|^2 - |p - x|^2 = |q - c|^2 - |p - c|^2 - 2 u (q - p), and over
  all |u_i| <= h that is at most |q - c|^2 - |p - c|^2 + 2 h |q - p|_1 < 0.  A margin above the
  rounding errors of all of this is required, so that no tie is ever decided here.
- *Single precision.*  Keys are squared distances in float32, about the centre of the cube, without
  their six lowest bits.  Where the distance is d, their error is less than 2^-16 d^2 + 2^-20 h^2:
  coordinates are at most d + 2h large, and rounded to 2^-24 of that.  The k least keys name the
  neighbours; every candidate whose key is not greater than the k-th by more than the errors of
  both is looked at as well, and all of these are ordered in double precision.
- *Cubes out of reach.*  A query is left alone when the distance from its cube to the nearest point
  of the cloud is beyond ``cap2``, squared: so are its neighbours.
- *Long lists*, where cubes became too small or room too short, and the list of all points for a
  query outside of all cubes, are looked at one by one in double precision.

Of equally far points the first in order wins, as in ``search.py``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cello3d_ros.clouds.lanes import lowest_bit
from cello3d_ros.clouds.leaves import Indices
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.registration.lanes import BLOCKS, nearest_lanes, prefetch

Integer = int | np.integer[Any]

_LONGEST = 16 * BLOCKS
_CHUNK = 32  # queries whose lists are fetched into the cache together
_MARGIN = 2.0**-46  # of the size of space times that of a distance, above what rounding can do
_DEPTH = 20  # levels of the octree
_NEW, _LIST, _LONG = -1, -2, -3  # values of a cube's ``children`` that are no children
_CUBE = np.dtype(
    [
        ("x", "f8"),  # centre
        ("y", "f8"),
        ("z", "f8"),
        ("near2", "f8"),  # at most the squared distance from the cube to any point
        ("half", "f4"),  # half side, a power of two
        ("children", "i4"),  # the first of eight, or: no list yet, a list, a list that is long
        ("parent", "i4"),
        ("start", "i4"),  # a long list, or one that was split: numbers[start : start + count]
        ("count", "i4"),
        ("block", "i4"),  # a list: lanes[block : block + n_blocks]
        ("n_blocks", "i4"),
    ],
    align=True,
)
_CUBES, _NUMBERS, _BLOCKS = range(3)  # indices of Candidates.used


class Candidates(NamedTuple):
    """An octree of lists over N points; what is not used of its arrays takes no memory.

    points: (N, 3) about their mean; cubes: the octree, the root first; numbers: long lists; lanes:
    (blocks, 4, 16) lists as in lanes.py, lane_numbers the same as int32; used: how much of these
    three is in use; scratch, basis, keys: room to work in.
    """

    points: Array
    cubes: Any
    numbers: NDArray[np.int32]
    lanes: NDArray[np.float32]
    lane_numbers: NDArray[np.int32]
    used: Indices
    scratch: Array
    basis: Indices
    keys: NDArray[np.int32]


class Places(NamedTuple):
    """The candidates and each query's cube in the last search, (M,), 0 before the first."""

    candidates: Candidates
    places: NDArray[np.int32]


def make_candidates(
    points: Array, k: int, n_cubes: int = 600_000, n_numbers: int = 16_000_000
) -> Candidates:
    """Return empty lists for the k nearest of (N, 3) points about their mean."""
    n_blocks = max(n_cubes, 1 + BLOCKS)
    lanes = np.empty((n_blocks, 4, 16), np.float32)
    lanes[0, :3] = np.inf
    candidates = Candidates(
        np.ascontiguousarray(points),
        np.empty(n_cubes, _CUBE),
        np.empty(max(n_numbers, len(points)), np.int32),
        lanes,
        lanes.view(np.int32),
        np.zeros(3, np.int64),
        np.empty((5, len(points))),
        np.empty(k, np.int64),
        np.empty(k, np.int32),
    )
    _clear(candidates)
    return candidates


@njit(cache=True, nogil=True)
def make_room(candidates: Candidates) -> None:
    """Forget all lists when little room is left: they are made again where they are needed."""
    used = candidates.used
    if (
        used[_CUBES] > 0.8 * len(candidates.cubes)
        or used[_NUMBERS] > 0.8 * len(candidates.numbers)
        or used[_BLOCKS] > 0.8 * len(candidates.lanes)
    ):
        _clear(candidates)


@njit(cache=True, nogil=True)
def nearest(moved: Array, index: Places, cap2: float, distances2: Array, indices: Indices) -> int:
    """Fill the k nearest points that are at most ``cap2`` away, squared; return how many.

    moved: (M, 3), neighbours in order near in space; distances2, indices: (M, k), closest first,
    infinite and -1 where there are fewer.  A few queries at a time find their cubes and have their
    lists fetched into the cache, then look at them.
    """
    candidates, places = index
    n, k = indices.shape
    points, cubes, keys = candidates.points, candidates.cubes, candidates.keys
    lanes, lane_numbers = candidates.lanes, candidates.lane_numbers
    total = 0
    for start in range(0, n, _CHUNK):
        stop = min(start + _CHUNK, n)
        for i in range(start, stop):
            x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
            place = np.int64(places[i])
            while place >= 0 and not _is_inside(cubes[place], x, y, z):
                place = np.int64(cubes[place].parent)
            if place < 0:  # outside of them all
                places[i] = 0
                continue
            while True:
                if cubes[place].children == _NEW:
                    _make_list(candidates, place, k)
                children = cubes[place].children
                if children < 0 or cubes[place].near2 > cap2:
                    break
                place = np.int64(
                    children
                    + (x > cubes[place].x)
                    + 2 * (y > cubes[place].y)
                    + 4 * (z > cubes[place].z)
                )
            places[i] = place
            if children == _LIST and cubes[place].near2 <= cap2:
                prefetch(lanes, np.int64(cubes[place].block), np.int64(cubes[place].n_blocks))
        for i in range(start, stop):
            x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
            cube = cubes[np.int64(places[i])]
            for j in range(k):
                distances2[i, j] = np.inf
                indices[i, j] = -1
            if cube.near2 > cap2:
                continue
            if cube.children != _LIST:
                first = np.int64(cube.start)
                for number in range(first, first + np.int64(cube.count)):
                    p = np.int64(candidates.numbers[number])
                    _insert(distances2, indices, i, _distance2(points, p, x, y, z), p)
            else:
                block, n_blocks, half = np.int64(cube.block), np.int64(cube.n_blocks), cube.half
                close = nearest_lanes(
                    lanes,
                    block,
                    n_blocks,
                    np.float32(x - cube.x),
                    np.float32(y - cube.y),
                    np.float32(z - cube.z),
                    k,
                    np.float32(2.0**-18) * half * half,
                    keys,
                )
                for j in range(k):
                    lane = np.int64(keys[j] & 63)
                    p = np.int64(lane_numbers[block + (lane >> 4), 3, lane & 15])
                    d2 = _distance2(points, p, x, y, z)
                    m = j  # in place already, but for rounding
                    while m > 0 and _is_before(d2, p, distances2[i, m - 1], indices[i, m - 1]):
                        distances2[i, m], indices[i, m] = distances2[i, m - 1], indices[i, m - 1]
                        m -= 1
                    distances2[i, m], indices[i, m] = d2, p
                while close:
                    lane = lowest_bit(close)
                    close &= close - 1
                    p = np.int64(lane_numbers[block + (lane >> 4), 3, lane & 15])
                    if (lane >> 4) < n_blocks and p >= 0:
                        _insert(distances2, indices, i, _distance2(points, p, x, y, z), p)
            for j in range(k):
                is_near = indices[i, j] >= 0 and distances2[i, j] <= cap2
                total += is_near
                distances2[i, j] = distances2[i, j] if is_near else np.inf
                indices[i, j] = indices[i, j] if is_near else -1
    return total


@njit(cache=True, nogil=True)
def _clear(candidates: Candidates) -> None:
    """Leave the root, twice as wide as need be, and its eight children, without lists."""
    n = len(candidates.points)
    half, extent = 1.0, 4.0 * np.abs(candidates.points).max()
    while half < extent:
        half *= 2.0
    while 0.0 < extent < 0.5 * half:
        half *= 0.5
    root = candidates.cubes[0]
    root.x = root.y = root.z = root.near2 = 0.0
    root.half = half
    root.parent = -1
    root.start, root.count = 0, n
    for i in range(n):
        candidates.numbers[i] = i
    candidates.used[_CUBES], candidates.used[_NUMBERS], candidates.used[_BLOCKS] = 1, n, 1
    _split(candidates, 0)


@njit(cache=True, nogil=True)
def _split(candidates: Candidates, place: Integer) -> None:
    """Give a cube eight children, without lists."""
    first = candidates.used[_CUBES]
    candidates.used[_CUBES] += 8
    parent = candidates.cubes[place]
    parent.children = first
    half = 0.5 * parent.half
    for octant in range(8):
        cube = candidates.cubes[first + octant]
        cube.x = parent.x + (half if octant & 1 else -half)
        cube.y = parent.y + (half if octant & 2 else -half)
        cube.z = parent.z + (half if octant & 4 else -half)
        cube.half = half
        cube.near2 = 0.0
        cube.children = _NEW
        cube.parent = place


@njit(cache=True, nogil=True)
def _make_list(candidates: Candidates, place: Integer, k: int) -> None:
    """Make the list of a cube out of its parent's, and split the cube if that is long."""
    cube, numbers, used = candidates.cubes[place], candidates.numbers, candidates.used
    parent = candidates.cubes[np.int64(cube.parent)]
    start, n = np.int64(parent.start), np.int64(parent.count)
    h, size = np.float64(cube.half), np.float64(candidates.cubes[0].half)
    out = used[_NUMBERS]
    if out + n > len(numbers) or used[_BLOCKS] + BLOCKS > len(candidates.lanes):
        cube.children = _LONG
        cube.start, cube.count = start, n
        return
    x, y, z, d2, worst = candidates.scratch
    basis = candidates.basis
    for i in range(n):
        p = numbers[start + i]
        x[i] = candidates.points[p, 0] - cube.x
        y[i] = candidates.points[p, 1] - cube.y
        z[i] = candidates.points[p, 2] - cube.z
    _distances(x[:n], y[:n], z[:n], d2[:n], worst[:n], h)
    near2 = worst[:n].min()
    cube.near2 = near2 - _MARGIN * size * (math.sqrt(near2) + h)
    n_basis = _least(d2, n, k, basis)
    worst[:n] = -np.inf
    for j in range(n_basis):
        q = basis[j]
        _raise(x[:n], y[:n], z[:n], worst[:n], x[q], y[q], z[q], 2.0 * h)
    count = 0
    for i in range(n):
        numbers[out + count] = numbers[start + i]
        margin = _MARGIN * size * (abs(x[i]) + abs(y[i]) + abs(z[i]) + h)
        count += not worst[i] < d2[i] - margin
    cube.start, cube.count = out, count
    if k <= count <= _LONGEST:
        _fill_lanes(candidates, place)
        return
    used[_NUMBERS] += count
    if used[_CUBES] + 8 > len(candidates.cubes) or h <= size * 0.5**_DEPTH or count < k:
        cube.children = _LONG
    else:
        _split(candidates, place)


@njit(cache=True, nogil=True)
def _fill_lanes(candidates: Candidates, place: Integer) -> None:
    """Copy a cube's list, about its centre, into lanes."""
    cube, points, used = candidates.cubes[place], candidates.points, candidates.used
    start, count, first = np.int64(cube.start), np.int64(cube.count), used[_BLOCKS]
    n_blocks = (count + 15) >> 4
    candidates.lanes[first : first + n_blocks, :3] = np.inf
    candidates.lane_numbers[first : first + n_blocks, 3] = -1
    for m in range(count):
        p = np.int64(candidates.numbers[start + m])
        block, lane = first + (m >> 4), m & 15
        candidates.lanes[block, 0, lane] = np.float32(points[p, 0] - cube.x)
        candidates.lanes[block, 1, lane] = np.float32(points[p, 1] - cube.y)
        candidates.lanes[block, 2, lane] = np.float32(points[p, 2] - cube.z)
        candidates.lane_numbers[block, 3, lane] = p
    cube.children, cube.block, cube.n_blocks = _LIST, first, n_blocks
    used[_BLOCKS] += n_blocks


@njit(cache=True, nogil=True)
def _distances(x: Array, y: Array, z: Array, d2: Array, near2: Array, h: float) -> None:
    """Fill the squared distances of points from a cube's centre and from the cube itself."""
    for i in range(len(x)):
        d2[i] = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
    for i in range(len(x)):
        dx, dy, dz = abs(x[i]) - h, abs(y[i]) - h, abs(z[i]) - h
        dx = dx if dx > 0.0 else 0.0
        dy = dy if dy > 0.0 else 0.0
        dz = dz if dz > 0.0 else 0.0
        near2[i] = dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _raise(
    x: Array, y: Array, z: Array, worst: Array, qx: float, qy: float, qz: float, side: float
) -> None:
    """Raise ``worst`` to |q|^2 + side |q - p|_1 for each point p where it is less."""
    q2 = qx * qx + qy * qy + qz * qz
    for i in range(len(x)):
        far = q2 + side * (abs(qx - x[i]) + abs(qy - y[i]) + abs(qz - z[i]))
        worst[i] = far if far > worst[i] else worst[i]


@njit(cache=True, nogil=True)
def _least(values: Array, n: Integer, k: int, indices: Indices) -> int:
    """Write the indices of the k least of n values, ascending; return how many there are."""
    m = 0
    for i in range(n):
        if m == k and not values[i] < values[indices[k - 1]]:
            continue
        m = min(m + 1, k)
        j = m - 1
        while j > 0 and values[indices[j - 1]] > values[i]:
            indices[j] = indices[j - 1]
            j -= 1
        indices[j] = i
    return m


@njit(cache=True, nogil=True, inline="always")
def _is_inside(cube: Any, x: float, y: float, z: float) -> bool:
    h = np.float64(cube.half)
    return bool(abs(x - cube.x) <= h and abs(y - cube.y) <= h and abs(z - cube.z) <= h)


@njit(cache=True, nogil=True, inline="always")
def _distance2(points: Array, p: Integer, x: float, y: float, z: float) -> float:
    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
    return float(dx * dx + dy * dy + dz * dz)


@njit(cache=True, nogil=True, inline="always")
def _is_before(d2: float, p: Integer, other2: float, other: Integer) -> bool:
    return bool(d2 < other2 or (d2 == other2 and p < other))


@njit(cache=True, nogil=True)
def _insert(distances2: Array, indices: Indices, i: int, d2: float, p: Integer) -> None:
    """Put a point in its place among the neighbours of query i, the farthest falls out."""
    j = distances2.shape[1] - 1
    if indices[i, j] >= 0 and not _is_before(d2, p, distances2[i, j], indices[i, j]):
        return
    while j > 0 and (
        indices[i, j - 1] < 0 or _is_before(d2, p, distances2[i, j - 1], indices[i, j - 1])
    ):
        distances2[i, j], indices[i, j] = distances2[i, j - 1], indices[i, j - 1]
        j -= 1
    distances2[i, j], indices[i, j] = d2, p
