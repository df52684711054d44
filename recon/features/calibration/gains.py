"""Gains of pixels, learnt with the volume: a constant of each pixel in all views, which makes a ring.

A few sweeps of FISTA-TV and the median of the residual over the views alternate, see `ring_offsets`. Total variation
keeps rings out of the volume, and bodies in it. Without stripes, see `recon.base.stripes`, nothing is learnt:
what few sweeps leave at edges would count as gains. Three sorts of gain stay in the views. A gain near the axis looks
like a body on the axis. What pixels on both sides of the axis have in common looks like the wall of a can. A slow
change along a row looks like density.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64, Mask
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.stripes import AT_AXIS, NARROWEST, ring_offsets, steadiness
from recon.base.view_data import split_views
from recon.base.volume import Grid, Volume
from recon.voxels.choice import exceeds_standard_error
from recon.voxels.field_edges import busiest_rows
from recon.voxels.iterative import solve
from recon.voxels.methods import EarlyTv
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import Buffers, bytes_of

LEAST_VIEWS, LEAST_COLS = 40, NARROWEST
NEAR_AXIS = AT_AXIS

_BAND, _HALO = 16, 4  # rows at a time; rows beside them that tell a stripe of all rows
_ONE_IN = 6  # views held out
_TV_WEIGHT = 1e-3  # three times as much takes a sixth of a ball on the axis
_FIRST, _SWEEPS, _ROUNDS = 8, 4, 4
_BETTER, _SURE = 0.99, 3.0  # share of the mean square of views held out to be reached; see `exceeds_standard_error`
_LOOKED_AT = 8  # rows
_BUFFERS = Buffers(8.5, 7.0, 5.0)


@dataclass(frozen=True, eq=False)
class LearntGains:
    """Gains of all pixels, as offsets of line integrals.

    Attributes:
        pixels: float32 [row, col]; 0 where the views held out do not confirm them.
        without, left: root mean square that volumes leave of views held out, in the rows with most matter; 0 where no
            stripes were seen, so that nothing was learnt.
        confirmed: by the views held out.
    """

    pixels: F32
    without: float
    left: float
    confirmed: bool


def learn_gains(
    projections: F32,
    geometry: Geometry,
    measured: Mask | None = None,
    progress: Callable[[int, int], object] = lambda n, of: None,
) -> LearntGains:
    """Find the gains of the pixels, as far as held-out views confirm them; see `gains_memory`.

    Rows of a parallel beam are taken in bands of 16; those with most matter come first, and judge. The time is that of
    FISTA-TV with its weight given, and 24 sweeps.

    Args:
        projections: line integrals [view, row, col], finite.
        measured: bool [row, col]; None: all pixels.
        progress: takes bands done and bands in all; what it raises ends the search.

    Raises:
        ValueError: fewer than 40 views or 64 columns.
    """
    (rows, cols), n = geometry.detector_shape, geometry.n_views
    if n < LEAST_VIEWS or cols < LEAST_COLS:
        raise ValueError(f"{n} views of {cols} columns are too few; {LEAST_VIEWS} of {LEAST_COLS} are needed")
    seen, unseen = split_views(geometry, _ONE_IN)
    gains, height = np.zeros((rows, cols), np.float32), _height(geometry)
    busiest = busiest_rows(projections, height).start
    if not _stripes_seen(projections[:, busiest : busiest + height], geometry):
        return LearntGains(gains, 0.0, 0.0, False)
    lowest = busiest % height - height * (busiest % height > 0)
    starts = sorted(range(lowest, rows, height), key=lambda at: at != busiest)
    without = left = np.zeros(1)
    for done, start in enumerate(starts):
        progress(done, len(starts))
        inner = slice(max(start, 0), min(start + height, rows))
        outer = slice(max(inner.start - _HALO, 0), min(inner.stop + _HALO, rows))
        band = _Band.of(projections, geometry, outer, measured)
        volume, pixels = band.learn(seen)
        own = slice(inner.start - outer.start, inner.stop - outer.start)
        gains[inner] = pixels[own]
        if done == 0:
            plain, _ = band.learn(seen, gains=False)
            none = np.zeros_like(pixels)
            without, left = band.errors(plain, none, unseen, own), band.errors(volume, pixels, unseen, own)
            if not (exceeds_standard_error(without - left, _SURE) and left.mean() < _BETTER * without.mean()):
                return LearntGains(np.zeros_like(gains), _root(without), _root(left), False)
    return LearntGains(gains, _root(without), _root(left), True)


def gains_memory(geometry: Geometry) -> int:
    """Approximate peak memory of `learn_gains` in bytes, without the views."""
    rows, cols = geometry.detector_shape
    outer = min(_height(geometry) + 2 * _HALO, rows)
    band = geometry if outer == rows else geometry.rows(0, outer)
    return bytes_of(_BUFFERS, band, Grid.matching(band)) + 8 * rows * cols


def _stripes_seen(projections: F32, geometry: Geometry) -> bool:
    """Whether pixels of some rows [view, row, col] answer unequally, as far as the sample lets it be seen."""
    views = np.argsort(geometry.angles, kind="stable")
    rows = np.arange(0, projections.shape[1], max(1, projections.shape[1] // _LOOKED_AT))
    steady = steadiness(projections[np.ix_(views, rows)], geometry.axis_col)
    return steady is None or steady.stripes


def _height(geometry: Geometry) -> int:
    """Rows at a time: all, where rows do not see the same slice in all views."""
    rows = geometry.detector_shape[0]
    return min(_BAND, rows) if geometry.rows_show_slices else rows


def _root(squares: F64) -> float:
    return float(np.sqrt(squares.mean()))


@dataclass(frozen=True, eq=False)
class _Band:
    """Views [view, row, col] of some rows; `known` bool [row, col], None: all."""

    data: F32
    geometry: Geometry
    known: Mask | None

    @classmethod
    def of(cls, projections: F32, geometry: Geometry, rows: slice, measured: Mask | None) -> _Band:
        whole = rows.stop - rows.start == geometry.detector_shape[0]
        known = None if measured is None or measured[rows].all() else measured[rows]
        views = geometry if whole else geometry.rows(rows.start, rows.stop)
        return cls(np.ascontiguousarray(projections[:, rows]), views, known)

    def learn(self, seen: NDArray[np.intp], gains: bool = True) -> tuple[Volume, F32]:
        """The volume of some views, and the gains [row, col] that it leaves."""
        views = self.geometry.select(seen)
        projector = Projector(views, Grid.matching(self.geometry))
        weight = None if self.known is None else np.broadcast_to(self.known, projector.projection_shape).astype("f4")
        decide, gains_so_far, volume = Decisions(), np.zeros(self.data.shape[1:], np.float32), None
        data = self.data[seen]
        for at in range(_ROUNDS):
            method = EarlyTv(_SWEEPS if at else _FIRST, _TV_WEIGHT)
            volume = solve(method, projector, data, weight=weight, start=volume, decide=decide)
            if gains and at + 1 < _ROUNDS:
                left = ring_offsets(data - projector.forward(volume.data), views) * self._told_apart()
                data -= left
                gains_so_far += left
        assert volume is not None
        return volume, gains_so_far

    def errors(self, volume: Volume, gains: F32, unseen: NDArray[np.intp], rows: slice) -> F64:
        """[view] mean square residual of views held out, by volume and gains, in some rows."""
        left = self.data[unseen] - gains - Projector(self.geometry.select(unseen), volume.grid).forward(volume.data)
        known = None if self.known is None else np.broadcast_to(self.known, left.shape)[:, rows]
        return np.asarray(np.average(np.square(left[:, rows], dtype=np.float64), axis=(1, 2), weights=known))

    def _told_apart(self) -> F32:
        """Weights [col]: 1 where a gain cannot be mistaken for a body on the axis, which stays in a column."""
        off = np.abs(np.arange(self.data.shape[2]) - self.geometry.axis_col)
        still = np.ptp(self.geometry.shifts[:, 0]) < 2 * NEAR_AXIS
        return np.asarray((off > NEAR_AXIS) | (not still), np.float32)
