"""Pixel sensitivities (gains), measured together with the volume. A wrong sensitivity makes a ring.

A gain is a constant offset of a pixel's line integrals in all projections. The measurement alternates between two
steps: a few iterations of FISTA-TV, and the median of the residual over the projections, see `ring_offsets`. Total
variation removes rings from the volume and keeps bodies. If the projections have no stripes (`recon.base.stripes`),
nothing is measured, because edges leave a residual after a few iterations, which would count as gains. Three kinds of
gain are not removed. A gain near the axis looks like a body on the axis. A gain that pixels on both sides of the axis
share looks like the wall of a can. A slow change along a row looks like density.
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

# number of rows processed together; number of additional rows on each side, which show whether a stripe is in all rows
_BAND, _HALO = 16, 4
_ONE_IN = 6  # one in this many projections is held out
_TV_WEIGHT = 1e-3  # with three times this weight, a sixth of a ball on the axis would be removed
_FIRST_SWEEPS, _SWEEPS, _ROUNDS = 8, 4, 4
# the mean square in held-out projections must fall to this share; see `exceeds_standard_error`
_LARGEST_SQUARES_RATIO, _STANDARD_ERRORS = 0.99, 3.0
_EXAMINED_ROWS = 8  # number of rows that are examined
_BUFFERS = Buffers(8.5, 7.0, 5.0)


@dataclass(frozen=True, eq=False)
class LearntGains:
    """Sensitivities of all pixels, as offsets of line integrals.

    Attributes:
        pixels: float32 [row, col]; 0 if held-out projections do not confirm them.
        without, with_gains: root mean square residual in held-out projections, without the gains and with them, in the
            rows with most material. Both are 0 if no stripes were found, because nothing was measured then.
        confirmed: True if held-out projections confirm the gains.
    """

    pixels: F32
    without: float
    with_gains: float
    confirmed: bool


def learn_gains(
    projections: F32,
    geometry: Geometry,
    measured: Mask | None = None,
    progress: Callable[[int, int], object] = lambda n, total: None,
) -> LearntGains:
    """Measure the pixel sensitivities, and keep those that held-out projections confirm. For the memory, see
    `gains_memory`.

    Rows of a parallel beam are processed in bands of 16. The bands with most material are processed first, and decide
    whether the gains are confirmed. The computation takes as long as FISTA-TV with a given weight, plus 24 iterations.

    Args:
        projections: line integrals [view, row, col], finite.
        measured: bool [row, col]; None: all pixels.
        progress: function called with the number of bands done and of all bands. An exception that it raises ends the
            measurement.

    Raises:
        ValueError: there are fewer than 40 projections or 64 columns.
    """
    (rows, cols), n = geometry.detector_shape, geometry.n_views
    if n < LEAST_VIEWS or cols < LEAST_COLS:
        raise ValueError(
            f"too few data to measure pixel sensitivities: {n} projections of {cols} columns; at least {LEAST_VIEWS} "
            f"projections of {LEAST_COLS} columns are needed"
        )
    fitted, unseen = split_views(geometry, _ONE_IN)
    gains, height = np.zeros((rows, cols), np.float32), _height(geometry)
    busiest = busiest_rows(projections, height).start
    if not _stripes_seen(projections[:, busiest : busiest + height], geometry):
        return LearntGains(gains, 0.0, 0.0, False)
    lowest = busiest % height - height * (busiest % height > 0)
    first_rows = sorted(range(lowest, rows, height), key=lambda start: start != busiest)
    errors_without = errors_with = np.zeros(1)
    for done, start in enumerate(first_rows):
        progress(done, len(first_rows))
        inner = slice(max(start, 0), min(start + height, rows))
        outer = slice(max(inner.start - _HALO, 0), min(inner.stop + _HALO, rows))
        band = _Band.of(projections, geometry, outer, measured)
        volume, pixels = band.learn(fitted)
        own = slice(inner.start - outer.start, inner.stop - outer.start)
        gains[inner] = pixels[own]
        if done == 0:
            volume_without, _ = band.learn(fitted, with_gains=False)
            no_gains = np.zeros_like(pixels)
            errors_without = band.errors(volume_without, no_gains, unseen, own)
            errors_with = band.errors(volume, pixels, unseen, own)
            if not (
                exceeds_standard_error(errors_without - errors_with, _STANDARD_ERRORS)
                and errors_with.mean() < _LARGEST_SQUARES_RATIO * errors_without.mean()
            ):
                return LearntGains(np.zeros_like(gains), _root(errors_without), _root(errors_with), False)
    return LearntGains(gains, _root(errors_without), _root(errors_with), True)


def gains_memory(geometry: Geometry) -> int:
    """Approximate peak memory of `learn_gains` in bytes, without the projections."""
    rows, cols = geometry.detector_shape
    outer = min(_height(geometry) + 2 * _HALO, rows)
    band = geometry if outer == rows else geometry.rows(0, outer)
    return bytes_of(_BUFFERS, band, Grid.matching(band)) + 8 * rows * cols


def _stripes_seen(projections: F32, geometry: Geometry) -> bool:
    """Whether some rows [view, row, col] show unequal pixel sensitivities. (A sample can hide them.)"""
    views = np.argsort(geometry.angles, kind="stable")
    rows = np.arange(0, projections.shape[1], max(1, projections.shape[1] // _EXAMINED_ROWS))
    steady = steadiness(projections[np.ix_(views, rows)], geometry.axis_col)
    return steady is None or steady.stripes


def _height(geometry: Geometry) -> int:
    """Number of rows that are processed together: all rows if a row does not show the same slice in all projections."""
    rows = geometry.detector_shape[0]
    return min(_BAND, rows) if geometry.rows_show_slices else rows


def _root(squares: F64) -> float:
    return float(np.sqrt(squares.mean()))


@dataclass(frozen=True, eq=False)
class _Band:
    """Some rows of the projections [view, row, col]. `known` is bool [row, col]; None: all pixels."""

    data: F32
    geometry: Geometry
    known: Mask | None

    @classmethod
    def of(cls, projections: F32, geometry: Geometry, rows: slice, measured: Mask | None) -> _Band:
        whole = rows.stop - rows.start == geometry.detector_shape[0]
        known = None if measured is None or measured[rows].all() else measured[rows]
        views = geometry if whole else geometry.rows(rows.start, rows.stop)
        return cls(np.ascontiguousarray(projections[:, rows]), views, known)

    def learn(self, view_numbers: NDArray[np.intp], with_gains: bool = True) -> tuple[Volume, F32]:
        """The volume from some projections, and the gains [row, col] from its residual."""
        views = self.geometry.select(view_numbers)
        projector = Projector(views, Grid.matching(self.geometry))
        weight = None if self.known is None else np.broadcast_to(self.known, projector.projection_shape).astype("f4")
        decide, gains_so_far, volume = Decisions(), np.zeros(self.data.shape[1:], np.float32), None
        data = self.data[view_numbers]
        for round_number in range(_ROUNDS):
            method = EarlyTv(_SWEEPS if round_number else _FIRST_SWEEPS, _TV_WEIGHT)
            volume = solve(method, projector, data, weight=weight, start=volume, decide=decide)
            if with_gains and round_number + 1 < _ROUNDS:
                residual = ring_offsets(data - projector.forward(volume.data), views) * self._distinguished()
                data -= residual
                gains_so_far += residual
        assert volume is not None
        return volume, gains_so_far

    def errors(self, volume: Volume, gains: F32, unseen: NDArray[np.intp], rows: slice) -> F64:
        """[view] mean square residual of held-out projections for a volume and gains, in some of the rows."""
        residual = self.data[unseen] - gains - Projector(self.geometry.select(unseen), volume.grid).forward(volume.data)
        known = None if self.known is None else np.broadcast_to(self.known, residual.shape)[:, rows]
        return np.asarray(np.average(np.square(residual[:, rows], dtype=np.float64), axis=(1, 2), weights=known))

    def _distinguished(self) -> F32:
        """Weights [col]: 1 in columns in which a gain cannot be confused with a body on the axis."""
        distance = np.abs(np.arange(self.data.shape[2]) - self.geometry.axis_col)
        axis_at_rest = np.ptp(self.geometry.shifts[:, 0]) < 2 * NEAR_AXIS
        return np.asarray((distance > NEAR_AXIS) | (not axis_at_rest), np.float32)
