"""unexplained: structure that a volume leaves in the residual of its views, such as a filled crack, beside noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_closing, gaussian_filter

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.masks import RayWeights
from recon.base.noise import ring_offsets
from recon.base.slabs import part_of
from recon.base.volume import Grid, Volume
from recon.voxels.fbp import fbp, fbp_memory, is_gridded
from recon.voxels.projector import Projector, seen_rays
from recon.voxels.resolution import at_voxel_resolution
from recon.voxels.view_weights import seen_by

LIMIT = 0.007
"""Share of the matter above which a volume hides structure: 0.01 to 0.05 in seven fits that fill cracks and round
edges. Up to 0.004 in sixteen finished ones, up to 0.005 in true volumes (docs/notes/exploration.md).
"""

_SIGMAS = 4.0  # standard deviations of the noise, above which noise has a share below 1e-3
_FLIPS = 6
_SMOOTH, _AROUND = 1.0, 4.0  # pixels: size of the detail, and of the map of the noise
_ROWS, _COLS = 8, 256  # rows used, for so many columns; fewer for wider detectors
_LEAST_VIEWS = 16
_MATTER, _CLOSED = 0.2, 2  # share of the 99th percentile; voxels: cracks belong to the matter


@dataclass(frozen=True, eq=False)
class Unexplained:
    """The residual of the views, back-projected on some slices of a volume.

    Attributes:
        share: of the voxels of matter with a residual above four standard deviations of its noise.
        first: number of the first of these slices.
        significance: float32 [z, y, x], filtered back-projection of the residual over its noise; positive where the
        volume is too low.
    """

    share: float
    first: int
    significance: F32


def unexplained(
    volume: Volume,
    projections: F32,
    geometry: Geometry,
    rng: np.random.Generator,
    weights: F32 | RayWeights | None = None,
) -> Unexplained | None:
    """Filtered back-projection of the residual p - A x, over its noise: that of the views with random signs.

    Random signs of the views cancel structure, which all views share, and keep noise [our own; after the odd-even
    differences of half-sets]. Pixels that make rings are removed first. Up to eight rows around the middle of matter
    (of views that climb, those that see most of it) are used, one row if the detector has 700 columns or more.

    Args:
        volume: on the slices of the detector rows, 1/mm.
        weights: of the rays; rays of weight 0 were not measured, and are not used.

    Returns:
        None for cones, rolled or tilted views, fewer than 16 views, other slices, or a volume without matter.
    """
    slices, same = volume.grid.shape[0], volume.grid == Grid.matching(geometry)
    if geometry.is_cone or not geometry.is_straight or geometry.n_views < _LEAST_VIEWS or not same:
        return None
    n = min(_looked_at(geometry), slices)
    mass = np.array([np.maximum(image, 0).sum(dtype=np.float64) for image in volume.data])
    middle = round(float(mass @ np.arange(slices) / mass.sum())) if mass.any() else 0
    first = min(max(middle - n // 2, 0), slices - n)
    if geometry.climbs:  # few views see the slices in between
        at = volume.grid.coordinates()[0] / geometry.pixel_pitch + geometry.axis_row
        seen = np.convolve(mass * seen_by(geometry, at).sum(axis=0), np.ones(n), "valid")
        first = int(seen.argmax())
    rows, views, box = part_of(geometry, volume.grid, slice(first, first + n))
    part = Volume(np.ascontiguousarray(volume.data[first : first + n]), box)
    level = _MATTER * float(np.percentile(part.data, 99))
    matter = np.stack([binary_closing(image > level, iterations=_CLOSED) for image in part.data])
    if level <= 0 or not matter.any():
        return None
    measured, projector = projections[:, rows], Projector(views, part.grid)
    unseen = np.broadcast_to(~seen_rays(views, part.grid), measured.shape)
    if weights is not None:
        unseen = unseen | (weights[:, rows] == 0)
    lines = np.where(unseen, np.float32(0), measured).swapaxes(1, 2)  # at the resolution of voxels, as the model is
    left = at_voxel_resolution(lines, projector.resolution, ~unseen.swapaxes(1, 2)).swapaxes(1, 2)
    left = left - projector.forward(part.data)
    left[unseen] = 0
    left -= ring_offsets(left, views)
    left[unseen] = 0

    signs = np.where(np.arange(len(left)) % 2, np.float32(1), np.float32(-1))
    kinds = np.stack([np.ones_like(signs), *(rng.permutation(signs) for _ in range(_FLIPS))])
    first_kind, *flipped = _fbp_of_each(left, kinds, views, box)
    found, variance = _smoothed(first_kind), np.zeros(part.grid.shape, np.float32)
    for images in flipped:
        variance += _smoothed(images) ** 2 / _FLIPS
    noise = np.sqrt(gaussian_filter(variance, (0, _AROUND, _AROUND)))
    significance = np.divide(found, noise, out=np.zeros_like(found), where=noise > 0)
    return Unexplained(float(np.mean(np.abs(significance[matter]) > _SIGMAS)), first, significance)


def unexplained_memory(geometry: Geometry) -> int:
    """Bytes that `unexplained` takes beside projections and volume, about."""
    n, views, cols = _looked_at(geometry), geometry.n_views, geometry.detector_shape[1]
    slices = (1 + _FLIPS) * n
    gridded = is_gridded(replace(geometry, detector_shape=(slices, cols)), Grid((slices, cols, cols)), "hann")
    return 4 * n * cols * (13 * cols + 8 * views) + (fbp_memory(views, cols) if gridded else 80 * views * cols)


def _looked_at(geometry: Geometry) -> int:
    rows, cols = geometry.detector_shape
    return min(rows, max(1, round(_ROWS * (_COLS / cols) ** 2)))


def _smoothed(images: F32) -> F32:
    return gaussian_filter(images, (0, _SMOOTH, _SMOOTH))


def _fbp_of_each(residual: F32, signs: F32, views: Geometry, box: Grid) -> list[F32]:
    """The slices of the box, of the residual times each row of signs [kind, view].

    If views do not move along the axis, all are slices of one volume, which takes less time.
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
