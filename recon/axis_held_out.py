"""axis_by_views: the rotation axis that predicts unseen views best; for a cone beam, whose opposite views differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, bin_views
from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry
from recon.base.units import warn_of_other_quantity
from recon.base.volume import Grid
from recon.prep.align import AxisError, AxisEstimate
from recon.voxels.field_edges import wider_than_field
from recon.voxels.held_out import predicted_views
from recon.voxels.methods import FistaTv

COLS = 128  # Columns that show the axis to 0.05 of their pixels; more cost time
VIEWS = 90  # Views that are enough
_LEAST_VIEWS = 12
_ONE_IN = 3  # views held out
_WIDEST = 0.1875  # of the columns to either side of the start
_TV_WEIGHT = 3e-3  # any weight that keeps noise out of the volume shows the same axis
_WIDER = 2.0  # A box this wide takes the matter around the field. In the field alone it would hide the axis.
_STEPS = 8  # of the parabola's middle towards its vertex, at most
_BETTER = 0.98  # of the residual at the start: what another axis has to leave
_WHOLE = 0.999  # of a binned pixel that the beam reaches
_SHADOWED = 3  # times the sweeps: matter that half of the views see takes longer, and draws the axis away till then
_CLEAR = 0.1  # of the typical residual that the best axis has to take away


def axis_by_views(
    projections: F32,
    geometry: Geometry,
    progress: Callable[[int], None] = lambda n: None,
    *,
    near: bool = False,
    lit: NDArray[np.bool_] | None = None,
) -> AxisEstimate:
    """The axis column for which a volume of two thirds of the views predicts the other views best.

    The residual has one minimum for some tenths of the detector's width. A coarse search halves its step around the
    best candidate. A parabola through three candidates on finer pixels ends it. The box of a sample wider than its
    field is twice as wide; half a turn of such a sample in parallel beam is better left to `find_axis`.

    Args:
        projections: float32 [view, row, col], line integrals; `VIEWS` x `COLS` are enough.
        geometry: of these views; the search begins at its `axis_col`.
        progress: takes the number of candidates tried so far.
        near: the start stays, after ten candidates, where it is clearly the best of the coarse search and no axis
            beside it leaves 2 % less. Far from the axis no candidate differs much from those beside it.
        lit: [row, col], pixels that the beam reaches; None: all. Others count as not measured.

    Returns:
        Not confident where the best candidate leaves nearly as much as the others.

    Raises:
        AxisError: no minimum lies within a fifth of the detector's width of the start.
        ValueError: fewer than 12 views.
    """
    check_arguments(axis_by_views, locals())
    if geometry.n_views < _LEAST_VIEWS:
        raise ValueError(f"{geometry.n_views} views are too few for held-out views; at least {_LEAST_VIEWS} are needed")
    warn_of_other_quantity(projections)
    views = _Views(projections if lit is None else np.where(lit, projections, 0).astype(np.float32), geometry, lit)
    return _search(views, progress, _WIDER if wider_than_field(views.data, geometry) else 1.0, near)


@dataclass(frozen=True, eq=False)
class _Views:
    """Line integrals [view, row, col], their geometry, and which pixels [row, col] the beam reaches; None: all."""

    data: F32
    geometry: Geometry
    lit: NDArray[np.bool_] | None


def _search(views: _Views, progress: Callable[[int], None], width: float, near: bool) -> AxisEstimate:
    """`axis_by_views` in a box of `width` times the field's."""
    cols = views.geometry.detector_shape[1]
    longer = 1 if views.lit is None else _SHADOWED
    coarse = _Judge(views, replace(_COARSE, sweeps=longer * _COARSE.sweeps), progress, width)
    fine = _Judge(views, replace(_FINE, sweeps=longer * _FINE.sweeps), progress, width, others=coarse)
    start, half = views.geometry.axis_col, 0.5 * fine.bin
    step = _WIDEST / 3 * cols
    best = min((start + n * step for n in range(-3, 4)), key=coarse)
    typical = float(np.median(list(coarse.found.values())))
    if near and best == start and coarse(start) < (1 - _CLEAR) * typical:
        vertex = _vertex(fine, start, half)
        if vertex is not None and vertex.least > _BETTER * fine(start):
            return _estimate(start, fine, confident=True)
    while step > 0.5 * coarse.bin:
        step /= 2
        best = min((best, best - step, best + step), key=coarse)
    if abs(best - start) > _WIDEST * cols:
        raise AxisError(
            f"no rotation axis within {_WIDEST * cols:.0f} columns of column {start:.1f}: views held out agree best "
            f"with column {best:.1f}, at the edge of the search; give the axis"
        )
    clear = coarse(best) < (1 - _CLEAR) * typical
    estimate = _vertex(fine, best, half)
    for _ in range(_STEPS):
        if estimate is not None and abs(estimate.axis_col - best) <= half:
            break
        downhill = min((best - half, best + half), key=fine)
        if fine(downhill) >= fine(best):
            break
        best = downhill
        estimate = _vertex(fine, best, half)
    if estimate is None:
        return _estimate(best, coarse, confident=False)
    return _estimate(estimate.axis_col, coarse, confident=clear)


@dataclass(frozen=True)
class _Accuracy:
    """What the volume of a candidate is made of.

    Attributes:
        cols, rows: of the binned views, at most.
        sweeps: of FISTA-TV.
        one_grid: all candidates have the first one's grid. Another grid moves the residual more than a small step does.
    """

    cols: int
    rows: int
    sweeps: int
    one_grid: bool


_COARSE = _Accuracy(cols=32, rows=32, sweeps=3, one_grid=False)  # enough to come within half a coarse pixel
_FINE = _Accuracy(COLS, rows=8, sweeps=6, one_grid=True)


@dataclass(eq=False)
class _Judge:
    """The share of unseen views that a volume leaves, for an axis in columns of the data; each is asked once."""

    views: _Views
    accuracy: _Accuracy
    progress: Callable[[int], None]
    width: float
    others: _Judge | None = None
    found: dict[float, float] = field(default_factory=dict)
    _grid: Grid | None = None

    def __post_init__(self) -> None:
        whole, rows = self.views.geometry, self.views.geometry.detector_shape[0]
        self.bin = max(1, min(rows, whole.detector_shape[1] // self.accuracy.cols))
        data, views, lit = self.views.data, whole, self.views.lit
        if (height := self.accuracy.rows * self.bin) < rows:
            first = round(min(max(whole.axis_row - height / 2, 0), rows - height))
            data, views = data[:, first : first + height], whole.rows(first, first + height)
            lit = None if lit is None else lit[first : first + height]
        self.binned, self._views = bin_views(np.ascontiguousarray(data), self.bin), views.binned(self.bin)
        self._lit = None if lit is None else bin_views(lit[None].astype(np.float32), self.bin) > _WHOLE

    def __call__(self, axis_col: float) -> float:
        if axis_col not in self.found:
            self.found[axis_col] = self._residual(axis_col)
            self.progress(len(self.found) + (len(self.others.found) if self.others else 0))
        return self.found[axis_col]

    def _residual(self, axis_col: float) -> float:
        moved = (axis_col - self.views.geometry.axis_col) / self.bin
        views = replace(self._views, axis_col=self._views.axis_col + moved)
        if self._grid is None or not self.accuracy.one_grid:
            self._grid = Grid.matching(views).widened(self.width, views)
        method, lit = FistaTv(self.accuracy.sweeps, _TV_WEIGHT), 1 if self._lit is None else self._lit
        unseen, images = predicted_views(method, self.binned, views, self._grid, self._lit, _ONE_IN)
        measured = self.binned[unseen] * lit
        left = measured - images * lit
        most = _norm(measured)
        if most == 0:
            raise AxisError("the held-out views show no matter, so that the axis cannot be determined; give the axis")
        return _norm(left) / most


def _norm(values: F32) -> float:
    return float(np.linalg.norm(values.astype(np.float64)))


@dataclass(frozen=True)
class _Vertex:
    axis_col: float
    least: float


def _vertex(judge: _Judge, middle: float, half: float) -> _Vertex | None:
    """The vertex of the parabola through three squared residuals; None where they have no minimum."""
    below, here, above = (judge(middle + n * half) ** 2 for n in (-1, 0, 1))
    bend = below - 2 * here + above
    if bend <= 0:
        return None
    shift = 0.5 * (below - above) / bend
    return _Vertex(middle + half * shift, max(here - 0.5 * bend * shift**2, 0.0) ** 0.5)


def _estimate(value: float, judge: _Judge, confident: bool) -> AxisEstimate:
    tried = sorted(judge.found)
    curve = np.array([judge.found[each] for each in tried])
    return AxisEstimate(float(value), np.array(tried), curve, confident, "views held out")
