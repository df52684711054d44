"""Checks of a volume: material in places that the projections show to be empty, structure in the residual, and lost
weak material.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.ndimage import binary_dilation, gaussian_filter

from recon.base.arrays import F32, Mask, bin_views
from recon.base.geometry import Geometry
from recon.base.noise import air_level, noise_level
from recon.base.slabs import part_of
from recon.base.stripes import ring_offsets
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.voxels.fbp import fbp, fbp_memory, is_gridded
from recon.voxels.one_projection import AskedRays, RayCheck, in_bands
from recon.voxels.projector import Projector, projection_images, seen_rays
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from recon.voxels.view_weights import seen_by

STRAY_LIMIT = 0.05
"""Share of the mass above which there is a warning, see docs/published.md."""

_VIEWS, _AGREE = 24, 2  # number of examined projections; number of projections that must show a voxel as empty
# blur in pixels; limit in standard deviations of the blurred noise; limit as a share of the 99th percentile
_BLUR, _SIGMAS, _LEAST = 1.0, 4.0, 0.005
_LEAST_AIR_SHARE = 0.999  # share of the rays of a voxel that must pass through air only
# largest number of examined voxels (at least one slice is examined); the same for a volume whose rows do not show
# slices
_MOST, _MOST_WHOLE = 2**18, 2**21
_WORK = 40  # bytes per examined voxel
_LEAST_AIR = 100  # fewest voxels, or blocks, from which an air level is computed
# percentile that is the density unit; share of the density unit above which a density counts
_MATTER, _FAINT = 99.5, 0.05


@dataclass(frozen=True, eq=False)
class StrayMass:
    """Mass of a volume in voxels that the projections show to be empty.

    Attributes:
        share: share of the mass of the volume in these voxels, counting densities above a twentieth of the density
            unit.
        map: float32 [y, x], the highest density along z in these voxels.
        first: number of the first examined slice.
        air: bool [slice, y, x], the empty voxels that all examined projections see. In other empty voxels FBP has no
            meaning.
    """

    share: float
    map: F32
    first: int
    air: Mask

    def level(self, volume: Volume) -> tuple[float, float]:
        """Mean and standard deviation of a volume on the same grid in `air`; NaN if `air` has fewer than 100 voxels."""
        values = volume.data[self.first : self.first + len(self.air)][self.air]
        if values.size < _LEAST_AIR:
            return math.nan, math.nan
        return float(values.mean(dtype=np.float64)), float(values.std(dtype=np.float64))


def stray_mass(volume: Volume, views: Views) -> StrayMass | None:
    """The mass in voxels that the projections show to be empty. In a large volume, only slices around the middle are
    examined.

    Returns:
        None if no voxel is shown to be empty, the volume contains no material, or it is large and rows do not show
        slices.
    """
    nz, looked_at, first = volume.grid.shape[0], _looked_at(views.geometry, volume.grid), 0
    if looked_at == 0:
        return None
    if nz > looked_at:
        first = (nz - looked_at) // 2
        band = slice(first, first + looked_at)
        views = views.rows(band)
        volume = Volume(np.ascontiguousarray(volume.data[band]), Grid.matching(views.geometry))
    empty, by_all = seen_empty(views, volume.grid)
    densities = np.maximum(volume.data, 0)
    positive = densities[densities > 0]
    if not empty.any() or not positive.size:
        return None
    stray = np.where(empty & (densities > _FAINT * np.percentile(positive, _MATTER)), densities, 0)
    share = float(stray.sum(dtype=np.float64) / densities.sum(dtype=np.float64))
    return StrayMass(share, stray.max(axis=0), first, empty & by_all)


def stray_mass_memory(geometry: Geometry, grid: Grid) -> int:
    """Approximate memory of `stray_mass` in bytes, without projections and volume."""
    slices = _looked_at(geometry, grid)
    rows = min(slices, geometry.detector_shape[0]) if slices < grid.shape[0] else geometry.detector_shape[0]
    rays = min(geometry.n_views, _VIEWS) * rows * geometry.detector_shape[1]
    return _WORK * slices * grid.shape[1] * grid.shape[2] + 8 * rays


def stray_mass_share(geometry: Geometry, grid: Grid) -> float:
    """Approximate duration of `stray_mass`, in units of projecting the volume once."""
    return 3 * min(1.0, _VIEWS / geometry.n_views) * _looked_at(geometry, grid) / grid.shape[0]


def _looked_at(geometry: Geometry, grid: Grid) -> int:
    """Number of examined slices; 0: the volume is not examined."""
    nz, slice_ = grid.shape[0], grid.shape[1] * grid.shape[2]
    if geometry.rows_show_slices and grid == Grid.matching(geometry):
        return min(nz, max(1, _MOST // slice_))
    return nz if nz * slice_ <= _MOST_WHOLE else 0


def seen_empty(views: Views, grid: Grid) -> tuple[Mask, Mask]:
    """The voxels [z, y, x] that at least two of up to 24 projections show as empty, and the voxels that all these
    projections see.

    A ray crosses no material if its line integral, blurred by a pixel, is within four standard deviations of the noise,
    or within 0.5 % of the line integrals of the thick parts. Thinner material counts as air.
    """
    part = views.select(spread(np.arange(views.geometry.n_views), _VIEWS)).masked()
    data, known = part.data, part.weights
    noise = noise_level(data) / (2 * math.sqrt(math.pi) * _BLUR)  # after the blur
    limit = max(_SIGMAS * noise, _LEAST * float(np.percentile(data, 99)))
    geometry = replace(part.geometry, skew=0.0) if part.geometry.skew else part.geometry
    votes, by_all = np.zeros(grid.shape, np.int16), np.ones(grid.shape, bool)
    for view, image in enumerate(data):
        air = gaussian_filter(image, _BLUR) < limit
        if known is not None:
            air &= known[view] > 0
        projector = Projector(geometry.select([view]), grid)
        through_all = projector.adjoint(np.ones((1, *air.shape), np.float32))
        by_all &= through_all > 0
        if not air.any():
            continue
        through_air = projector.adjoint(air[None].astype(np.float32))
        votes += (through_all > 0) & (through_air >= np.float32(_LEAST_AIR_SHARE) * through_all)
    return votes >= _AGREE, by_all


UNEXPLAINED_LIMIT = 0.007
"""Share of the material above which a volume hides structure. It is 0.01 to 0.05 in seven fits that fill cracks and
round off edges, up to 0.004 in sixteen fits with voxel refinement, and up to 0.005 in true volumes.
"""

_SIGNIFICANT = 4.0  # standard deviations of the noise; above it, the share of voxels with noise only is below 1e-3
_FLIPS = 6
# pixels: smoothing of the detail, and smoothing of the map of the noise
_DETAIL_SMOOTHING, _NOISE_MAP_SMOOTHING = 1.0, 4.0
_ROWS, _COLS = 8, 256  # number of rows that are used for this number of columns; fewer rows for wider detectors
_LEAST_VIEWS = 16
# share of the 99th percentile above which a voxel is material; radius of the closing in voxels, so that cracks belong
# to the material
_DENSE, _CLOSED = 0.2, 2


@dataclass(frozen=True, eq=False)
class Unexplained:
    """The residual of the projections, back-projected on some slices of a volume.

    Attributes:
        share: share of the voxels of material with a residual above four standard deviations of its noise.
        first: number of the first of these slices.
        significance: float32 [z, y, x], filtered back-projection of the residual divided by its noise; positive where
            the volume is too low.
    """

    share: float
    first: int
    significance: F32


def unexplained(volume: Volume, views: Views, rng: np.random.Generator) -> RayCheck[Unexplained | None]:
    """Filtered back-projection of the residual p - A x, divided by its noise (measured with random signs).

    If projections get random signs, structure cancels because all projections share it, and noise remains (our own
    method, after the odd-even differences of half-sets). Pixels that make rings are removed first. Up to eight rows
    around the middle of the material are used, or one row if the detector has 700 columns or more. If the projections
    move along the axis, the rows that see most of the material are used.

    Args:
        volume: the volume on the slices of the detector rows, 1/mm.
        views: the projections.

    Returns:
        The check. Its result is None for a cone, rolled or tilted projections, fewer than 16 projections, other slices,
        or a volume without material.
    """
    no_check: RayCheck[Unexplained | None] = RayCheck((), lambda: None)
    geometry, slices = views.geometry, volume.grid.shape[0]
    rows_differ = geometry.is_cone or not geometry.is_straight or volume.grid != Grid.matching(geometry)
    if rows_differ or geometry.n_views < _LEAST_VIEWS:
        return no_check
    n = min(_rows_looked_at(geometry), slices)
    mass = np.array([np.maximum(image, 0).sum(dtype=np.float64) for image in volume.data])
    middle = round(float(mass @ np.arange(slices) / mass.sum())) if mass.any() else 0
    first = min(max(middle - n // 2, 0), slices - n)
    if geometry.climbs:  # few projections see the slices between the ends
        slice_rows = volume.grid.coordinates()[0] / geometry.pixel_pitch + geometry.axis_row
        first = int(np.convolve(mass * seen_by(geometry, slice_rows).sum(axis=0), np.ones(n), "valid").argmax())
    rows, _, box = part_of(geometry, volume.grid, slice(first, first + n))
    part = Volume(np.ascontiguousarray(volume.data[first : first + n]), box)
    level = _DENSE * float(np.percentile(part.data, 99))
    material = np.stack([ndimage.binary_closing(image > level, iterations=_CLOSED) for image in part.data])
    if level <= 0 or not material.any():
        return no_check
    views_of_rows, model = views.rows(rows), list[F32]()
    parts = [AskedRays(np.arange(geometry.n_views), rows, lambda lines: model.append(projection_images(lines)))]
    if not in_bands(geometry, volume.grid):  # the rows also show other slices, so these slices are projected alone
        parts, model = [], [Projector(views_of_rows.geometry, box).forward(part.data)]
    return RayCheck(parts, lambda: _structure(views_of_rows, model[0], part, first, material, rng))


def _structure(
    views: Views, model: F32, part: Volume, first: int, material: Mask, rng: np.random.Generator
) -> Unexplained:
    """Compute the result of `unexplained` for the slices from `first` on, whose projection is `model` [view, row,
    col].
    """
    geometry, box = views.geometry, part.grid
    unseen = np.broadcast_to(~seen_rays(geometry, box), model.shape)
    if views.weights is not None:
        unseen = unseen | (views.weights == 0)
    lines = np.where(unseen, np.float32(0), views.data).swapaxes(1, 2)  # at the resolution of voxels, like the model
    residual = at_voxel_resolution(lines, ViewResolution.of(geometry, box), ~unseen.swapaxes(1, 2)).swapaxes(1, 2)
    residual = residual - model
    residual[unseen] = 0
    residual -= ring_offsets(residual, geometry)
    residual[unseen] = 0

    signs = np.where(np.arange(len(residual)) % 2, np.float32(1), np.float32(-1))
    kinds = np.stack([np.ones_like(signs), *(rng.permutation(signs) for _ in range(_FLIPS))])
    first_kind, *flipped = _fbp_of_each(residual, kinds, geometry, box)
    averaged, variance = _smoothed(first_kind), np.zeros(box.shape, np.float32)
    for images in flipped:
        variance += _smoothed(images) ** 2 / _FLIPS
    noise = np.sqrt(gaussian_filter(variance, (0, _NOISE_MAP_SMOOTHING, _NOISE_MAP_SMOOTHING)))
    significance = np.divide(averaged, noise, out=np.zeros_like(averaged), where=noise > 0)
    return Unexplained(float(np.mean(np.abs(significance[material]) > _SIGNIFICANT)), first, significance)


def unexplained_memory(geometry: Geometry) -> int:
    """Approximate memory of `unexplained` in bytes, without projections and volume."""
    n, views, cols = _rows_looked_at(geometry), geometry.n_views, geometry.detector_shape[1]
    slices = (1 + _FLIPS) * n
    gridded = is_gridded(replace(geometry, detector_shape=(slices, cols)), Grid((slices, cols, cols)), "hann")
    # the residual is computed before the volumes, or the volumes are larger
    largest = max(19 * views, 13 * cols + 8 * views)
    return 4 * n * cols * largest + (fbp_memory(views, cols) if gridded else 80 * views * cols)


def _rows_looked_at(geometry: Geometry) -> int:
    rows, cols = geometry.detector_shape
    return min(rows, max(1, round(_ROWS * (_COLS / cols) ** 2)))


def _smoothed(images: F32) -> F32:
    return gaussian_filter(images, (0, _DETAIL_SMOOTHING, _DETAIL_SMOOTHING))


def _fbp_of_each(residual: F32, signs: F32, views: Geometry, box: Grid) -> list[F32]:
    """FBP of the slices of the box, from the residual times each row of signs [kind, view].

    If projections do not move along the axis, all results are computed as slices of one volume, which takes less time.
    """
    rows, cols = views.detector_shape
    kinds = len(signs)
    if views.shifts[:, 1].any():
        signed = (np.asarray(residual * sign[:, None, None], np.float32) for sign in signs)
        return [fbp(data, views, box, filter="hann") for data in signed]
    views = views.at_row((rows - 1) / 2)
    stacked = replace(views, detector_shape=(kinds * rows, cols), axis_row=(kinds * rows - 1) / 2)
    data = np.multiply(residual[:, None], signs.T[:, :, None, None], dtype=np.float32).reshape(-1, kinds * rows, cols)
    images = fbp(data, stacked, filter="hann")
    return list(images.reshape(kinds, rows, *images.shape[1:]))


_BLOCKS = 96  # largest number of blocks along the longest side of a volume
_SMOOTHED_BLOCKS, _ABOVE_AIR = 1.5, 5.0  # smoothing in blocks; least density of material in standard deviations of air
_MARGIN, _RIM = 4, 0.92  # blocks around material; share of the radius that all projections see
_LEFT = 0.5  # a block has lost its material if its density is below this share of the density in FBP
# size along z, y and x, in blocks, of the boxes of which a region consists; fewest blocks of a region
_CORE, _LEAST_REGION = (3, 5, 5), 64
_BLOCKS_BESIDE_DARK = 2  # blocks next to slices without beam; smoothing mixes them with these slices


@dataclass(frozen=True)
class LostMatter:
    """The largest region of material that FBP of the same projections shows, but that is missing in a volume.

    Attributes:
        region: (z, y, x), each the first voxel and the one after the last.
        kept_share: mass in this region divided by the mass in FBP. Both masses are relative to the air level of their
            volume.
    """

    region: tuple[tuple[int, int], ...]
    kept_share: float


def lost_matter(volume: F32, reference: F32, in_beam: NDArray[np.bool_] | None = None) -> LostMatter | None:
    """The largest region in which a volume lost weak material that the reference shows above its air level.

    The check works on blocks of voxels, so that a volume on disk needs little memory. A region is a union of boxes of 3
    x 5 x 5 blocks [z, y, x], because streaks are thinner.

    Args:
        volume: [z, y, x], from any method.
        reference: [z, y, x], FBP or FDK.
        in_beam: [z], True for slices whose rows had beam. Only these are compared, because in other slices FBP shows
            filled values. None: all slices.

    Returns:
        None if no region lost material, or the reference shows no air.
    """
    factor = max(1, math.ceil(max(volume.shape) / _BLOCKS))
    factor = min(factor, *volume.shape)
    reference_blocks, volume_blocks = _blocks(reference, factor), _blocks(volume, factor)
    ny, nx = reference_blocks.shape[1:]
    y, x = np.mgrid[:ny, :nx]
    disc = np.hypot(y - (ny - 1) / 2, x - (nx - 1) / 2) <= _RIM * min(ny, nx) / 2
    is_compared = np.repeat(disc[None], len(reference_blocks), axis=0)
    if in_beam is not None:
        blocks = in_beam[: len(reference_blocks) * factor].reshape(-1, factor).all(axis=1)
        is_compared &= ndimage.binary_erosion(blocks, iterations=_BLOCKS_BESIDE_DARK, border_value=1)[:, None, None]
    smooth = [min(_SMOOTHED_BLOCKS, n / 8) for n in reference_blocks.shape]
    reference_blocks, volume_blocks = (
        gaussian_filter(values, smooth, mode="nearest") for values in (reference_blocks, volume_blocks)
    )
    if not is_compared.any():
        return None
    reference_air, noise = air_level(reference_blocks[is_compared])
    material = (reference_blocks - reference_air > _ABOVE_AIR * noise) & is_compared
    air = is_compared & ~binary_dilation(material, iterations=_MARGIN)
    if noise == 0 or air.sum() < _LEAST_AIR:
        return None
    volume_air = float(volume_blocks[air].mean(dtype=np.float64))
    is_lost = material & (volume_blocks - volume_air < _LEFT * (reference_blocks - reference_air))
    core = [min(n, side) for n, side in zip(is_lost.shape, _CORE, strict=True)]
    parts, n = ndimage.label(ndimage.binary_opening(is_lost, np.ones(core)))
    sizes = np.bincount(parts.ravel())[1:]
    if not n or sizes.max() < _LEAST_REGION:
        return None
    largest = int(sizes.argmax())
    region = parts == largest + 1
    kept_share = float(
        (volume_blocks[region] - volume_air).sum(dtype=np.float64)
        / (reference_blocks[region] - reference_air).sum(dtype=np.float64)
    )
    return LostMatter(
        tuple((part.start * factor, part.stop * factor) for part in ndimage.find_objects(parts)[largest]), kept_share
    )


def _blocks(volume: F32, factor: int) -> F32:
    """Means of blocks of `factor` voxels a side; voxels at the ends that do not fill a block are dropped."""
    layers = (volume[z : z + factor].mean(axis=0, dtype=np.float32) for z in range(0, len(volume) - factor + 1, factor))
    return np.concatenate([bin_views(layer[None], factor) for layer in layers])
