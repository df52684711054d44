"""surface: where a volume crosses a level, as a closed mesh of triangles; marching cubes, slab by slab."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.features.surfaces.mesh import Mesh
from recon.post.clusters import clusters

BLOCK = 2**20  # voxels of a slab: a second or two where all is noise
_LOOKED = 2**20  # voxels from which the level is found
_RANGE = 0.5, 99.5  # percentiles at which they are cut, as for particles: a speck of metal is not the matter
_APART = 5e-4  # least distance of a voxel from the level, over the largest contrast
_WORK = 3  # copies of a mesh while it is joined


class BySlices(Protocol):
    """Voxels that are read by slices: an array, or a dataset of a file."""

    def __getitem__(self, z: slice, /) -> NDArray[np.number]: ...


class _Shared(NamedTuple):
    """Vertices in the slice that two slabs share: the lattice edges on which they lie, rising, and their numbers."""

    edges: NDArray[np.int64] = np.empty(0, np.int64)
    numbers: NDArray[np.int64] = np.empty(0, np.int64)


def half_way(data: BySlices, n_slices: int) -> float:
    """The level half-way between air and matter (ISO 50 % rule): between the medians of two clusters by k-means.

    Raises:
        ValueError: all values are one, or some are not finite.
    """
    thick = max(1, n_slices // 32)
    looked = range(thick // 2, n_slices, thick)
    slices = (np.asarray(data[z : z + 1], np.float32).ravel() for z in looked)
    sample = np.concatenate([some[:: max(1, some.size * len(looked) // _LOOKED)] for some in slices])
    cut = np.clip(sample, *np.percentile(sample, _RANGE))
    sample = cut if np.ptp(cut) else sample
    dense = sample > clusters(sample, 2).threshold
    return float(np.median(sample[dense]) + np.median(sample[~dense])) / 2


def surface(
    data: BySlices,
    grid: Grid,
    level: float,
    most: float = np.inf,
    count: Callable[[int, int], None] = lambda done, of: None,
) -> Mesh:
    """The surface of the matter above a level (Lewiner et al. 2003), closed at the faces of the box.

    Slabs share a slice. The edge of the lattice on which a vertex lies names it, so slabs are joined without a
    tolerance. Each edge of the mesh has two triangles.

    Args:
        data: [z, y, x], read twice, a few slices at a time.
        most: bytes that the mesh may take while it is joined.
        count: takes slices done and all.

    Raises:
        ValueError: no voxel, or every one, is above the level; some are not finite; or the mesh takes too much.
    """
    from skimage.measure import marching_cubes

    n, (ny, nx) = grid.shape[0], grid.shape[1:]
    thick = max(1, BLOCK // ((ny + 2) * (nx + 2)))
    least = _least(data, n, thick, level)
    vertices, faces = list[F32](), list[NDArray[np.int32]]()
    total, size = 0, 0  # vertices, and bytes of the mesh
    below = _Shared()
    for first in range(-1, n, thick):
        last = min(first + thick, n)
        block = _padded(data, first, last, n, level)
        block = np.copysign(np.maximum(np.abs(block), least), block)
        if block.min() > 0 or block.max() < 0:
            below = _Shared()
            count(min(last + 1, n), n)
            continue
        at, corners, _, _ = marching_cubes(block, 0.0)
        edges = (np.floor(at[:, 1:]) + np.ceil(at[:, 1:])).astype(np.int64) @ (2 * nx + 4, 1)
        own = (at[:, 0] > 0) | (below.edges.size == 0)
        number = np.empty(len(at), np.int64)
        number[~own] = below.numbers[np.searchsorted(below.edges, edges[~own])]
        number[own] = total + np.arange(own.sum())
        total += int(own.sum())
        size += 12 * (int(own.sum()) + len(corners))
        if _WORK * size > most or total > np.iinfo(np.int32).max:
            raise ValueError(
                f"the surface up to slice {last} of {n} has {total} vertices, which take {_WORK * size / 1e9:.3g} of "
                f"{most / 1e9:.3g} GB: noise has much surface. Take another level, or a smoother or binned volume"
            )
        vertices.append((at[own] + (first, -1, -1))[:, ::-1].astype(np.float32))
        faces.append(number[corners].astype(np.int32))
        top = np.flatnonzero(at[:, 0] == last - first)
        top = top[np.argsort(edges[top])]
        below = _Shared(edges[top], number[top])
        count(min(last + 1, n), n)
    if not vertices:
        raise ValueError(f"no surface: no value lies above the level {level:.4g}")
    return Mesh(_in_mm(np.concatenate(vertices), grid), np.concatenate(faces))


def _in_mm(vertices: F32, grid: Grid) -> F32:
    """Vertices (x, y, z) in voxels from the first one, changed to mm in place."""
    vertices *= np.asarray(grid.spacing[::-1], np.float32)
    vertices += np.asarray(grid.first[::-1], np.float32)
    return vertices


def _least(data: BySlices, n: int, thick: int, level: float) -> float:
    """How far from the level a voxel must be, so that no vertex of float32 falls on a corner of the lattice."""
    largest = 0.0
    for first in range(0, n, thick):
        values = np.asarray(data[first : first + thick], np.float32)
        if not np.isfinite(values).all():
            raise ValueError(f"slices {first} to {first + len(values) - 1} have values that are not finite")
        largest = max(largest, float(values.max()) - level, level - float(values.min()))
    return _APART * largest


def _padded(data: BySlices, first: int, last: int, n: int, level: float) -> F32:
    """Slices first to last, less the level; one more on each side of the box is such that matter ends at its face."""
    low, high = max(first, 0), min(last, n - 1) + 1
    inside = np.asarray(data[low:high], np.float32) - np.float32(level)
    block = np.pad(inside, ((low - first, last + 1 - high), (1, 1), (1, 1)), mode="edge")
    rims = [block[:, 0], block[:, -1], block[:, :, 0], block[:, :, -1]]
    for rim in rims + [block[0]] * (first < 0) + [block[-1]] * (last == n):
        rim[:] = -np.abs(rim)
    return block
