"""Background of the beam: found on the rays that miss the sample, and taken off where the views confirm it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.projections.corrections.air import Surface
from beamline.projections.truncation import cut_sides
from recon.base.arrays import F32, F64, Mask
from recon.base.binning import bin_views, factor_within
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.noise import noise_level
from recon.base.volume import Grid
from recon.prep.background import LEAST_SIZE, AirSums, Background, matter
from recon.splatting.initialise import first_volume
from recon.voxels.fbp import fbp_memory
from recon.voxels.projector import Projector

_VOXELS, _VIEWS = 2**20, 180  # at most, of the volume that tells where the sample is
_RIMS = 6.0, 1.5  # voxels, by round: there an uneven beam piles up, until the second round, in which most is taken off
_COPIES = 6  # float32 copies of the volume
_TERMS, _SUMS = 40, 800  # float64 numbers a binned pixel, and a view
_AT_ONCE, _NOISE_VIEWS = 64, 16  # views
_LEAST_VIEWS, _WIDEST_GAP = 12, np.radians(30)


def background_memory(geometry: Geometry) -> int:
    """Most bytes that `without_background` takes beside such views, about."""
    small = geometry.binned(factor_within(geometry.detector_shape, _VOXELS))
    n, pixels, grid = geometry.n_views, math.prod(small.detector_shape), Grid.matching(small)
    some = min(n, _VIEWS)
    fit = 8 * (_TERMS * pixels + _SUMS * n)
    volume = 4 * _COPIES * math.prod(grid.shape) + fbp_memory(some, grid.shape[2])
    return fit + volume + 4 * (4 * some + 3 * min(n, _AT_ONCE)) * pixels + 16 * math.prod(geometry.detector_shape)


class _Views:
    """Line integrals [view, row, col] with their geometry, which are taken binned and finite, so many at a time."""

    def __init__(self, data: F32, geometry: Geometry, unknown: Mask | None) -> None:
        self.data, (rows, cols) = data, geometry.detector_shape
        self.factor = factor_within((rows, cols), _VOXELS)
        filled = np.zeros((1, rows, cols), np.float32) if unknown is None else unknown[None].astype(np.float32)
        self._measured = bin_views(filled, self.factor)[0] == 0
        self.geometry = geometry.binned(self.factor)

    def binned(self, numbers: NDArray[np.intp]) -> F32:
        return np.concatenate([bin_views(masked(self.data[k : k + 1])[0], self.factor) for k in numbers])

    def sums(self, sample: Mask, grid: Grid, numbers: NDArray[np.intp]) -> AirSums:
        """Sums over the rays of some views that miss the sample, which is a mask on a grid."""
        sums, volume = AirSums(self.data.shape[1:], self.factor), sample.astype(np.float32)
        for part in np.array_split(numbers, max(1, numbers.size // _AT_ONCE)):
            paths = Projector(self.geometry.select(part), grid).forward(volume)
            for view, path in zip(self.binned(part), paths, strict=True):
                sums.add(view, (path <= 0) & self._measured)
        return sums


def without_background(
    data: F32,
    geometry: Geometry,
    wanted: Surface,
    others: tuple[F32, Geometry] | None = None,
    unknown: Mask | None = None,
    levelled: float = 0.0,
) -> tuple[str, F64 | None]:
    """Take the background of the beam off views [view, row, col], in place.

    Returns what was done, in words (empty: nothing), and the terms of the mean surface that was taken off.

    Args:
        wanted: "auto": where the views confirm it; a number: polynomials of this order.
        others: further views and their geometry, which lose their background, too.
        unknown: bool [row, col], pixels that were not measured.
        levelled: line integral of the air at the edges that was taken off already, the mean of the views.

    Raises:
        DataError: polynomials were asked for, and too few rays miss the sample.
    """
    if wanted == "none":
        return "", None
    order = None if wanted == "auto" else wanted
    views = _Views(data, geometry, unknown)
    known = _see_all_sides(geometry) and not cut_sides(data, geometry)  # a sample that fills the field looks like air
    found, where = _found(views, order) if known else (None, None)
    if found is None or where is None:
        if order is None:
            return "", None
        raise DataError(
            "--air surface: too few rays miss the sample, so that no surface can be fitted. Give --air columns or none."
        )
    if order is None and not found.confirmed(noise_level(views.binned(_spread(len(data), _NOISE_VIEWS)))):
        return "", None
    before = ""
    if abs(levelled) >= LEAST_SIZE:
        before = f"a line through the air at the edges was taken off ({levelled:+.3f} of line integral); then "
    seen = (
        f"{before}the air of the views is a surface from {found.lowest:+.3f} to {found.highest:+.3f} of line integral, "
        f"by the {found.air:.0%} of the rays that miss the sample (order {found.order})"
    )
    # With the line, the views are brighter than their flats where matter would be: then it is the beam that changed.
    if order is None and found.may_be_matter and found.level + levelled > 0:
        return (
            f"Background of the beam: {seen}. It is positive, as weak matter all around the sample would be: the "
            f"surface is not taken off. If that is air, give --air surface:{found.order}."
        ), None
    if others is not None:
        more = _Views(*others, unknown)
        unseen = more.sums(*where, np.arange(len(more.data))).fit(found.order)
        if unseen is not None:
            unseen.remove(more.data)
    found.remove(data)
    said = (
        f"Background of the beam: {seen}; taken off. Air was {found.before:.2g} off nothing and is {found.after:.2g}."
    )
    return said, found.coefficients.mean(axis=0)


def _see_all_sides(geometry: Geometry) -> bool:
    """Views enough, and no wide gap between them: else a first volume does not show where the sample is."""
    angles = np.sort(np.mod(geometry.angles, geometry.period))
    gaps = np.diff(angles, append=angles[0] + geometry.period)
    return geometry.n_views >= _LEAST_VIEWS and bool(gaps.max() < _WIDEST_GAP)


def _found(views: _Views, order: int | None) -> tuple[Background | None, tuple[Mask, Grid]]:
    """The background of all views, by where a first volume of some of them has matter; and that."""
    n, geometry = len(views.data), views.geometry
    numbers = _spread(n, _VIEWS)
    some, grid = geometry.select(numbers), Grid.matching(geometry)
    _, y, x = grid.coordinates()
    away = np.hypot(y[:, None], x)
    measured = views.binned(numbers)
    found = None
    for last, rim in enumerate(_RIMS):
        levelled = measured.copy()
        if found is not None:
            found.remove(levelled, factor=views.factor)
        inside = away <= geometry.reach - rim * grid.voxel_size
        if not inside.any():  # a detector of a few columns
            return None, (np.zeros(grid.shape, np.bool_), grid)
        sample = matter(first_volume(levelled, some, grid).data, inside)
        found = views.sums(sample, grid, np.arange(n) if last else numbers).fit(order)
        if found is None:
            break
    return found, (sample, grid)


def _spread(n: int, most: int) -> NDArray[np.intp]:
    """At most so many of n views, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.intp))
