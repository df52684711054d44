"""Phantom: analytic solids with exact chord lengths, and their true attenuation and solids on a grid of voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.jit import njit
from recon.base.volume import Grid
from simulators.frame.shot import Detector, Pose
from simulators.samples.bodies.chords import depths
from simulators.samples.bodies.packing import CYLINDER, ELLIPSOID, Packed, pack, view_of
from simulators.samples.bodies.solids import Solid, kind_of

Reals = NDArray[np.float64]
Triple = tuple[float, float, float]

_KERNEL = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}  # as in chords


@njit(**_KERNEL)
def add_attenuation(p: Packed, corner: Triple, edges: Triple, supersample: int, out: Reals) -> None:
    """Add attenuation x filled share to `out`, float64 [z, y, x].

    The share is counted with supersample³ points, only in voxels that a surface can cross.

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
                    x = corner[2] - p.centre[b, 0] + i * edges[2]
                    level = _level(p, b, x, y, z)
                    if level <= far:
                        share = 1.0 if level <= -far else _filled(p, b, x, y, z, edges, supersample)
                        out[k, j, i] += p.attenuation[b] * share


@njit(**_KERNEL)
def put_labels(p: Packed, label: NDArray[np.uint8], corner: Triple, edges: Triple, out: NDArray[np.uint8]) -> None:
    """Write label[solid] where a voxel's centre lies in a solid; later ones replace earlier ones.

    `out` is uint8 [z, y, x]; corner and edges as for add_attenuation.
    """
    for b in range(p.kind.size):
        k0, k1, j0, j1, i0, i1 = _box(p, b, corner, edges, out.shape)
        for k in range(k0, k1):
            z = corner[0] + k * edges[0] - p.centre[b, 2]
            for j in range(j0, j1):
                y = corner[1] + j * edges[1] - p.centre[b, 1]
                for i in range(i0, i1):
                    if _level(p, b, corner[2] - p.centre[b, 0] + i * edges[2], y, z) <= 0.0:
                        out[k, j, i] = label[b]


@njit(**_KERNEL)
def _level(p: Packed, b: int, x: float, y: float, z: float) -> float:
    """A function that is negative inside and positive outside. Its slope is at most 1, so its value bounds the distance
    to the surface."""
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


@njit(**_KERNEL)
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


@njit(**_KERNEL)
def _box(
    p: Packed, b: int, corner: Triple, edges: Triple, shape: tuple[int, int, int]
) -> tuple[int, int, int, int, int, int]:
    """Ranges of voxels along z, y and x that touch the box around the body."""
    k0, k1 = _voxels(corner[0] - p.centre[b, 2], edges[0], p.extent[b, 2], shape[0])
    j0, j1 = _voxels(corner[1] - p.centre[b, 1], edges[1], p.extent[b, 1], shape[1])
    i0, i1 = _voxels(corner[2] - p.centre[b, 0], edges[2], p.extent[b, 0], shape[2])
    return k0, k1, j0, j1, i0, i1


@njit(**_KERNEL)
def _voxels(first: float, edge: float, reach: float, n: int) -> tuple[int, int]:
    """Range of voxels that touch -reach..reach, the first voxel's centre being at `first`."""
    low = max(0, math.floor((-reach - first) / edge + 0.5))
    return low, max(low, min(n, math.floor((reach - first) / edge + 0.5) + 1))


MOST_NAMES = 255  # labels are uint8, and 0 is air


@dataclass(frozen=True, eq=False)
class Phantom:
    """Solids prepared for the kernels. Created by Phantom.of.

    Attributes:
        solids: in the order in which they fill space: in labels, later ones replace earlier ones.
        solid_names: name of each in the labels.
        packed: the solids as flat arrays.
    """

    solids: tuple[Solid, ...]
    solid_names: tuple[str, ...]
    packed: Packed

    @classmethod
    def of(cls, solids: Sequence[Solid], names: Sequence[str] | None = None) -> Phantom:
        """A phantom.

        Args:
            names: one a solid, for the labels; several may share one. None: the names of the kinds.

        Raises:
            ValueError: not as many names as solids, or more than 255 different ones.
        """
        called = tuple(kind_of(solid) for solid in solids) if names is None else tuple(names)
        if len(called) != len(solids):
            raise ValueError(f"{len(solids)} solids have {len(called)} names; give each solid a name, or none")
        if len(set(called)) > MOST_NAMES:
            raise ValueError(
                f"labels are bytes: at most {MOST_NAMES} names, got {len(set(called))}; give several solids "
                "the same name"
            )
        return cls(tuple(solids), called, pack(solids))

    @cached_property
    def radius(self) -> float:
        """mm from the rotation axis to the farthest material.

        An ellipsoid is bounded by the upright elliptic cylinder around it, turned with its longer axis outwards."""
        p = self.packed
        out = np.hypot(p.centre[:, 0], p.centre[:, 1])
        round_ = p.kind == ELLIPSOID
        across = np.linalg.inv(p.matrix[round_])[:, :2]  # columns: the semi-axes, projected along z
        half = np.linalg.norm(across, ord=2, axis=(1, 2))
        corners = np.repeat(p.centre, np.diff(p.first_vertex), axis=0)[:, :2] + p.vertices[:, :2]
        reaches = ((out + p.size[:, 0])[p.kind == CYLINDER], out[round_] + half, np.hypot(corners[:, 0], corners[:, 1]))
        return max(float(reach.max(initial=0.0)) for reach in reaches)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self.solid_names))

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """See Sample.line_integrals.

        Raises:
            ValueError: a solid that does not lie wholly in front of a cone's source.
        """
        pose = angle if isinstance(angle, Pose) else Pose.turned(angle, detector.shape[0])
        return depths(self.packed, view_of(self.packed, self.solid_names, pose, detector))

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """See Sample.attenuation."""
        out = np.zeros(grid.shape)
        add_attenuation(self.packed, *_lattice(grid), supersample, out)
        return out.astype(np.float32)

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """See Sample.labels; if solids overlap, the label is that of the later solid."""
        out = np.zeros(grid.shape, np.uint8)
        index = {name: i + 1 for i, name in enumerate(self.names)}
        label = np.array([index[name] for name in self.solid_names], dtype=np.uint8)
        put_labels(self.packed, label, *_lattice(grid), out)
        return out


def _lattice(grid: Grid) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """(z, y, x) of the first voxel's centre and of a voxel's edges, mm."""
    z, y, x = grid.coordinates()
    dz, dy, dx = grid.spacing
    return (float(z[0]), float(y[0]), float(x[0])), (float(dz), float(dy), float(dx))
