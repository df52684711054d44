"""Region: a box of the volume at full resolution, from the detector rows that show it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.registry import geometry_steps
from beamline.projections.selection import Selection, cone_of, geometry_of, rows_of
from beamline.storage.readers.base import ScanSource
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume

Span = tuple[int, int]


@dataclass(frozen=True)
class Region:
    """Voxels first:end along z, y and x of the whole volume by the same options.

    Attributes:
        requested: somebody asked for this box, which is refused where it lies beyond the volume; else it was found, and
            what lies beyond is cut off.
        reason: a sentence on a box that was found.
    """

    z: Span
    y: Span
    x: Span
    requested: bool = True
    reason: str = ""

    @classmethod
    def parse(cls, text: str) -> Region:
        """Of `z0:z1,y0:y1,x0:x1`. ValueError for anything else."""
        spans = [(int(first), int(end)) for first, end in re.findall(r"(?:^|,)(\d+):(\d+)(?=,|$)", text)]
        if len(spans) != 3 or text.count(",") != 2 or any(first >= end for first, end in spans):
            raise ValueError(
                f"{text!r} is not Z0:Z1,Y0:Y1,X0:X1 with whole numbers, first < end, e.g. 40:80,100:300,0:90"
            )
        z, y, x = spans
        return cls(z, y, x)

    def __str__(self) -> str:
        return ",".join(f"{first}:{end}" for first, end in (self.z, self.y, self.x))


@dataclass(frozen=True)
class AroundSample:
    """Stands for the box around the sample, which `sample_box.box_around_sample` finds where the scan is read."""


@dataclass(frozen=True)
class RegionOfRows:
    """A region in the volume of the rows that are read for it.

    Attributes:
        region: in the whole volume.
        slices: the same slices (z, y, x) of the volume of these rows.
        z_offset: mm from z = 0 of all rows up to z = 0 of these rows.
    """

    region: Region
    slices: tuple[slice, slice, slice]
    z_offset: float

    def grid_of(self, grid: Grid) -> Grid:
        """The region's box in the frame of these rows, whose volume has this grid."""
        return grid.part(*self.slices)

    def cut(self, volume: Volume) -> Volume:
        """The region alone, in the frame of all rows, of the volume of these rows or of its own box."""
        grid, data = volume.grid, volume.data
        if grid.shape != tuple(part.stop - part.start for part in self.slices):
            grid, data = self.grid_of(grid), data[self.slices]
        z, y, x = grid.centre
        return Volume(data, replace(grid, centre=(z + self.z_offset, y, x)))


def selection_around(source: ScanSource, selection: Selection, region: Region, halo: int) -> Selection:
    """The rows of the selection that show the region, and so many slices beside it; the axis is that of all rows.

    Raises:
        ConfigError: a cone, or a region beyond the rows or the widest volume; options that may lean views or move them
            along the axis. `locate` refuses what only the views tell.
    """
    if cone_of(source, selection) is not None:
        raise ConfigError(f"--roi is for a parallel beam; {source.path} is a cone. Give --rows instead.")
    poses = stated_poses(source, selection)
    moving = [(step, term) for step in geometry_steps(selection) for term in ("roll", "tilt", "shifts")]
    given = [f"{step.asked_by} {term}" for step, term in moving if term in step.geometry]
    if poses is not None and (poses.shifts[:, 1].any() or poses.leans):
        given.append("--poses along the axis, or with roll, tilt or vectors")
    if given:
        raise ConfigError(
            f"--roi needs slices that are aligned with rows, and {' and '.join(given)} may misalign them. Give --rows "
            "instead of --roi, or leave that out. Nothing was read."
        )
    rows, side, (first, end) = rows_of(source, selection), selection.binning, region.z
    slices = (rows.stop - rows.start) // side
    if end > slices:
        raise ConfigError(f"--roi {region}: slices {first}:{end} do not lie in the volume's 0:{slices}.")
    if region.requested:
        _refuse_beyond(region, _widest(source, selection), "the widest volume's")
    low, high = max(first - halo, 0), min(end + halo, slices)
    near = rows.start + low * side, rows.start + high * side
    return replace(selection, rows=near, axis_rows=(rows.start, rows.stop))


def locate(region: Region, selection: Selection, geometry: Geometry) -> RegionOfRows:
    """Where the region lies in the volume of `geometry`, made from the selection of `selection_around`.

    Raises:
        ConfigError: it lies outside.
        DataError: the views are shifted along the axis, so that slices are not rows.
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
            "The views are shifted along the axis, rolled or tilted, but --roi needs slices aligned with rows. Give "
            "--rows."
        )
    _refuse_beyond(region, grid.shape[2], "the volume's")
    part = slice(region.z[0] - low, region.z[1] - low), slice(*region.y), slice(*region.x)
    return RegionOfRows(region, part, ((low + high) - slices) / 2 * geometry.sample_pitch)


def _refuse_beyond(region: Region, width: int, whose: str) -> None:
    """Raises ConfigError for voxels beyond a volume so many voxels wide."""
    for name, (first, end) in (("y", region.y), ("x", region.x)):
        if end > width:
            raise ConfigError(f"--roi {region}: {name} {first}:{end} does not lie in {whose} 0:{width}.")


def _widest(source: ScanSource, selection: Selection) -> int:
    """Largest width of the volume in voxels, before anything is read.

    An axis that is still to be found may stand at an edge of the detector, and so may that of a sample that jumped.
    """
    flags = source.flags
    moved = selection.step(Preparation).judged or (flags is not None and bool(flags.flagged.any()))
    if selection.axis_col is None or moved:
        return 2 * (source.shape[1] // selection.binning)
    return Grid.matching(geometry_of(source, selection, selection.axis_col, np.zeros(1))).shape[2]
