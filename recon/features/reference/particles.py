"""Divides a reference volume into parts: the ground between particles, the excess above the ground, and the particle of
each voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage as ndi

from recon.base.arrays import F32
from recon.base.volume import Grid, Volume

_HULL = 8  # voxels by which gaps are closed, to find the material between particles
_NEAR = 4  # voxels around a particle that count as part of the particle
# smallest number of voxels from which the ground is measured; with fewer voxels, air is assumed between particles
_LEAST_GROUND = 100


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
    which steepest ascent of the smoothed distance from the surface leads to the same summit.
    """
    v = np.maximum(volume, 0)
    seen = v[v > 0.1 * np.percentile(v, 99)] if v.any() else v[:0]
    if seen.size < 2 or seen.min() == seen.max():
        return None
    counts, edges = np.histogram(seen, 200)
    levels, w = (edges[1:] + edges[:-1]) / 2, np.cumsum(counts)
    mean = np.cumsum(counts * levels)
    split = levels[np.argmax((mean[-1] * w / w[-1] - mean) ** 2 / np.maximum(w * (w[-1] - w), 1))]
    solid, cross, wide = v > split, ndi.generate_binary_structure(2, 1)[..., None], _HULL + 4
    rim = ((wide, wide), (wide, wide), (0, 0))
    hull = ndi.binary_closing(np.pad(solid, rim), cross, iterations=_HULL)[wide:-wide, wide:-wide]
    low = v[hull & (v < 0.8 * split)]
    base = float(np.median(low)) if low.size > _LEAST_GROUND else 0.0
    level = float(np.median(v[solid])) - base
    depth = ndi.distance_transform_edt(solid).astype(np.float32)
    label = summits(ndi.gaussian_filter(depth, 1.0), solid)
    away, near = ndi.distance_transform_edt(label == 0, return_indices=True)
    label = np.where(away < _NEAR, label[tuple(near)], 0).astype(np.int32)
    return Particles(np.minimum(v, np.float32(base)), np.maximum(v - np.float32(base), 0), label, base, level)


def summits(depth: F32, solid: NDArray[np.bool_]) -> NDArray[np.int32]:
    """[y, x, z] numbers from 1: each solid voxel gets the number of the summit of `depth` to which steepest ascent
    leads. 0 elsewhere.
    """
    apart = depth + 1e-6 * np.arange(depth.size).reshape(depth.shape) / depth.size  # no two voxels have the same depth
    uphill, best = np.arange(depth.size).reshape(depth.shape), apart.copy()
    box, index = np.pad(apart, 1), np.pad(uphill, 1)
    for corner in np.ndindex(3, 3, 3):
        part = tuple(slice(o, o + n) for o, n in zip(corner, depth.shape, strict=True))
        better = box[part] > best
        best[better], uphill[better] = box[part][better], index[part][better]
    flat = uphill.ravel()
    while not np.array_equal(flat, flat[flat]):
        flat = flat[flat]
    label = np.zeros(depth.shape, np.int32)
    label[solid] = np.unique(flat.reshape(depth.shape)[solid], return_inverse=True)[1] + 1
    return label


def require_finite(reference: Volume) -> None:
    """Raise ValueError if a voxel of the reference is not finite, because it would spoil the levels of all
    particles.
    """
    voxels = reference.data
    wrong = sum(int(np.count_nonzero(~np.isfinite(each))) for each in voxels)
    if wrong:
        raise ValueError(
            f"{wrong} of {voxels.size} voxels of the reference are not finite, but each must be an attenuation in "
            "1/mm; write 0 where there is no material, and interpolate where there is some"
        )


def placed(reference: Volume, grid: Grid, margin: int) -> tuple[F32, tuple[int, int, int]]:
    """The reference on the voxels of `grid`, and up to `margin` voxels beyond, as far as the reference extends.

    Returns:
        The voxels [y, x, z], and the index (y, x, z) in them of voxel 0 of the grid.

    Raises:
        ValueError: the reference and the grid have no place in common.
    """
    given = reference.grid
    size, edge, start = np.array(grid.shape), np.array(grid.spacing), np.array(grid.first)
    own, own_start = np.array(given.spacing), np.array(given.first)
    low = np.maximum(np.ceil((own_start - start) / edge - 0.01), -margin).astype(int)
    ends = (own_start + own * (np.array(given.shape) - 1) - start) / edge
    high = np.minimum(np.floor(ends + 0.01), size - 1 + margin).astype(int)
    if (high < low).any():
        raise ValueError(
            f"the reference, {given}, and the volume to reconstruct, {grid}, have no common place; give a volume of "
            "the same sample in the same frame"
        )
    ratio, offset = edge / own, (start + low * edge - own_start) / own
    last = np.ceil(offset + ratio * (high - low)).astype(int) + 2
    before = np.maximum(np.floor(offset).astype(int) - 1, 0)
    data = np.asarray(reference.data[before[0] : last[0]], np.float32)[:, before[1] : last[1], before[2] : last[2]]
    offset = offset - before
    if np.allclose(ratio, 1, atol=1e-6) and np.allclose(offset, np.rint(offset), atol=0.01):
        first = np.rint(offset).astype(int)
        part = data[tuple(slice(f, f + n) for f, n in zip(first, high - low + 1, strict=True))]
    else:
        if ratio.max() > 1.5:  # coarser voxels are means; a window of even size begins half a voxel early
            wide = np.maximum(np.rint(ratio), 1).astype(int)
            data, offset = ndi.uniform_filter(data, wide, mode="nearest"), offset + (wide % 2 == 0) / 2
        part = ndi.affine_transform(data, ratio, offset, tuple(high - low + 1), order=1, mode="nearest")
    z, y, x = (-low).tolist()
    return np.ascontiguousarray(part.transpose(1, 2, 0)), (y, x, z)
