"""Mesh: the keys of a scene for a closed mesh of triangles from a file, and the sample that it gives.

    phantom: {kind: mesh, file: part.stl, unit: mm, attenuation: 2.0, voxel_mm: 0.005}

The mesh keeps its place: z of the file is the rotation axis. A voxel has the share of it that is inside the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from simulators.frame.mapping import Positive
from simulators.samples.sample import ReadVolume
from simulators.samples.voxels.voxels import Voxels

Reals = NDArray[np.float64]

_MM = {"m": 1e3, "mm": 1.0, "um": 1e-3}
_LINES = 4  # along z through a voxel, in each of x and y
_MOST = 2**29  # voxels


@dataclass(frozen=True)
class MeshSettings:
    """The keys of a mesh in a scene.

    Attributes:
        file: .stl, .ply or .obj, beside the scene file or by its full path.
        attenuation: 1/mm, inside.
        voxel_mm: edge of the voxels that the mesh becomes; half a pixel or less.
        unit: of the lengths in the file.
        name: of its label.
    """

    file: str
    attenuation: Positive
    voxel_mm: Positive
    unit: Literal["m", "mm", "um"] = "mm"
    name: str = "matter"


def sample_of(settings: MeshSettings, read: ReadVolume) -> Voxels:
    """The sample of the settings.

    Raises:
        ValueError: the mesh is open, or too large for its voxels.
    """
    triangles = np.asarray(read(settings.file, None).values, np.float64) * _MM[settings.unit]
    require_closed(triangles)
    share = filled(triangles, settings.voxel_mm)
    half = settings.attenuation / 2
    return Voxels.of(share * np.float32(settings.attenuation), settings.voxel_mm, [half], names=(settings.name,))


def require_closed(triangles: Reals) -> None:
    """Raises ValueError where the mesh [triangle, corner, (x, y, z)] is open: an edge lacks its way back."""
    _, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int64)
    there = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = there[there[:, 0] != there[:, 1]]
    n = np.int64(corners.max(initial=0) + 1)
    ways = np.concatenate([there[:, a] * n + there[:, 1 - a] for a in (0, 1)])
    edges, which = np.unique(ways, return_inverse=True)
    one, back = (np.bincount(half, minlength=edges.size) for half in np.split(which, 2))
    lacking = int(np.maximum(one - back, 0).sum())  # an edge of two triangles needs two ways back
    if lacking or not len(triangles):
        raise ValueError(
            f"the mesh of {len(triangles)} triangles is open: {lacking} of {len(there)} edges have no neighbour in the "
            "other direction. Close it, with all triangles anticlockwise seen from outside"
        )


def filled(triangles: Reals, voxel: float) -> NDArray[np.float32]:
    """Share of each voxel inside a closed mesh, float32 [z, y, x], symmetric about the origin.

    Along z it is exact; across it is counted on lines. Each crossing fills all that lies below it, or empties it.

    Args:
        triangles: [triangle, corner, (x, y, z)] in mm, anticlockwise seen from outside.

    Raises:
        ValueError: more voxels than `_MOST`.
    """
    half = np.ceil(np.abs(triangles).max(axis=(0, 1)) / voxel - 0.5).astype(np.int64) + 1
    x, y, z = (int(n) for n in 2 * half + 1)
    if x * y * z > _MOST:
        raise ValueError(
            f"{x} x {y} x {z} voxels of {voxel:g} mm are too many; expected {_MOST} at most: raise voxel_mm"
        )
    inside = np.zeros((z, y, x), np.float32)
    steps = np.zeros_like(inside)
    first = -(half + 0.5)
    _fill(triangles / voxel - first, _LINES, inside, steps)
    inside += np.cumsum(steps[::-1], axis=0)[::-1] - steps
    total = float(inside.sum(dtype=np.float64))
    return np.clip(inside if total >= 0 else -inside, 0, 1)  # inside out


@njit(cache=True)
def _fill(triangles: Reals, lines: int, inside: NDArray[np.float32], steps: NDArray[np.float32]) -> None:
    """Crossings of lines along z: the voxel's own share into `inside`, that of all below it into `steps`."""
    weight = 1.0 / lines**2
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        sign = weight if area > 0 else -weight
        low_x, high_x = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
        low_y, high_y = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        for i in range(int(np.ceil(low_x * lines - 0.5)), int(np.floor(high_x * lines - 0.5)) + 1):
            px = (i + 0.5) / lines
            for j in range(int(np.ceil(low_y * lines - 0.5)), int(np.floor(high_y * lines - 0.5)) + 1):
                py = (j + 0.5) / lines
                if not (
                    _left(a, b, px, py, area > 0) and _left(b, c, px, py, area > 0) and _left(c, a, px, py, area > 0)
                ):
                    continue
                wb = ((px - a[0]) * (c[1] - a[1]) - (py - a[1]) * (c[0] - a[0])) / area
                wc = ((b[0] - a[0]) * (py - a[1]) - (b[1] - a[1]) * (px - a[0])) / area
                height = a[2] + wb * (b[2] - a[2]) + wc * (c[2] - a[2])
                k = min(max(int(np.floor(height)), 0), inside.shape[0] - 1)
                inside[k, j // lines, i // lines] += sign * (height - k)
                steps[k, j // lines, i // lines] += sign


@njit(cache=True)
def _left(a: Reals, b: Reals, px: float, py: float, anticlockwise: bool) -> bool:
    """Whether a point is on the triangle's side of its edge; of two triangles at an edge just one has each point."""
    flipped = b[0] < a[0] or (b[0] == a[0] and b[1] < a[1])
    p, q = (b, a) if flipped else (a, b)
    on_left = (q[0] - p[0]) * (py - p[1]) - (q[1] - p[1]) * (px - p[0]) >= 0
    return on_left == (anticlockwise != flipped)
