"""Scenes of ellipsoids, polyhedra and pores in a can, by a parallel beam or a cone: exact chords of convex bodies.

Nothing in the project was tuned on these scenes. Units, rays and voxels are those of tests.bench.first_users_scenes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.jit import njit

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
SUB = 3
FACES = 9
"""Number of faces of a polyhedron, at distances of 0.55 to 0.8 of its radius; an ellipsoid has none."""


class Shapes(NamedTuple):
    """Convex bodies; each one is an ellipsoid cut by planes.

    Attributes:
        centre: [body, 3], x, y, z.
        radius: [body], radius of the enclosing ball.
        density: [body], difference from the surroundings.
        axes: [body, 3, 3], M of |M (x - centre)| <= 1.
        faces: [body, face, 4], n and d of n (x - centre) <= d.
    """

    centre: F64
    radius: F64
    density: F64
    axes: F64
    faces: F64


def shapes_of(rng: np.random.Generator, kind: str, centre: F64, radius: F64, densities: tuple[float, ...]) -> Shapes:
    """Bodies of a kind in balls that do not touch; each one has one of the densities, within 4 %."""
    n = len(radius)
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    flat = np.column_stack((np.ones(n), rng.uniform(0.5, 1, n), rng.uniform(0.35, 1, n)))
    if kind == "polyhedra":
        flat[:] = 1
    axes = turn / (flat * radius[:, None])[:, :, None]
    faces = np.zeros((n, FACES if kind == "polyhedra" else 0, 4))
    normal = rng.normal(size=(*faces.shape[:2], 3))
    faces[..., :3] = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    faces[..., 3] = rng.uniform(0.55, 0.8, faces.shape[:2]) * radius[:, None]
    density = rng.choice(densities, n) * rng.uniform(0.96, 1.04, n)
    return Shapes(centre, radius, density, axes, faces)


@njit(cache=True)
def _chord(shapes: Shapes, b: int, p: F64, d: F64) -> float:
    """Length of the ray p + t d in a body."""
    low, high, qq, qd, dd = -np.inf, np.inf, -1.0, 0.0, 0.0
    for i in range(3):
        q = e = 0.0
        for j in range(3):
            q += shapes.axes[b, i, j] * (p[j] - shapes.centre[b, j])
            e += shapes.axes[b, i, j] * d[j]
        qq, qd, dd = qq + q * q, qd + q * e, dd + e * e
    root = qd * qd - dd * qq
    if root <= 0:
        return 0.0
    root = math.sqrt(root)
    low, high = (-qd - root) / dd, (-qd + root) / dd
    for f in range(shapes.faces.shape[1]):
        over, slope = -shapes.faces[b, f, 3], 0.0
        for j in range(3):
            over += shapes.faces[b, f, j] * (p[j] - shapes.centre[b, j])
            slope += shapes.faces[b, f, j] * d[j]
        if abs(slope) < 1e-12:
            if over > 0:
                return 0.0
        elif slope > 0:
            high = min(high, -over / slope)
        else:
            low = max(low, -over / slope)
    return max(0.0, high - low)


@njit(cache=True)
def _tube(radius: float, p: F64, d: F64) -> float:
    """Length of the ray p + t d within `radius` of the axis."""
    dd, qd = d[0] * d[0] + d[1] * d[1], p[0] * d[0] + p[1] * d[1]
    root = qd * qd - dd * (p[0] * p[0] + p[1] * p[1] - radius * radius)
    return 2 * math.sqrt(root) / dd if root > 0 else 0.0


@njit(cache=True)
def _ray(angle: float, u: float, v: float, source: float, p: F64, d: F64) -> None:
    """A ray through (u, v) in the plane of the axis, from a source at this distance (0: parallel); d has length 1."""
    c, s = np.cos(angle), np.sin(angle)
    p[0], p[1], p[2], d[0], d[1], d[2] = u * c, u * s, v, -s, c, 0.0
    if source > 0:
        d[0], d[1], d[2] = -s * source + p[0], c * source + p[1], v
        length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        d[0], d[1], d[2] = d[0] / length, d[1] / length, d[2] / length


@njit(cache=True)
def _view(shapes: Shapes, can: F64, angle: float, u: F64, v: F64, source: float, out: F64) -> None:
    """Add the line integrals [v, u]; `can`: outer radius, inner one, densities of wall and matrix."""
    c, s, step, p, d = np.cos(angle), np.sin(angle), u[1] - u[0], np.empty(3), np.empty(3)
    for k in range(len(v)):
        for i in range(len(u)):
            _ray(angle, u[i], v[k], source, p, d)
            inner = _tube(can[1], p, d)
            out[k, i] += can[2] * (_tube(can[0], p, d) - inner) + can[3] * inner
    for b in range(len(shapes.radius)):
        x, y, z = shapes.centre[b]
        r, near = shapes.radius[b], 1.0
        if source > 0:
            near = source / (source - x * s + y * c - shapes.radius[b])
        far = source / (source - x * s + y * c + r) if source > 0 else 1.0
        at, reach = x * c + y * s, 1.05 * r * near
        u0, u1 = min(at * near, at * far) - reach, max(at * near, at * far) + reach
        v0, v1 = min(z * near, z * far) - reach, max(z * near, z * far) + reach
        for k in range(max(0, math.ceil((v0 - v[0]) / step)), min(len(v), math.floor((v1 - v[0]) / step) + 1)):
            for i in range(max(0, math.ceil((u0 - u[0]) / step)), min(len(u), math.floor((u1 - u[0]) / step) + 1)):
                _ray(angle, u[i], v[k], source, p, d)
                out[k, i] += shapes.density[b] * _chord(shapes, b, p, d)


@njit(cache=True)
def _inside(shapes: Shapes, b: int, q: F64) -> bool:
    away = 0.0
    for i in range(3):
        along = 0.0
        for j in range(3):
            along += shapes.axes[b, i, j] * q[j]
        away += along * along
    if away > 1:
        return False
    for f in range(shapes.faces.shape[1]):
        over = -shapes.faces[b, f, 3]
        for j in range(3):
            over += shapes.faces[b, f, j] * q[j]
        if over > 0:
            return False
    return True


@njit(cache=True)
def _fill(shapes: Shapes, x: F64, z: F64, sub: int, out: F32) -> None:
    """Add the bodies to voxels [z, y, x], means of sub³ points."""
    q = np.empty(3)
    for b in range(len(shapes.radius)):
        m, r = shapes.centre[b], shapes.radius[b] + 1
        for k in range(max(0, math.ceil(m[2] - r - z[0])), min(len(z), math.floor(m[2] + r - z[0]) + 1)):
            for j in range(max(0, math.ceil(m[1] - r - x[0])), min(len(x), math.floor(m[1] + r - x[0]) + 1)):
                for i in range(max(0, math.ceil(m[0] - r - x[0])), min(len(x), math.floor(m[0] + r - x[0]) + 1)):
                    inside = 0
                    for point in range(sub**3):
                        q[0] = x[i] - m[0] + (point % sub + 0.5) / sub - 0.5
                        q[1] = x[j] - m[1] + (point // sub % sub + 0.5) / sub - 0.5
                        q[2] = z[k] - m[2] + (point // sub**2 + 0.5) / sub - 0.5
                        inside += _inside(shapes, b, q)
                    out[k, j, i] += shapes.density[b] * inside / sub**3


def views_of(shapes: Shapes, can: tuple[float, ...], geometry: Geometry) -> F64:
    """Line integrals [view, row, col], each the mean of nine rays in a pixel; `can` as in `_view`."""
    rows, cols = geometry.detector_shape
    u, v = (((np.arange(n * SUB) + 0.5) / SUB - n / 2) for n in (cols, rows))
    source = float(geometry.sod or 0) if geometry.is_cone else 0.0
    clean = np.empty((geometry.n_views, rows, cols))
    for view, angle in zip(clean, geometry.angles, strict=True):
        lines = np.zeros((v.size, u.size))
        _view(shapes, np.array(can), float(angle), u, v, source, lines)
        view[:] = lines.reshape(rows, SUB, cols, SUB).mean((1, 3))
    return clean


def truth_of(shapes: Shapes, can: tuple[float, ...], rows: int, cols: int) -> F32:
    """Densities [z, y, x], means over voxels."""
    u = (np.arange(cols * SUB) + 0.5) / SUB - cols / 2
    away = np.hypot(u[:, None], u)
    around = np.where(away > can[0], 0, np.where(away > can[1], can[2], can[3]))
    truth = np.tile(around.reshape(cols, SUB, cols, SUB).mean((1, 3)).astype(np.float32), (rows, 1, 1))
    x, z = ((np.arange(n) - (n - 1) / 2) for n in (cols, rows))
    _fill(shapes, x, z, 4, truth)
    return truth
