"""The parts of a reference volume: the ground between particles, what is above it, and the particle of each voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage as ndi

from recon.base.arrays import F32
from recon.base.volume import Grid, Volume

_HULL = 8  # voxels by which gaps are closed, so that the material between particles is found
_NEAR = 4  # voxels around a particle that belong to it
_LEAST_GROUND = 100  # voxels from which on the ground is measured; otherwise there is air between particles


@dataclass(frozen=True, eq=False)
class Particles:
    """A reference volume [y, x, z] in parts.

    Attributes:
        ground: the volume up to the level between particles.
        above: what the volume has above that level; ground + above is the volume.
        label: the particle of each voxel, from 1; 0: none within 4 voxels.
        base: the level between particles.
        level: typical level of particles above `base`.
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
    """The parts of a volume [y, x, z]; None: it shows no material.

    Two levels are separated by Otsu's threshold (1979, IEEE Trans. Syst. Man Cybern. 9, 62). The ground is the median
    of the voxels below it that are enclosed by solid ones. A particle is the set of solid voxels that climb to the same
    summit of the smoothed distance from the surface.
    """
    v = np.maximum(volume, 0)
    seen = v[v > 0.1 * np.percentile(v, 99)] if v.any() else v[:0]
    if seen.size < 2 or seen.min() == seen.max():
        return None
    counts, edges = np.histogram(seen, 200)
    at, w = (edges[1:] + edges[:-1]) / 2, np.cumsum(counts)
    mean = np.cumsum(counts * at)
    split = at[np.argmax((mean[-1] * w / w[-1] - mean) ** 2 / np.maximum(w * (w[-1] - w), 1))]
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
    """Numbers from 1 [y, x, z]: each solid voxel belongs to the summit of `depth` that it climbs to; 0 elsewhere."""
    apart = depth + 1e-6 * np.arange(depth.size).reshape(depth.shape) / depth.size  # no ties
    uphill, best = np.arange(depth.size).reshape(depth.shape), apart.copy()
    box, index = np.pad(apart, 1), np.pad(uphill, 1)
    for at in np.ndindex(3, 3, 3):
        part = tuple(slice(o, o + n) for o, n in zip(at, depth.shape, strict=True))
        better = box[part] > best
        best[better], uphill[better] = box[part][better], index[part][better]
    flat = uphill.ravel()
    while not np.array_equal(flat, flat[flat]):
        flat = flat[flat]
    label = np.zeros(depth.shape, np.int32)
    label[solid] = np.unique(flat.reshape(depth.shape)[solid], return_inverse=True)[1] + 1
    return label


def require_finite(reference: Volume) -> None:
    """Raises ValueError if a voxel of the reference has no finite value: it would spoil the levels of all particles."""
    voxels = reference.data
    wrong = sum(int(np.count_nonzero(~np.isfinite(each))) for each in voxels)
    if wrong:
        raise ValueError(
            f"{wrong} of {voxels.size} voxels of the reference are not finite, but each must be an attenuation in "
            "1/mm; write 0 in places without material, and interpolate in places with material"
        )


def placed(reference: Volume, grid: Grid, margin: int) -> tuple[F32, tuple[int, int, int]]:
    """The reference on the voxels of `grid` and up to `margin` voxels beyond it, as far as it reaches.

    Returns:
        The voxels [y, x, z], and which of them (y, x, z) lies at voxel 0 of the grid.

    Raises:
        ValueError: the reference and the grid have no common place.
    """
    given = reference.grid
    size, edge, start = np.array(grid.shape), np.array(grid.spacing), np.array(grid.first)
    own, own_start = np.array(given.spacing), np.array(given.first)
    low = np.maximum(np.ceil((own_start - start) / edge - 0.01), -margin).astype(int)
    ends = (own_start + own * (np.array(given.shape) - 1) - start) / edge
    high = np.minimum(np.floor(ends + 0.01), size - 1 + margin).astype(int)
    if (high < low).any():
        raise ValueError(
            f"the reference, {given}, and the volume to reconstruct, {grid}, do not overlap; give a volume of "
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
        if ratio.max() > 1.5:  # coarser voxels show the mean; an even window begins half a voxel early
            wide = np.maximum(np.rint(ratio), 1).astype(int)
            data, offset = ndi.uniform_filter(data, wide, mode="nearest"), offset + (wide % 2 == 0) / 2
        part = ndi.affine_transform(data, ratio, offset, tuple(high - low + 1), order=1, mode="nearest")
    z, y, x = (-low).tolist()
    return np.ascontiguousarray(part.transpose(1, 2, 0)), (y, x, z)
