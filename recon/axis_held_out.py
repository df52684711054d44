"""axis_by_views: finds the column of the rotation axis with which held-out projections are predicted best. It is meant
for cone beams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, bin_views
from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry
from recon.base.units import warn_of_other_quantity
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.prep.align import AxisError, AxisEstimate
from recon.voxels.beyond_field import reach_of
from recon.voxels.held_out import predicted_views
from recon.voxels.methods import EarlyTv

COLS = 128  # columns; enough to find the axis to 0.05 of their pixels. More take longer
VIEWS = 90  # projections that suffice
_LEAST_VIEWS = 12
_ONE_IN = 3  # share of held-out projections: one in three
_LARGEST_DISTANCE = 0.1875  # largest distance of the axis from the start, as a share of the number of columns
_TV_WEIGHT = 3e-3  # every weight that suppresses the noise in the volume gives the same axis
_WIDER_BOX = 2.0  # width of the box for a sample that is wider than the field of view, in fields of view
_STEPS = 8  # largest number of moves of the parabola's middle towards its vertex
_LEAST_MEASURED_SHARE = 0.999  # share of a binned pixel that must have data
# factor on the iterations: material that only half of the projections see converges late and shifts the axis
_SHADOWED_FACTOR = 3
# share by which the best axis must lower the typical residual for the estimate to be confident
_LEAST_IMPROVEMENT = 0.1


def axis_by_views(
    projections: F32,
    geometry: Geometry,
    progress: Callable[[int], None] = lambda n: None,
    *,
    lit: NDArray[np.bool_] | None = None,
) -> AxisEstimate:
    """The column of the rotation axis with which a volume from two thirds of the projections predicts the other third
    best.

    The column `axis_col` of `geometry` must be within a fifth of the detector's width of the true axis, because only
    there the residual has a single minimum. The search begins with coarse steps and halves the step around the best
    candidate. At the end, the residuals of three candidates are computed on finer pixels, and the result is the minimum
    of the parabola through the three residuals. If the sample is wider than the field of view, the box of voxels is
    twice as wide as the field of view. For a 180° scan of a sample wider than the field of view in a parallel beam, use
    `find_axis` instead.

    Args:
        projections: float32 [view, row, col], line integrals; 90 projections (`VIEWS`) of 128 columns (`COLS`) suffice.
        geometry: geometry of these projections; the search begins at its `axis_col`.
        progress: function that gets the number of candidates tried so far.
        lit: bool [row, col] or [view, row, col], True for pixels with data; None: all pixels have data.

    Returns:
        The estimate. `AxisEstimate.confident` is False if the residual of the best candidate is nearly as large as the
        residuals of the other candidates.

    Raises:
        AxisError: the best candidate is farther from `axis_col` of `geometry` than a fifth of the detector's width, or
            the held-out projections show no material.
        ValueError: fewer than 12 projections.
    """
    check_arguments(axis_by_views, locals())
    if geometry.n_views < _LEAST_VIEWS:
        raise ValueError(
            f"{geometry.n_views} projections are too few to hold some out; at least {_LEAST_VIEWS} are needed"
        )
    warn_of_other_quantity(projections)
    data, known = projections, projections
    if lit is not None:
        data, known = (np.where(lit, projections, np.float32(other)) for other in (0, np.nan))
    width = _WIDER_BOX if reach_of(Views(known, geometry)).edges.beyond(0.0) else 1.0
    longer = 1 if lit is None else _SHADOWED_FACTOR
    tested_columns = list[float]()

    def ask(column: float) -> None:
        tested_columns.append(column)
        progress(len(tested_columns))

    # 32 columns are enough to come within half a coarse pixel. On fine pixels, a change of the grid would change the
    # residual more than a small step of the axis.
    coarse = _Residuals.of(data, geometry, lit, (32, 32), 3 * longer, width, ask)
    fine = _Residuals.of(data, geometry, lit, (COLS, 8), 6 * longer, width, ask)
    best, typical = _coarse_optimum(coarse, geometry)
    fine.grid = fine.grid_about(best)
    clear, half_bin = coarse(best) < (1 - _LEAST_IMPROVEMENT) * typical, 0.5 * fine.bin
    for _ in range(_STEPS):
        vertex = _vertex(fine, best, half_bin)
        downhill = min((best - half_bin, best + half_bin), key=fine)
        if (vertex is not None and abs(vertex - best) <= half_bin) or fine(downhill) >= fine(best):
            break
        best = downhill
    columns = sorted(coarse.found)
    curve = np.array([coarse.found[column] for column in columns])
    value = best if vertex is None else vertex
    return AxisEstimate(float(value), np.array(columns), curve, clear and vertex is not None, "views held out")


@dataclass(eq=False)
class _Residuals:
    """The residual of the held-out projections for each position of the axis, in columns of the data. Each residual is
    computed only once.

    Attributes:
        data, geometry, lit: the binned projections, their geometry, and True for pixels with data.
        bin: number of columns of the data in a binned pixel.
        axis_col: position of the axis in this geometry, in columns of the data.
        grid: the grid for all candidates; None: each candidate has its own.
    """

    data: F32
    geometry: Geometry
    lit: NDArray[np.bool_] | None
    bin: int
    axis_col: float
    sweeps: int
    width: float
    ask: Callable[[float], None]
    grid: Grid | None = None
    found: dict[float, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, data: F32, geometry: Geometry, lit: NDArray[np.bool_] | None, size: tuple[int, int], sweeps: int,
        width: float, ask: Callable[[float], None],
    ) -> _Residuals:  # fmt: skip
        """The residuals of projections that are binned to about `size` (columns, rows) and taken from the rows around
        `axis_row`."""
        rows, axis_col = geometry.detector_shape[0], geometry.axis_col
        binning = max(1, min(rows, geometry.detector_shape[1] // size[0]))
        if (height := size[1] * binning) < rows:
            first = round(min(max(geometry.axis_row - height / 2, 0), rows - height))
            data, geometry = data[:, first : first + height], geometry.rows(first, first + height)
            lit = None if lit is None else lit[..., first : first + height, :]
        if lit is not None:
            lit = bin_views(np.broadcast_to(lit, data.shape).astype(np.float32), binning) > _LEAST_MEASURED_SHARE
        binned = bin_views(np.ascontiguousarray(data), binning)
        return cls(binned, geometry.binned(binning), lit, binning, axis_col, sweeps, width, ask)

    def _moved(self, axis_col: float) -> Geometry:
        return replace(self.geometry, axis_col=self.geometry.axis_col + (axis_col - self.axis_col) / self.bin)

    def grid_about(self, axis_col: float) -> Grid:
        views = self._moved(axis_col)
        return Grid.matching(views).widened(self.width, views)

    def __call__(self, axis_col: float) -> float:
        if axis_col not in self.found:
            views = self._moved(axis_col)
            grid, method = self.grid or self.grid_about(axis_col), EarlyTv(self.sweeps, _TV_WEIGHT)
            weights = None if self.lit is None else self.lit.astype(np.float32)
            unseen, images = predicted_views(method, Views(self.data, views, weights), grid, _ONE_IN)
            lit = 1 if self.lit is None else self.lit[unseen]
            measured = self.data[unseen] * lit
            norm_of_views = _norm(measured)
            if norm_of_views == 0:
                raise AxisError(
                    "give the rotation axis: it cannot be found, because the held-out projections show no material"
                )
            self.found[axis_col] = _norm(measured - images * lit) / norm_of_views
            self.ask(axis_col)
        return self.found[axis_col]


def _coarse_optimum(residual: _Residuals, geometry: Geometry) -> tuple[float, float]:
    """The best column, accurate to half a coarse pixel, and the median residual of the columns tried."""
    cols, start = geometry.detector_shape[1], geometry.axis_col
    step = _LARGEST_DISTANCE / 3 * cols
    best = min((start + n * step for n in range(-3, 4)), key=residual)
    typical = float(np.median(list(residual.found.values())))
    while step > 0.5 * residual.bin:
        step /= 2
        best = min((best, best - step, best + step), key=residual)
    if abs(best - start) > _LARGEST_DISTANCE * cols:
        raise AxisError(
            f"give the axis: no rotation axis was found within {_LARGEST_DISTANCE * cols:.0f} columns of column "
            f"{start:.1f}. The held-out projections agree best with column {best:.1f}, at the edge of the search"
        )
    return best, typical


def _norm(values: F32) -> float:
    return float(np.linalg.norm(values.astype(np.float64)))


def _vertex(residual: _Residuals, middle: float, step: float) -> float | None:
    """The vertex of the parabola through three squared residuals; None if the parabola has no minimum."""
    square_below, square_middle, square_above = (residual(middle + n * step) ** 2 for n in (-1, 0, 1))
    bend = square_below - 2 * square_middle + square_above
    return middle + step * 0.5 * (square_below - square_above) / bend if bend > 0 else None
