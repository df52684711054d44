"""Region: reconstructs a box of the volume from the detector rows that show it, and finds the box around the sample."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.errors import ConfigError, DataError
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.preparation import Preparation
from beamline.projections.prepare import prepare_projections
from beamline.projections.registry import geometry_steps
from beamline.projections.selection import SelectedScan, Selection
from recon.base.arrays import F32, Mask
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.beyond_field import reach_of

Span = tuple[int, int]


@dataclass(frozen=True)
class Region:
    """A box of voxels, first:end along z, y and x. The numbers are those of the whole volume made with the same
    options.

    Attributes:
        requested: True if the user gave this box; a box that extends beyond the volume is then an error. False if the
            box was found; it is then clipped to the volume.
        reason: a sentence that says how the box was found.
    """

    z: Span
    y: Span
    x: Span
    requested: bool = True
    reason: str = ""

    @classmethod
    def parse(cls, text: str) -> Region:
        """Parse `z0:z1,y0:y1,x0:x1`. Raises ValueError for any other text."""
        spans = [(int(first), int(end)) for first, end in re.findall(r"(?:^|,)(\d+):(\d+)(?=,|$)", text)]
        if len(spans) != 3 or text.count(",") != 2 or any(first >= end for first, end in spans):
            raise ValueError(
                f"{text!r} is not Z0:Z1,Y0:Y1,X0:X1 with whole numbers and first < end, for example 40:80,100:300,0:90"
            )
        z, y, x = spans
        return cls(z, y, x)

    def __str__(self) -> str:
        return ",".join(f"{first}:{end}" for first, end in (self.z, self.y, self.x))


@dataclass(frozen=True)
class AroundSample:
    """A placeholder for the box around the sample, which `box_around_sample` finds when the scan is read."""


@dataclass(frozen=True)
class RegionOfRows:
    """A region, and its place in the volume of the detector rows that are read for it.

    Attributes:
        region: the region in the whole volume.
        slices: the region as slices (z, y, x) of the volume of these rows.
        z_offset: height in mm of z = 0 of these rows above z = 0 of all rows.
    """

    region: Region
    slices: tuple[slice, slice, slice]
    z_offset: float

    def grid_of(self, grid: Grid) -> Grid:
        """The region's box on the grid of the volume of these rows."""
        return grid.part(*self.slices)

    def cut(self, volume: Volume) -> Volume:
        """Crop a volume of these rows to the region. A volume that already has the box of the region is not cropped. In
        both cases z refers to all rows.
        """
        grid, data = volume.grid, volume.data
        if grid.shape != tuple(part.stop - part.start for part in self.slices):
            grid, data = self.grid_of(grid), data[self.slices]
        z, y, x = grid.centre
        return Volume(data, replace(grid, centre=(z + self.z_offset, y, x)))


def rows_around(scan: SelectedScan, region: Region, halo: int) -> SelectedScan:
    """The scan with only the rows that show the region and a margin of `halo` slices. The axis is that of the scan with
    all rows.

    Raises:
        ConfigError: the beam is a cone, the region extends beyond the rows or beyond the widest volume, or options may
            tilt projections or move them along the axis. `locate` raises the errors that can be found only in the
            projections.
    """
    selection = scan.selection
    if selection.cone is not None:
        raise ConfigError(
            f"--roi works only with a parallel beam, but {scan.source.path} is a cone-beam scan. Use --rows instead."
        )
    poses = stated_poses(scan)
    moving = [(step, term) for step in geometry_steps(selection) for term in ("roll", "tilt", "shifts")]
    obstacles = [f"{step.requested_by} {term}" for step, term in moving if term in step.geometry]
    if poses is not None and (poses.shifts[:, 1].any() or poses.leans):
        obstacles.append("--poses along the axis, or with roll, tilt or vectors")
    if obstacles:
        options_in_the_way = " and ".join(obstacles)
        raise ConfigError(
            f"--roi needs slices that are aligned with rows, and {options_in_the_way} may misalign them. Use "
            f"--rows instead of --roi, or leave out {options_in_the_way}. Nothing was read."
        )
    rows, side, (first, end) = selection.detector_rows, selection.binning, region.z
    slices = (rows.stop - rows.start) // side
    if end > slices:
        raise ConfigError(f"--roi {region}: slices {first}:{end} are out of range: the volume has slices 0:{slices}.")
    if region.requested:
        _refuse_beyond(region, _widest(scan), "the widest volume's")
    low, high = max(first - halo, 0), min(end + halo, slices)
    near = rows.start + low * side, rows.start + high * side
    return scan.selecting(replace(selection.asked, rows=near, axis_rows=(rows.start, rows.stop)))


def locate(region: Region, selection: Selection, geometry: Geometry) -> RegionOfRows:
    """The position of the region in the volume of `geometry`, the geometry of the rows from `rows_around`.

    Raises:
        ConfigError: the region lies outside the volume.
        DataError: the projections are shifted along the axis, so that slices are not detector rows.
    """
    assert selection.rows is not None and selection.axis_rows is not None
    grid, side = Grid.matching(geometry), selection.binning
    if not region.requested:
        n = grid.shape[2]
        region = replace(region, y=(region.y[0], min(region.y[1], n)), x=(region.x[0], min(region.x[1], n)))
    low, high = ((row - selection.axis_rows[0]) // side for row in selection.rows)
    slices = (selection.axis_rows[1] - selection.axis_rows[0]) // side
    if not geometry.rows_show_slices:
        raise DataError(
            "The projections are shifted along the axis, rolled or tilted, but --roi needs slices that are "
            "aligned with rows. Use --rows instead."
        )
    _refuse_beyond(region, grid.shape[2], "the volume's")
    part = slice(region.z[0] - low, region.z[1] - low), slice(*region.y), slice(*region.x)
    return RegionOfRows(region, part, ((low + high) - slices) / 2 * geometry.sample_pitch)


def _refuse_beyond(region: Region, width: int, whose: str) -> None:
    """Raise ConfigError if the region extends beyond a volume that is `width` voxels wide."""
    for name, (first, end) in (("y", region.y), ("x", region.x)):
        if end > width:
            raise ConfigError(f"--roi {region}: {name} {first}:{end} does not lie within {whose} range 0:{width}.")


def _widest(scan: SelectedScan) -> int:
    """Largest width that the volume can have, in voxels, before anything is read. If the axis must still be found, or
    the sample jumped, the axis may lie at an edge of the detector.
    """
    source, selection, flags = scan.source, scan.selection, scan.source.table.flags
    moved = selection.step(Preparation).judged or (flags is not None and bool(flags.flagged.any()))
    if selection.axis_col is None or moved:
        return 2 * (source.shape[1] // selection.binning)
    return Grid.matching(selection.geometry(selection.axis_col, np.zeros(1))).shape[2]


_VIEWS = 72  # number of projections that are used, or up to twice as many
_COLUMNS = 192  # number of columns to which they are binned, or up to twice as many
_EDGE = 0.04  # share of the columns, on either side, that are taken as air
# limits below which a line integral is air: in standard deviations of the air; as a share of the deepest line integrals
_NOISE, _SHARE = 6.0, 0.01
_DEEPEST = 99.5  # percentile of the line integrals that counts as the deepest
_SEEN = 0.2  # share of the views that must show material in a row with material
_WITHIN = 0.9  # share of the views in whose shadow a voxel of the sample must lie; not 1, because of noise
_BANDS = 24  # number of bands of rows; the shadows of the rows of a band are joined
_MARGIN, _COARSE = 0.04, 2  # margin as a share of the volume's side; margin in coarse voxels


def box_around_sample(scan: SelectedScan) -> Region:
    """The box around everything that absorbs, in voxels of the volume of this selection, and a sentence that reports
    it.

    In each projection, the shadow of the sample reaches from the first to the last pixel with material. A voxel may
    belong to the sample if it lies in this shadow in nine tenths of the projections (the visual hull of Laurentini
    1994, of the convex shadows). 72 binned projections are used. If the sample extends beyond the field of view, the
    box is the whole volume, and the sentence states the reason.

    Raises:
        ConfigError: the scan has a cone beam.
        DataError: no projection shows a sample.
    """
    source, selection = scan.source, scan.selection
    if selection.cone is not None:
        raise ConfigError(
            f"--roi auto works only with a parallel beam, but {source.path} is a cone-beam scan. Use --rows instead."
        )
    rows, side = selection.detector_rows, selection.binning
    height, width = (rows.stop - rows.start) // side, source.shape[1] // side
    coarse = max(1, min(width // _COLUMNS, height))
    stride = max(1, source.table.views.size // _VIEWS)
    views = f"every:{stride}" if selection.views == "all" else selection.views
    unlearnt = (type(step)() for step in geometry_steps(selection))
    look = scan.selecting(replace(selection.asked, views=views, binning=side * coarse).with_steps(*unlearnt))
    # the same warnings are given again when the projections are prepared for the volume
    prepared = prepare_projections(look, lambda warning: None)
    data, geometry = prepared.seen.data, prepared.geometry
    grid = Grid.matching(selection.geometry(prepared.origin.axis_col, geometry.angles))
    across = grid.shape[2]
    # If material extends to the edges, they do not show air. The limit for air would then be too high in all rows.
    if cut := reach_of(prepared.seen).beyond:
        where = " and the ".join(cut)
        return _uncut(
            height,
            across,
            f"the sample extends beyond the field of view at the {where}, so the sample has no edge there",
        )
    smooth = ndimage.uniform_filter(data, (1, min(3, data.shape[1]), 3))
    least = _least(smooth)
    material = np.asarray(smooth > least)  # [view, row, col]
    rows_with_material = np.flatnonzero(material.any(axis=2).mean(axis=0) >= _SEEN)
    if not rows_with_material.size:
        raise DataError(
            f"{source.path}: --roi auto finds no sample above the noise in {len(data)} projections. Give the box as "
            "numbers, or leave out --roi. Nothing was written."
        )
    hull = _hull(material[:, rows_with_material], geometry, grid, coarse)
    if not hull.any():
        return _uncut(height, across, "the projections do not agree about the position of the sample")
    z = _widened(_extent(rows_with_material, coarse), height, coarse)
    y, x = (_widened(_extent(np.flatnonzero(hull.any(axis=axis)), coarse), across, coarse) for axis in (1, 0))
    region = Region(z, y, x, requested=False)
    share = np.prod([end - first for first, end in (z, y, x)]) / (height * across**2)
    return replace(
        region,
        reason=f"The sample, with a margin, is in the voxels {region} [z, y, x] of {height} x {across} x {across}. "
        f"Only this part ({share:.0%}) of the volume is reconstructed. Line integrals below {least:.2g} count as air.",
    )


def _uncut(height: int, across: int, why: str) -> Region:
    reason = f"--roi auto reconstructs the whole volume, because {why}."
    return Region((0, height), (0, across), (0, across), requested=False, reason=reason)


def _least(data: F32) -> float:
    """Line integral above which the mean of nine pixels counts as material. It follows from the line integrals of the
    air at the edges.
    """
    cols = max(2, round(_EDGE * data.shape[2]))
    edges = np.stack([data[..., :cols], data[..., -cols:]])
    air = np.median(edges)
    noise = 1.4826 * float(np.median(np.abs(edges - air)))
    return float(air + max(_NOISE * noise, _SHARE * float(np.percentile(data, _DEEPEST))))


def _hull(material: Mask, geometry: Geometry, grid: Grid, coarse: int) -> Mask:
    """[y, x], True for coarse voxels of the grid that lie in the shadow of most views in at least one band of rows."""
    cols = np.arange(material.shape[2])
    n = -(-grid.shape[2] // coarse)
    positions = (grid.coordinates()[2][0] / grid.voxel_size + (coarse - 1) / 2 + coarse * np.arange(n)) / coarse
    inside_hull = np.zeros((n, n), np.bool_)
    for band in np.array_split(np.arange(material.shape[1]), min(_BANDS, material.shape[1])):
        shadow = material[:, band].any(axis=1)
        first = np.where(shadow, cols, cols.size).min(axis=1)
        last = np.where(shadow, cols, -1).max(axis=1)
        # A shadow at the edge may continue beyond it. A view without a shadow does not show the position of the sample.
        is_empty = last < 0
        low = np.where((first <= 1) | is_empty, -np.inf, first - 1 - geometry.axis_col)
        high = np.where((last >= cols.size - 2) | is_empty, np.inf, last + 1 - geometry.axis_col)
        within = np.zeros((n, n), np.int32)
        for angle, left, right in zip(geometry.angles.tolist(), low.tolist(), high.tolist(), strict=True):
            across = np.cos(angle) * positions[None, :] + np.sin(angle) * positions[:, None]
            within += (across >= left) & (across <= right)
        inside_hull |= within >= _WITHIN * len(low)
    return inside_hull


def _extent(positions: NDArray[np.intp], coarse: int) -> Span:
    """The range of fine voxels from the first to the last of these coarse voxels."""
    return int(positions[0]) * coarse, (int(positions[-1]) + 1) * coarse


def _widened(span: Span, n: int, coarse: int) -> Span:
    margin = round(_MARGIN * n) + _COARSE * coarse
    return max(0, span[0] - margin), min(n, span[1] + margin)
