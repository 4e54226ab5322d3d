"""The compiled parts of ICP.  What they compute is said in ``icp.py``."""

from __future__ import annotations

import math

import numpy as np

from cello3d_ros.clouds.leaves import Indices, select
from cello3d_ros.compiled import kernel
from cello3d_ros.geometry.se3 import Array


@kernel()
def begin(T: Array, reading: Array, mean: Array) -> Array:
    """Return the reading as it starts, about the mean of the reference.  (N, 3)."""
    start = np.empty((len(reading), 3))
    _move(T, reading, start)
    for i in range(len(reading)):
        for a in range(3):
            start[i, a] -= mean[a]
    return start


@kernel()
def move(motion: Array, start: Array, mean: Array, moved: Array, queries: Array) -> None:
    """Fill the moved reading, about the mean and in the frame of the reference."""
    _move(motion, start, moved)
    for i in range(len(start)):
        for a in range(3):
            queries[i, a] = moved[i, a] + mean[a]


@kernel()
def trim_limit(distances2: Array, rank: int) -> float:
    """Return the squared distance of that rank."""
    keys = distances2.copy().ravel()
    select(keys, np.arange(len(keys)), 0, len(keys), rank)
    return float(keys[rank])


@kernel()
def compound(step: Array, motion: Array) -> tuple[float, float]:
    """Move ``motion`` in place by a step; return the step's rotation and translation."""
    last = motion.copy()
    _multiply(step, last, motion)
    translation = 0.0
    for a in range(3):
        translation += (motion[a, 3] - last[a, 3]) ** 2
    return _angle(step), math.sqrt(translation)


@kernel()
def finish(motion: Array, T: Array, mean: Array) -> None:
    """Move T in place by a motion about the mean."""
    for a in range(3):
        T[a, 3] -= mean[a]
    _multiply(motion, T.copy(), T)
    for a in range(3):
        T[a, 3] += mean[a]


@kernel()
def _move(T: Array, points: Array, moved: Array) -> None:
    """Fill ``moved`` with the points moved by T."""
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for a in range(3):
            moved[i, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]


@kernel()
def _multiply(A: Array, B: Array, C: Array) -> None:
    """Fill C with ``A @ B``, all (4, 4); compiled faster than numba's."""
    for i in range(4):
        for j in range(4):
            C[i, j] = 0.0
            for a in range(4):
                C[i, j] += A[i, a] * B[a, j]


@kernel()
def plane_step(
    moved: Array,
    queries: Array,
    points: Array,
    normals: Array,
    distances2: Array,
    indices: Indices,
    limit2: float,
) -> tuple[bool, Array, float, int]:
    """Solve the point-to-plane normal equations: ok, step (4, 4), RMS, count.

    moved, queries: the reading about the reference's mean, and in its frame.  A row is (c, n),
    c = p x n, its error r; a point without a normal gives none.  The sums stay in registers, one
    name each.
    """
    c00 = c10 = c11 = c20 = c21 = c22 = 0.0
    n00 = n01 = n02 = n10 = n11 = n12 = n20 = n21 = n22 = 0.0
    m00 = m10 = m11 = m20 = m21 = m22 = 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = sum2 = 0.0
    n_kept = 0
    for i in range(len(moved)):
        x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
        qx, qy, qz = queries[i, 0], queries[i, 1], queries[i, 2]
        for j in range(indices.shape[1]):
            if not distances2[i, j] <= limit2:
                break
            p = indices[i, j]
            nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
            cx, cy, cz = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            r = (qx - points[p, 0]) * nx + (qy - points[p, 1]) * ny + (qz - points[p, 2]) * nz
            c00, c10, c20 = c00 + cx * cx, c10 + cy * cx, c20 + cz * cx
            c11, c21, c22 = c11 + cy * cy, c21 + cz * cy, c22 + cz * cz
            n00, n01, n02 = n00 + nx * cx, n01 + nx * cy, n02 + nx * cz
            n10, n11, n12 = n10 + ny * cx, n11 + ny * cy, n12 + ny * cz
            n20, n21, n22 = n20 + nz * cx, n21 + nz * cy, n22 + nz * cz
            m00, m10, m20 = m00 + nx * nx, m10 + ny * nx, m20 + nz * nx
            m11, m21, m22 = m11 + ny * ny, m21 + nz * ny, m22 + nz * nz
            b0, b1, b2 = b0 - cx * r, b1 - cy * r, b2 - cz * r
            b3, b4, b5 = b3 - nx * r, b4 - ny * r, b5 - nz * r
            sum2 += r * r
            n_kept += nx != 0.0 or ny != 0.0 or nz != 0.0
    A, b = np.zeros((6, 6)), np.empty(6)  # the lower triangle is enough
    A[0, 0], A[1, 0], A[1, 1], A[2, 0], A[2, 1], A[2, 2] = c00, c10, c11, c20, c21, c22
    A[3, 0], A[3, 1], A[3, 2], A[3, 3] = n00, n01, n02, m00
    A[4, 0], A[4, 1], A[4, 2], A[4, 3], A[4, 4] = n10, n11, n12, m10, m11
    A[5, 0], A[5, 1], A[5, 2], A[5, 3], A[5, 4], A[5, 5] = n20, n21, n22, m20, m21, m22
    b[0], b[1], b[2], b[3], b[4], b[5] = b0, b1, b2, b3, b4, b5
    rms = math.sqrt(sum2 / max(n_kept, 1))
    ok = _solve(A, b)
    return ok, _step(b), rms, n_kept


@kernel()
def point_step(
    moved: Array, mean: Array, points: Array, distances2: Array, indices: Indices, limit2: float
) -> tuple[bool, Array, float, int]:
    """Find the rigid motion that best moves the kept points onto theirs (Umeyama 1991)."""
    from_mean, to_mean = np.zeros(3), np.zeros(3)
    n_kept = 0
    for i in range(len(moved)):
        for j in range(indices.shape[1]):
            if distances2[i, j] <= limit2:
                for a in range(3):
                    from_mean[a] += moved[i, a]
                    to_mean[a] += points[indices[i, j], a] - mean[a]
                n_kept += 1
    for a in range(3):
        from_mean[a] /= max(n_kept, 1)
        to_mean[a] /= max(n_kept, 1)
    H = np.zeros((3, 3))
    sum2 = 0.0
    for i in range(len(moved)):
        for j in range(indices.shape[1]):
            if distances2[i, j] <= limit2:
                sum2 += distances2[i, j]
                for u in range(3):
                    for v in range(3):
                        to = points[indices[i, j], v] - mean[v] - to_mean[v]
                        H[u, v] += (moved[i, u] - from_mean[u]) * to
    U, s, Vt = np.linalg.svd(H)
    sign = 1.0 if _determinant(U) * _determinant(Vt) > 0.0 else -1.0
    step = np.zeros((4, 4))
    step[3, 3] = 1.0
    for u in range(3):
        step[u, 3] = to_mean[u]
        for v in range(3):
            step[u, v] = Vt[0, u] * U[v, 0] + Vt[1, u] * U[v, 1] + sign * Vt[2, u] * U[v, 2]
            step[u, 3] -= step[u, v] * from_mean[v]
    rms = math.sqrt(sum2 / max(n_kept, 1))
    ok = s[1] > 1e-12 * s[0]  # points on one line leave the turn about it free
    return ok, step, rms, n_kept


@kernel()
def _determinant(A: Array) -> float:
    """Return the determinant of a (3, 3), compiled faster than numba's."""
    total = 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        total += A[0, a] * (A[1, b] * A[2, c] - A[1, c] * A[2, b])
    return total


@kernel()
def _solve(A: Array, b: Array) -> bool:
    """Solve A x = b in place by Cholesky from the lower triangle; False when singular.

    A is scaled to a unit diagonal first, so that the test of the pivots has no units.
    """
    n = len(b)
    scale = np.empty(n)
    for u in range(n):
        if not 0.0 < A[u, u] < np.inf:
            return False
        scale[u] = 1.0 / math.sqrt(A[u, u])
    for u in range(n):
        for v in range(u + 1):
            A[u, v] *= scale[u] * scale[v]
    for u in range(n):
        for v in range(u + 1):
            total = A[u, v]
            for w in range(v):
                total -= A[u, w] * A[v, w]
            if u != v:
                A[u, v] = total / A[v, v]
            elif total > 1e-12:
                A[u, u] = math.sqrt(total)
            else:
                return False
    for u in range(n):
        b[u] *= scale[u]
        for w in range(u):
            b[u] -= A[u, w] * b[w]
        b[u] /= A[u, u]
    for u in range(n - 1, -1, -1):
        for w in range(u + 1, n):
            b[u] -= A[w, u] * b[w]
        b[u] /= A[u, u]
    is_finite = True
    for u in range(n):
        b[u] *= scale[u]
        is_finite &= math.isfinite(b[u])
    return is_finite


@kernel()
def _step(x: Array) -> Array:
    """Return the motion (4, 4) by the angle |x[:3]| about the axis x[:3] and by x[3:] as it is."""
    angle = math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    s = math.sin(angle) / angle if angle > 1e-150 else 1.0
    c = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-150 else 0.5
    step = np.zeros((4, 4))
    for a in range(3):
        for b in range(3):
            step[a, b] += c * x[a] * x[b]
        step[a, a] += 1.0 - c * angle * angle
        step[(a + 2) % 3, (a + 1) % 3] += s * x[a]
        step[(a + 1) % 3, (a + 2) % 3] -= s * x[a]
        step[a, 3] = x[3 + a]
    step[3, 3] = 1.0
    return step


@kernel()
def _angle(R: Array) -> float:
    """Return the angle of a rotation, accurate near zero."""
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    return math.atan2(math.sqrt(x * x + y * y + z * z), R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
