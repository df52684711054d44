"""Slabs: consecutive slices of a volume, and the rows and angles of the views that show them."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid

_ON_A_ROW = 1e-6  # rows
_TURN = 0.25  # px at the edge of the field that a skew may turn a band of slices; each band costs its samples anew


@dataclass(frozen=True)
class Slab:
    """A slab and its halo.

    Attributes:
        own: slices of the volume that this slab gives.
        slices: these and the halo beside them, which are reconstructed.
        fade: slices on either side of the edge between two slabs, over which one fades into the other.
    """

    own: slice
    slices: slice
    fade: int

    @property
    def share(self) -> NDArray[np.float32]:
        """[slice]: weight of each reconstructed slice in the volume; the weights of all slabs add up to 1."""
        at, width = np.arange(self.slices.start, self.slices.stop) + 0.5, max(2 * self.fade, 1)
        share = np.ones(at.size)
        if self.slices.start < self.own.start:
            share *= np.clip((at - self.own.start) / width + 0.5, 0, 1)
        if self.own.stop < self.slices.stop:
            share *= np.clip((self.own.stop - at) / width + 0.5, 0, 1)
        return share.astype(np.float32)


def slabs_of(slices: int, height: int, halo: int) -> list[Slab]:
    """Slabs of `height` slices each (the last may have fewer), with a halo towards further slices."""
    parts = (slice(first, min(first + height, slices)) for first in range(0, slices, height))
    fade = min(halo, height) // 2
    return [Slab(own, slice(max(own.start - halo, 0), min(own.stop + halo, slices)), fade) for own in parts]


def part_of(geometry: Geometry, grid: Grid, slices: slice) -> tuple[slice, Geometry, Grid]:
    """The detector rows that show these slices of the whole volume, their geometry, and the slices' grid in it.

    For a parallel beam, straight. Shifted views also see slices outside this grid at the edges of the rows.
    """
    z = grid.coordinates()[0][slices] / geometry.pixel_pitch + geometry.axis_row
    shifts, last = geometry.shifts[:, 1], geometry.detector_shape[0] - 1
    first = min(max(math.floor(z.min() + shifts.min() + _ON_A_ROW), 0), last)
    end = min(max(math.ceil(z.max() + shifts.max() - _ON_A_ROW), first), last) + 1
    views = geometry.rows(first, end)
    moved = (first + views.axis_row - geometry.axis_row) * geometry.pixel_pitch
    middle = grid.centre[0] + ((slices.start + slices.stop) - grid.shape[0]) / 2 * grid.spacing[0]
    shape, centre = (slices.stop - slices.start, *grid.shape[1:]), (middle - moved, *grid.centre[1:])
    return slice(first, end), views, replace(grid, shape=shape, centre=centre)


def bands_of(geometry: Geometry, grid: Grid) -> list[tuple[slice, Geometry]]:
    """Slices of the grid whose rows see one angle, to an eighth of a pixel, with their views without skew.

    Views that are shifted along the axis count as unshifted.
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
    """The grid of these slices, at their place in the whole grid."""
    off = ((slices.start + slices.stop) - grid.shape[0]) / 2 * grid.spacing[0]
    centre = (grid.centre[0] + off, *grid.centre[1:])
    return replace(
        grid, shape=(slices.stop - slices.start, *grid.shape[1:]), centre=centre, slice_pitch=grid.spacing[0]
    )  # fmt: skip
