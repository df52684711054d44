"""Filling: which share of a voxel packed solids fill, and which solid is at its centre."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simulators.packing import CYLINDER, ELLIPSOID, Packed

Reals = NDArray[np.float64]
Triple = tuple[float, float, float]

_FAST = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**_FAST)
def add_attenuation(p: Packed, corner: Triple, edges: Triple, supersample: int, out: Reals) -> None:
    """Add attenuation x filled share to `out`, float64 [z, y, x].

    The share is counted on supersample³ points, only in voxels that the surface can cross.

    Args:
        corner: (z, y, x) of voxel (0, 0, 0)'s centre, mm.
        edges: (z, y, x) of a voxel, mm.
    """
    far = 0.5 * math.sqrt(edges[0] ** 2 + edges[1] ** 2 + edges[2] ** 2)
    for b in range(p.kind.size):
        k0, k1, j0, j1, i0, i1 = _box(p, b, corner, edges, out.shape)
        for k in range(k0, k1):
            z = corner[0] + k * edges[0] - p.centre[b, 2]
            for j in range(j0, j1):
                y = corner[1] + j * edges[1] - p.centre[b, 1]
                for i in range(i0, i1):
                    x = corner[2] + i * edges[2] - p.centre[b, 0]
                    level = _level(p, b, x, y, z)
                    if level <= -far:
                        out[k, j, i] += p.attenuation[b]
                    elif level < far:
                        out[k, j, i] += p.attenuation[b] * _filled(p, b, x, y, z, edges, supersample)


@njit(**_FAST)
def put_labels(p: Packed, label: NDArray[np.uint8], corner: Triple, edges: Triple, out: NDArray[np.uint8]) -> None:
    """Write label[solid] where a voxel's centre lies in a solid, later ones over earlier; a tube's bore is not tube.

    `out` is uint8 [z, y, x]; corner and edges as for add_attenuation.
    """
    for b in range(p.kind.size):
        bore = p.bore[b]
        if bore == -2:
            continue
        k0, k1, j0, j1, i0, i1 = _box(p, b, corner, edges, out.shape)
        for k in range(k0, k1):
            z = corner[0] + k * edges[0] - p.centre[b, 2]
            for j in range(j0, j1):
                y = corner[1] + j * edges[1] - p.centre[b, 1]
                for i in range(i0, i1):
                    x = corner[2] + i * edges[2] - p.centre[b, 0]
                    if _level(p, b, x, y, z) <= 0.0 and (bore < 0 or _level(p, bore, x, y, z) > 0.0):
                        out[k, j, i] = label[p.owner[b]]


@njit(**_FAST)
def _level(p: Packed, b: int, x: float, y: float, z: float) -> float:
    """Negative inside, positive outside; changes by at most 1 mm per mm, so it bounds the distance to the surface."""
    if p.kind[b] == CYLINDER:
        return max(math.sqrt(x * x + y * y) - p.size[b, 0], abs(z) - p.size[b, 1])
    if p.kind[b] == ELLIPSOID:
        W = p.matrix[b]
        r2 = 0.0
        for k in range(3):
            w = W[k, 0] * x + W[k, 1] * y + W[k, 2] * z
            r2 += w * w
        return (math.sqrt(r2) - 1.0) * p.size[b, 0]
    level = -np.inf
    for f in range(p.first_face[b], p.first_face[b + 1]):
        level = max(level, p.faces[f, 0] * x + p.faces[f, 1] * y + p.faces[f, 2] * z - p.faces[f, 3])
    return level


@njit(**_FAST)
def _filled(p: Packed, b: int, x: float, y: float, z: float, edges: Triple, n: int) -> float:
    """Share of n³ points, spread evenly over the voxel around (x, y, z), that lie inside."""
    inside = 0
    for k in range(n):
        for j in range(n):
            for i in range(n):
                dx, dy, dz = ((i + 0.5) / n - 0.5) * edges[2], ((j + 0.5) / n - 0.5) * edges[1], ((k + 0.5) / n - 0.5)
                if _level(p, b, x + dx, y + dy, z + dz * edges[0]) <= 0.0:
                    inside += 1
    return inside / n**3


@njit(**_FAST)
def _box(
    p: Packed, b: int, corner: Triple, edges: Triple, shape: tuple[int, int, int]
) -> tuple[int, int, int, int, int, int]:
    """Ranges of voxels along z, y and x that touch the box around the body."""
    k0, k1 = _voxels(corner[0] - p.centre[b, 2], edges[0], p.extent[b, 2], shape[0])
    j0, j1 = _voxels(corner[1] - p.centre[b, 1], edges[1], p.extent[b, 1], shape[1])
    i0, i1 = _voxels(corner[2] - p.centre[b, 0], edges[2], p.extent[b, 0], shape[2])
    return k0, k1, j0, j1, i0, i1


@njit(**_FAST)
def _voxels(first: float, edge: float, reach: float, n: int) -> tuple[int, int]:
    """Range of voxels that touch -reach..reach, the first voxel's centre being at `first`."""
    low = max(0, math.floor((-reach - first) / edge + 0.5))
    return low, max(low, min(n, math.floor((reach - first) / edge + 0.5) + 1))
