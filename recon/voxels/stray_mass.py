"""stray_mass: density where views show that nothing is, which sparse or noisy views leave in a volume."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, Mask
from recon.base.geometry import Geometry
from recon.base.masks import RayWeights, masked
from recon.base.noise import noise_level
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.voxels.projector import Projector

LIMIT = 0.05
"""Share of the mass above which a volume is told, see docs/published.md."""

_VIEWS, _AGREE = 24, 2  # looked at; that must show a voxel empty
_BLUR, _SIGMAS, _LEAST = 1.0, 4.0, 0.005  # pixels; of the blurred noise; of the 99th percentile of line integrals
_WHOLE = 0.999  # share of a voxel's rays through air
_MOST, _MOST_WHOLE = 2**18, 2**21  # voxels looked at, or one slice; where rows show no slices, those of a volume
_WORK = 40  # bytes of a voxel that is looked at
_LEAST_AIR = 100  # voxels whose level counts
_MATTER, _FAINT = 99.5, 0.05  # percentile that is the density unit; share of it that counts


@dataclass(frozen=True, eq=False)
class StrayMass:
    """Mass of a volume in the voxels that views show to be empty.

    Attributes:
        empty: share of the voxels that are shown to be empty.
        share: of the volume's mass that lies in them, counting densities above a twentieth of the density unit.
        map: float32 [y, x], the highest density above each other in these voxels.
        first: number of the first slice that was looked at.
        air: bool [slice, y, x], those of these voxels that every view looked at sees: beyond, FBP means nothing.
    """

    empty: float
    share: float
    map: F32
    first: int
    air: Mask

    def level(self, volume: Volume) -> tuple[float, float]:
        """Mean and standard deviation of a volume on the same grid in `air`; NaN where that has under 100 voxels."""
        values = volume.data[self.first : self.first + len(self.air)][self.air]
        if values.size < _LEAST_AIR:
            return math.nan, math.nan
        return float(values.mean(dtype=np.float64)), float(values.std(dtype=np.float64))


def stray_mass(
    volume: Volume, projections: F32, geometry: Geometry, weights: F32 | RayWeights | None = None
) -> StrayMass | None:
    """Density in the voxels that views show to be empty; of a large volume, in slices around its middle.

    Args:
        volume: of any method.
        weights: of rays [view, row, col]; rays of weight 0 show nothing.

    Returns:
        None if no voxel is shown to be empty, the volume holds no matter, or it is large and its slices are no rows.
    """
    nz, looked_at, first = volume.grid.shape[0], _looked_at(geometry, volume.grid), 0
    if looked_at == 0:
        return None
    if nz > looked_at:
        first = (nz - looked_at) // 2
        band = slice(first, first + looked_at)
        geometry, projections = geometry.rows(band.start, band.stop), projections[:, band]
        weights = None if weights is None else weights[:, band]
        volume = Volume(np.ascontiguousarray(volume.data[band]), Grid.matching(geometry))
    empty, by_all = _empty_and_seen(projections, geometry, volume.grid, weights)
    matter = np.maximum(volume.data, 0)
    positive = matter[matter > 0]
    if not empty.any() or not positive.size:
        return None
    stray = np.where(empty & (matter > _FAINT * np.percentile(positive, _MATTER)), matter, 0)
    share = float(stray.sum(dtype=np.float64) / matter.sum(dtype=np.float64))
    return StrayMass(float(empty.mean()), share, stray.max(axis=0), first, empty & by_all)


def stray_mass_memory(geometry: Geometry, grid: Grid) -> int:
    """Bytes that `stray_mass` takes beside projections and volume, about."""
    slices = _looked_at(geometry, grid)
    rows = min(slices, geometry.detector_shape[0]) if slices < grid.shape[0] else geometry.detector_shape[0]
    rays = min(geometry.n_views, _VIEWS) * rows * geometry.detector_shape[1]
    return _WORK * slices * grid.shape[1] * grid.shape[2] + 8 * rays


def stray_mass_share(geometry: Geometry, grid: Grid) -> float:
    """About how many projections of all rays take as long as `stray_mass`."""
    return 3 * min(1.0, _VIEWS / geometry.n_views) * _looked_at(geometry, grid) / grid.shape[0]


def _looked_at(geometry: Geometry, grid: Grid) -> int:
    """Slices of the volume; 0 if it is not looked at."""
    nz, slice_ = grid.shape[0], grid.shape[1] * grid.shape[2]
    if geometry.rows_show_slices and grid == Grid.matching(geometry):
        return min(nz, max(1, _MOST // slice_))
    return nz if nz * slice_ <= _MOST_WHOLE else 0


def seen_empty(projections: F32, geometry: Geometry, grid: Grid, weights: F32 | RayWeights | None = None) -> Mask:
    """[z, y, x] voxels whose rays in at least two of up to 24 views meet no matter.

    A ray meets none where its line integral, blurred by a pixel, is within four standard deviations of the noise, or
    within 0.5 % of the thick parts. So matter much thinner than that counts as none.
    """
    return _empty_and_seen(projections, geometry, grid, weights)[0]


def _empty_and_seen(
    projections: F32, geometry: Geometry, grid: Grid, weights: F32 | RayWeights | None
) -> tuple[Mask, Mask]:
    """As `seen_empty`, and the voxels that are on the detector in all of these views, [z, y, x] each."""
    some = spread(np.arange(geometry.n_views), _VIEWS)
    data, known = masked(projections[some], None if weights is None else weights[some])
    noise = noise_level(data) / (2 * math.sqrt(math.pi) * _BLUR)  # after the blur
    limit = max(_SIGMAS * noise, _LEAST * float(np.percentile(data, 99)))
    views = replace(geometry.select(some), skew=0.0) if geometry.skew else geometry.select(some)
    votes, by_all = np.zeros(grid.shape, np.int16), np.ones(grid.shape, bool)
    for view, image in enumerate(data):
        air = gaussian_filter(image, _BLUR) < limit
        if known is not None:
            air &= known[view] > 0
        one = Projector(views.select([view]), grid)
        through_all = one.adjoint(np.ones((1, *air.shape), np.float32))
        by_all &= through_all > 0
        if not air.any():
            continue
        through_air = one.adjoint(air[None].astype(np.float32))
        votes += (through_all > 0) & (through_air >= np.float32(_WHOLE) * through_all)
    return votes >= _AGREE, by_all
