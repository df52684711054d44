"""Divides a reference volume into parts: the ground between particles, the excess above the ground, and the particle of
each voxel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage as ndi

from recon.base.arrays import F32
from recon.base.volume import Grid, Volume

_HULL = 8  # voxels by which gaps are closed, to find the material between particles
_RIM_VOXELS = 4  # voxels around a particle that count as part of the particle
# smallest number of voxels from which the ground is measured; with fewer voxels, air is assumed between particles
_LEAST_GROUND = 100
_COARSER = 1.5  # size of a voxel, divided by that of the reference, above which it gets a mean of the reference


@dataclass(frozen=True, eq=False)
class Particles:
    """A reference volume [y, x, z] divided into parts.

    Attributes:
        ground: the part of each value up to the level between particles.
        above: the rest of each value; ground + above is the volume.
        label: number, from 1, of the particle to which a voxel belongs; 0: there is no particle within 4 voxels.
        base: level between particles.
        level: typical excess of particles above `base`.
    """

    ground: F32
    above: F32
    label: NDArray[np.int32]
    base: float
    level: float

    @property
    def count(self) -> int:
        """Number of particles."""
        return int(self.label.max(initial=0))

    @property
    def volume(self) -> F32:
        return self.ground + self.above


def particles_of(volume: F32) -> Particles | None:
    """Divide a volume [y, x, z] into parts. None: the volume shows no material.

    Two levels are separated by Otsu's threshold (1979, IEEE Trans. Syst. Man Cybern. 9, 62). The ground is the median
    of the voxels below the threshold that are enclosed by solid voxels. A particle is the set of solid voxels from
    which steepest ascent of the smoothed distance from the surface leads to the same summit. Memory: 9 volumes.
    """
    v = np.maximum(volume, 0)
    split = _threshold(v)
    if split is None:
        return None
    solid = v > split
    base = _ground(v, solid, split)
    level = float(np.median(v[solid])) - base
    label = _widened(summits(ndi.gaussian_filter(_to_nearest(solid)[0], 1.0), solid))
    return Particles(np.minimum(v, np.float32(base)), np.maximum(v - np.float32(base), 0), label, base, level)


def _threshold(v: F32) -> float | None:
    """Otsu's threshold of the voxels with material; None: there are no two levels."""
    seen = v[v > 0.1 * np.percentile(v, 99)] if v.any() else v[:0]
    if seen.size < 2 or seen.min() == seen.max():
        return None
    counts, edges = np.histogram(seen, 200)
    levels, w = (edges[1:] + edges[:-1]) / 2, np.cumsum(counts)
    mean = np.cumsum(counts * levels)
    return levels[np.argmax((mean[-1] * w / w[-1] - mean) ** 2 / np.maximum(w * (w[-1] - w), 1))]


def _ground(v: F32, solid: NDArray[np.bool_], split: float) -> float:
    """The level between particles; 0 if too few voxels show it."""
    cross, wide = ndi.generate_binary_structure(2, 1)[..., None], _HULL + 4
    rim = ((wide, wide), (wide, wide), (0, 0))
    hull = ndi.binary_closing(np.pad(solid, rim), cross, iterations=_HULL)[wide:-wide, wide:-wide]
    low = v[hull & (v < 0.8 * split)]
    return float(np.median(low)) if low.size > _LEAST_GROUND else 0.0


def _widened(label: NDArray[np.int32]) -> NDArray[np.int32]:
    """The labels, also of voxels within `_RIM_VOXELS` of a particle: these get the label of the nearest particle."""
    distance, nearest = _to_nearest(label == 0)
    widened = np.zeros_like(label)
    for row, nearest_voxels in enumerate(nearest.swapaxes(0, 1)):
        widened[row] = np.where(distance[row] < _RIM_VOXELS, label[tuple(nearest_voxels)], 0)
    return widened


def _to_nearest(mask: NDArray[np.bool_]) -> tuple[F32, NDArray[np.int32]]:
    """Distance in voxels [y, x, z] from each voxel to the nearest voxel outside `mask`, and the place of this voxel
    [3, y, x, z].

    The distances of `ndi.distance_transform_edt` need 12 volumes while they are computed; these need 6.
    """
    nearest = ndi.distance_transform_edt(mask, return_distances=False, return_indices=True)
    squared = np.zeros(mask.shape, np.float32)
    for axis, n in enumerate(mask.shape):
        own = np.arange(n, dtype=np.int32).reshape([-1 if a == axis else 1 for a in range(3)])
        squared += np.square((nearest[axis] - own).astype(np.float32))
    return np.sqrt(squared, out=squared), nearest


def summits(depth: F32, solid: NDArray[np.bool_]) -> NDArray[np.int32]:
    """[y, x, z] numbers from 1: each solid voxel gets the number of the summit of `depth` to which steepest ascent
    leads. 0 elsewhere.
    """
    size, (ny, nx, nz) = depth.size, depth.shape
    box, flat = np.full((ny + 2, nx + 2, nz + 2), -math.inf), np.arange(size)
    uphill = flat.reshape(depth.shape)
    for row in range(ny):  # no two voxels have the same depth
        box[row + 1, 1:-1, 1:-1] = depth[row] + 1e-6 * uphill[row] / size
    for row in range(ny):
        labels, best = uphill[row].copy(), box[row + 1, 1:-1, 1:-1].copy()
        for y, x, z in np.ndindex(3, 3, 3):
            neighbours = box[row + y, x : x + nx, z : z + nz]
            is_higher = neighbours > best
            best[is_higher], uphill[row][is_higher] = (
                neighbours[is_higher],
                labels[is_higher] + ((y - 1) * nx + x - 1) * nz + z - 1,
            )
    del box
    while sum(_climb(row, flat) for row in uphill):
        pass
    is_summit = np.zeros(size, bool)
    for summit_of_voxel, is_solid in zip(uphill, solid, strict=True):
        is_summit[summit_of_voxel[is_solid]] = True
    number, label = np.cumsum(is_summit, dtype=np.int32), np.zeros(depth.shape, np.int32)
    for labels, summit_of_voxel, is_solid in zip(label, uphill, solid, strict=True):
        labels[is_solid] = number[summit_of_voxel[is_solid]]
    return label


def _climb(positions: NDArray[np.intp], uphill: NDArray[np.intp]) -> bool:
    """Move places on to where they lead; False if all of them are summits."""
    next_positions = uphill[positions]
    moved = not np.array_equal(positions, next_positions)
    positions[...] = next_positions
    return moved


def require_finite(reference: Volume) -> None:
    """Raise ValueError if a voxel of the reference is not finite, because it would spoil the levels of all
    particles.
    """
    voxels = reference.data
    n_not_finite = sum(int(np.count_nonzero(~np.isfinite(each))) for each in voxels)
    if n_not_finite:
        raise ValueError(
            f"{n_not_finite} of {voxels.size} voxels of the reference are not finite, but each voxel must be an "
            "attenuation in 1/mm; write 0 in places without material, and interpolate in places with material"
        )


def bytes_placed(reference: Grid | None, grid: Grid, margin: int) -> tuple[int, int]:
    """Largest size in bytes of the result of `placed` at any height of the grid, and of the smoothed copy of a part of
    the reference that `placed` makes if the voxels of the grid are coarser.

    None: a reference that is as wide as the grid and at least as high as the result, with the same voxels.
    """
    nz, ny, nx = grid.shape
    if reference is None:
        return 4 * (nz + 2 * margin) * ny * nx, 0
    extents = zip(reference.shape, reference.spacing, grid.shape, grid.spacing, strict=True)
    size = 4 * math.prod(
        min(n + 2 * margin, math.floor((own - 1) * pitch / edge + 0.02) + 1) for own, pitch, n, edge in extents
    )
    ratios = [edge / pitch for edge, pitch in zip(grid.spacing, reference.spacing, strict=True)]
    smoothed = min(math.ceil(size * math.prod(ratios)), 4 * math.prod(reference.shape))
    return size, smoothed if max(ratios) > _COARSER else 0


def placed(reference: Volume, grid: Grid, margin: int) -> tuple[F32, tuple[int, int, int]]:
    """The reference on the voxels of `grid`, and up to `margin` voxels beyond, as far as the reference extends.

    Returns:
        The voxels [y, x, z], and the index (y, x, z) in them of voxel 0 of the grid.

    Raises:
        ValueError: the reference and the grid have no place in common.
    """
    reference_grid = reference.grid
    size, edge, start = np.array(grid.shape), np.array(grid.spacing), np.array(grid.first)
    own, own_start = np.array(reference_grid.spacing), np.array(reference_grid.first)
    low = np.maximum(np.ceil((own_start - start) / edge - 0.01), -margin).astype(int)
    last_index = (own_start + own * (np.array(reference_grid.shape) - 1) - start) / edge
    high = np.minimum(np.floor(last_index + 0.01), size - 1 + margin).astype(int)
    if (high < low).any():
        raise ValueError(
            f"the reference, {reference_grid}, and the volume to reconstruct, {grid}, do not overlap; give a volume of "
            "the same sample in the same frame"
        )
    ratio, offset = edge / own, (start + low * edge - own_start) / own
    last = np.ceil(offset + ratio * (high - low)).astype(int) + 2
    first_read = np.maximum(np.floor(offset).astype(int) - 1, 0)
    data = np.asarray(reference.data[first_read[0] : last[0]], np.float32)[
        :, first_read[1] : last[1], first_read[2] : last[2]
    ]
    offset = offset - first_read
    if np.allclose(ratio, 1, atol=1e-6) and np.allclose(offset, np.rint(offset), atol=0.01):
        first = np.rint(offset).astype(int)
        part = data[tuple(slice(f, f + n) for f, n in zip(first, high - low + 1, strict=True))]
    else:
        if ratio.max() > _COARSER:  # coarser voxels are means; a window of even size begins half a voxel early
            window = np.maximum(np.rint(ratio), 1).astype(int)
            data, offset = ndi.uniform_filter(data, window, mode="nearest"), offset + (window % 2 == 0) / 2
        part = ndi.affine_transform(data, ratio, offset, tuple(high - low + 1), order=1, mode="nearest")
    z, y, x = (-low).tolist()
    return np.ascontiguousarray(part.transpose(1, 2, 0)), (y, x, z)
