"""The box around the sample, for `--roi auto`: by what a few coarse views show, with a margin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.errors import ConfigError, DataError
from beamline.projections.prepare import prepare_projections
from beamline.projections.registry import geometry_steps
from beamline.projections.selection import Selection, cone_of, geometry_of, rows_of
from beamline.projections.truncation import cut_sides
from beamline.reconstruct.region import Region, Span
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, Mask
from recon.base.geometry import Geometry
from recon.base.volume import Grid

_VIEWS = 72  # looked at, or up to twice as many
_COLUMNS = 192  # that they are binned to, or up to twice as many
_EDGE = 0.04  # share of the columns, on either side, that show air
_NOISE, _SHARE = 6.0, 0.01  # deviations of the air's pixels, and share of the deepest line integrals: less is air
_DEEPEST = 99.5  # percentile of the line integrals
_SEEN = 0.2  # share of the views that show matter in a row with matter
_WITHIN = 0.9  # share of the views in whose shadow a voxel of the sample lies; all, but for noise
_BANDS = 24  # of rows, whose shadows are taken together
_MARGIN, _COARSE = 0.04, 2  # of the volume's side; coarse voxels


def box_around_sample(source: ScanSource, selection: Selection) -> Region:
    """The box around all that absorbs, in voxels of the volume by this selection, with the sentence that says it.

    A voxel may be of the sample where it lies in the shadow, from the first to the last pixel with matter, of nine
    tenths of the views (the visual hull of Laurentini 1994, of the convex shadows). Views are 72, binned. Where the
    sample goes on beyond the field the box is the whole volume, and the sentence says why.

    Raises:
        ConfigError: a cone. DataError: no view shows matter.
    """
    if cone_of(source, selection) is not None:
        raise ConfigError(f"--roi auto is for a parallel beam; {source.path} is a cone. Give --rows instead.")
    rows, side = rows_of(source, selection), selection.binning
    height, width = (rows.stop - rows.start) // side, source.shape[1] // side
    coarse = max(1, min(width // _COLUMNS, height))
    every = max(1, int((source.image_key == FrameKind.PROJECTION).sum()) // _VIEWS)
    views = f"every:{every}" if selection.views == "all" else selection.views
    unlearnt = (type(step)() for step in geometry_steps(selection))
    look = replace(selection, views=views, binning=side * coarse).with_steps(*unlearnt)
    prepared = prepare_projections(source, look, lambda warning: None)  # they come again, of the views used
    data, geometry = prepared.projections.data, prepared.geometry
    grid = Grid.matching(geometry_of(source, selection, prepared.axis_col, geometry.angles))
    across = grid.shape[2]
    # Edges of matter do not show the air, from which matter in any row would rise.
    if cut := cut_sides(data, geometry):
        where = " and the ".join(cut)
        return _whole(height, across, f"the sample goes on beyond the field at the {where}, where it shows no edge")
    smooth = ndimage.uniform_filter(data, (1, min(3, data.shape[1]), 3))
    least = _least(smooth)
    matter = np.asarray(smooth > least)  # [view, row, col]
    there = np.flatnonzero(matter.any(axis=2).mean(axis=0) >= _SEEN)
    if not there.size:
        raise DataError(
            f"{source.path}: --roi auto finds no matter that rises from the noise in {len(data)} views. Give the box, "
            "or leave it out. Nothing was written."
        )
    hull = _hull(matter[:, there], geometry, grid, coarse)
    if not hull.any():
        return _whole(height, across, "the views do not agree where the sample is")
    z = _widened(_extent(there, coarse), height, coarse)
    y, x = (_widened(_extent(np.flatnonzero(hull.any(axis=axis)), coarse), across, coarse) for axis in (1, 0))
    region = Region(z, y, x, requested=False)
    share = np.prod([end - first for first, end in (z, y, x)]) / (height * across**2)
    return replace(
        region,
        reason=f"The sample lies in voxels {region} [z, y, x] of {height} x {across} x {across}, with a margin: "
        f"{share:.0%} of the volume is made. Line integrals below {least:.2g} were taken for air.",
    )


def _whole(height: int, across: int, why: str) -> Region:
    reason = f"--roi auto makes the whole volume: {why}."
    return Region((0, height), (0, across), (0, across), requested=False, reason=reason)


def _least(data: F32) -> float:
    """Line integral, of means of nine pixels, that rises from those of air at the edges."""
    cols = max(2, round(_EDGE * data.shape[2]))
    edges = np.stack([data[..., :cols], data[..., -cols:]])
    air = np.median(edges)
    noise = 1.4826 * float(np.median(np.abs(edges - air)))
    return float(air + max(_NOISE * noise, _SHARE * float(np.percentile(data, _DEEPEST))))


def _hull(matter: Mask, geometry: Geometry, grid: Grid, coarse: int) -> Mask:
    """[y, x] coarse voxels of the grid that are in the shadow of most views, in some band of rows."""
    cols = np.arange(matter.shape[2])
    n = -(-grid.shape[2] // coarse)
    at = (grid.coordinates()[2][0] / grid.voxel_size + (coarse - 1) / 2 + coarse * np.arange(n)) / coarse
    found = np.zeros((n, n), np.bool_)
    for band in np.array_split(np.arange(matter.shape[1]), min(_BANDS, matter.shape[1])):
        shadow = matter[:, band].any(axis=1)
        first = np.where(shadow, cols, cols.size).min(axis=1)
        last = np.where(shadow, cols, -1).max(axis=1)
        # A shadow at the edge may go on beyond it; a view without any does not say where the sample is.
        unknown = last < 0
        low = np.where((first <= 1) | unknown, -np.inf, first - 1 - geometry.axis_col)
        high = np.where((last >= cols.size - 2) | unknown, np.inf, last + 1 - geometry.axis_col)
        within = np.zeros((n, n), np.int32)
        for angle, left, right in zip(geometry.angles.tolist(), low.tolist(), high.tolist(), strict=True):
            across = np.cos(angle) * at[None, :] + np.sin(angle) * at[:, None]
            within += (across >= left) & (across <= right)
        found |= within >= _WITHIN * len(low)
    return found


def _extent(at: NDArray[np.intp], coarse: int) -> Span:
    """Fine voxels from the first to the last of these coarse ones."""
    return int(at[0]) * coarse, (int(at[-1]) + 1) * coarse


def _widened(span: Span, n: int, coarse: int) -> Span:
    margin = round(_MARGIN * n) + _COARSE * coarse
    return max(0, span[0] - margin), min(n, span[1] + margin)
