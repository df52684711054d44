"""Slabs: consecutive slices of a volume, with the detector rows and angles that show them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid

_ON_A_ROW = 1e-6  # rows
# px at the edge of the field of view: largest displacement by the skew within a band of slices. (With more bands, the
# setup work is repeated more often.)
_TURN = 0.25


@dataclass(frozen=True)
class Slab:
    """A slab and its halo.

    Attributes:
        own: slices that this slab contributes to the volume. slices: all slices that are reconstructed, which are `own`
            and the halo on both sides.
        fade: number of slices on either side of the border between two slabs over which one fades into the other.
    """

    own: slice
    slices: slice
    fade: int

    @property
    def share(self) -> NDArray[np.float32]:
        """[slice] weight of each reconstructed slice in the volume. At each slice, the weights of all slabs add up to
        1."""
        middles, width = np.arange(self.slices.start, self.slices.stop) + 0.5, max(2 * self.fade, 1)
        share = np.ones(middles.size)
        if self.slices.start < self.own.start:
            share *= np.clip((middles - self.own.start) / width + 0.5, 0, 1)
        if self.own.stop < self.slices.stop:
            share *= np.clip((self.own.stop - middles) / width + 0.5, 0, 1)
        return share.astype(np.float32)


def slabs_of(slices: int, height: int, halo: int) -> list[Slab]:
    """Slabs of `height` slices each (the last one may have fewer), with a halo towards neighbouring slabs."""
    parts = (slice(first, min(first + height, slices)) for first in range(0, slices, height))
    fade = min(halo, height) // 2
    return [Slab(own, slice(max(own.start - halo, 0), min(own.stop + halo, slices)), fade) for own in parts]


def part_of(geometry: Geometry, grid: Grid, slices: slice) -> tuple[slice, Geometry, Grid]:
    """The detector rows that show these slices of the whole volume, the geometry of these rows, and the grid of the
    slices.

    The beam must be parallel, without roll and tilt. Rows at the edge of a shifted projection also show slices outside
    this grid.
    """
    z = grid.coordinates()[0][slices] / geometry.pixel_pitch + geometry.axis_row
    shifts, last = geometry.shifts[:, 1], geometry.detector_shape[0] - 1
    first = min(max(math.floor(z.min() + shifts.min() + _ON_A_ROW), 0), last)
    end = min(max(math.ceil(z.max() + shifts.max() - _ON_A_ROW), first), last) + 1
    views = geometry.rows(first, end)
    moved = height_of(slice(first, end), geometry)
    middle = grid.centre[0] + ((slices.start + slices.stop) - grid.shape[0]) / 2 * grid.spacing[0]
    shape, centre = (slices.stop - slices.start, *grid.shape[1:]), (middle - moved, *grid.centre[1:])
    return slice(first, end), views, replace(grid, shape=shape, centre=centre)


def height_of(rows: slice, geometry: Geometry) -> float:
    """How far (mm) z = 0 of the geometry of these rows lies above that of the whole geometry."""
    return float(
        (rows.start + geometry.rows(rows.start, rows.stop).axis_row - geometry.axis_row) * geometry.pixel_pitch
    )


def bands_of(geometry: Geometry, grid: Grid) -> list[tuple[slice, Geometry]]:
    """Bands of slices whose rows have the same angle (within an eighth of a pixel), each with its geometry without the
    skew.

    Shifts along the axis are ignored.
    """
    nz = grid.shape[0]
    if not geometry.skew:
        return [(slice(0, nz), geometry)]
    rows = grid.coordinates()[0] / geometry.pixel_pitch + geometry.axis_row
    turned = abs(geometry.skew) * float(np.ptp(rows)) * geometry.reach / geometry.pixel_pitch
    edges = np.linspace(0, nz, min(nz, max(math.ceil(turned / _TURN), 1)) + 1).astype(int).tolist()
    parts = [slice(first, end) for first, end in pairwise(edges)]
    return [(part, geometry.at_row(float(rows[part].mean()))) for part in parts]


def slices_of(grid: Grid, slices: slice) -> Grid:
    """The grid of these slices, at their position in the grid of the whole volume."""
    off = ((slices.start + slices.stop) - grid.shape[0]) / 2 * grid.spacing[0]
    centre = (grid.centre[0] + off, *grid.centre[1:])
    return replace(
        grid, shape=(slices.stop - slices.start, *grid.shape[1:]), centre=centre, slice_pitch=grid.spacing[0]
    )  # fmt: skip
