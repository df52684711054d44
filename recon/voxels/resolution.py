"""How much blurrier projections of voxels are than measured views, and where that is corrected.

A pixel of a view is the mean of line integrals over its area, of variance p²/12 along columns and along rows. A voxel
of a volume is the mean of the object over its edges h, of variance h²/12 along every direction. Its projection by
Joseph's samples interpolates between the voxels of a plane. At a distance d of a voxel from the nearest one, this has
the variance d (1 - d) h², h²/6 on average, along the two axes in the plane. So a projection is blurrier than a view by

    e = Σ U_k² h_k² / 12 + Σ U_k² h_k² / 6 - (w² / 12 + b²)      k: axes of the grid; the second sum without that across
                                                                 the planes

along the columns, whose direction is U, and as much with V in place of U along the rows. h is in pixels at the middle
of the box, w and b are those of `RayWidth`, where w is 1 if nothing else is known. docs/numerics.md derives it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.empirical import SHARPENED
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.spread import passes_of, spread

_MOST = (
    1 / 6
)  # px² of excess that sharpening corrects, as voxels as wide as pixels have; views are smoothed by the rest
_ALL = 1 / 6  # of an edge squared: variance of interpolation at all distances, on average
_ON_ROWS = 1e-6  # slices: slices this close to the rows lie on them
_NOTHING = 1e-9  # px²: rounding
_STILL = 0.1  # voxels: rays that drift by less within the box meet all planes alike
_DIGITS = 4  # of a variance: where a slab begins does not change it
_PAD = 16  # px beyond the edges of views, to which the outer ones are repeated


@dataclass(frozen=True, eq=False)
class ViewResolution:
    """The blur of line integrals through voxels, beside that of the views, along (columns, rows) of each view.

    Attributes:
        voxels: [view, 2, 3], edges of a voxel along the axes (x, y, z), in px as seen along columns and rows.
        interpolation: [view, 3], variance along these axes of a ray's interpolation, in squares of an edge: 1/6, the
            mean over all distances d, but for a parallel view along a grid axis, where all rays have one: d (1 - d).
        views: variance of a pixel in px², and of the detector's blur.
        sharpens_rows: rows of a cone, which all interpolate between slices, are sharpened. Those of a parallel beam are
            not: a slab would depend on the rows beside it, and views that lean a little on how much.
    """

    voxels: F64
    interpolation: F64
    views: tuple[float, float]
    sharpens_rows: bool

    @classmethod
    def of(cls, geometry: Geometry, grid: Grid) -> ViewResolution:
        axes = _axes(geometry)
        middle = np.array(grid.centre[::-1]) - geometry.centres
        pitch = np.full(geometry.n_views, geometry.pixel_pitch)
        if geometry.is_cone:
            pitch *= (geometry.sod + np.einsum("vk,vk->v", axes[:, 2], middle)) / geometry.sdd
        edges = np.array(grid.spacing[::-1]) / pitch[:, None]
        interpolation = _interpolation(geometry, grid, axes)
        width = geometry.width
        views = (width.pixel or 1.0) ** 2 / 12, width.blur**2
        return cls(np.abs(axes[:, :2]) * edges[:, None], interpolation, views, geometry.is_cone)

    def select(self, views: NDArray[np.intp]) -> ViewResolution:
        """The resolution of these views, in their order."""
        return replace(self, voxels=self.voxels[views], interpolation=self.interpolation[views])

    @property
    def excess(self) -> F64:
        """[view, 2] px², by which projections of a volume are blurrier than views; negative: sharper."""
        squares = self.voxels**2
        own = squares.sum(2) / 12 + (squares * self.interpolation[:, None]).sum(2)
        excess = own - sum(self.views)
        return np.where(np.abs(excess) > _NOTHING, excess, 0.0)

    @property
    def sharpened(self) -> F64:
        """[view, 2] px² of variance that the model takes off its projections; negative: that it adds to them."""
        most = self._most[:, None] * (1.0, float(self.sharpens_rows))
        return np.minimum(np.where(self.excess > 0, SHARPENED * self.excess, self.excess), most)

    @property
    def _most(self) -> F64:
        """[view] px² of excess of voxels as wide as pixels."""
        return np.maximum(self.interpolation.max(1), _MOST)

    @property
    def smoothed(self) -> F64:
        """[view, 2] px² of variance added to the views, whose edges are sharper than coarse voxels can show."""
        beyond = self.excess - self._most[:, None]
        return np.where(beyond > _NOTHING, beyond, 0.0)

    def transfer(self, axis: int, f: F64) -> F64:
        """[view, frequency] what a projection by the model keeps of a view at f cycles a pixel."""
        edges, variance = self.voxels[:, axis, :, None] * f, self.interpolation[..., None]
        at = np.sinc(edges)
        d = (1 - np.sqrt(np.maximum(1 - 4 * variance, 0))) / 2
        of_two = (1 - d) * np.cos(2 * np.pi * edges * d) + d * np.cos(2 * np.pi * edges * (1 - d))  # in phase
        share = at.prod(1) * np.where(variance == _ALL, at**2, of_two).prod(1)  # a triangle's is sinc²
        pixel, blur = self.views
        seen = np.sinc(np.sqrt(12 * pixel) * f) * np.exp(-2 * np.pi**2 * blur * f**2)
        passes = max(passes_of(self.sharpened), 1)
        model = (1 + self.sharpened[:, axis, None] / passes * (1 - np.cos(2 * np.pi * f))) ** passes
        return np.clip(np.divide(share * model, seen, out=np.ones_like(share), where=seen > share * model), 0, 1)


def on_rows(geometry: Geometry, grid: Grid) -> bool:
    """Slice k lies on row k of every view of a parallel beam."""
    if geometry.is_cone or not geometry.is_straight:
        return False
    first, step = levels(geometry, grid)
    nz = grid.shape[0]
    return nz == geometry.detector_shape[0] and bool(np.abs(first).max() < _ON_ROWS and abs(step - 1) * nz < _ON_ROWS)


def levels(geometry: Geometry, grid: Grid) -> tuple[F64, float]:
    """The slice (fractional) that the first row of each view sees, and slices a row; parallel beam."""
    middle = (grid.shape[0] - 1) / 2 - grid.centre[0] / grid.spacing[0]
    step = geometry.pixel_pitch / grid.spacing[0]
    return middle - (geometry.axis_row + geometry.shifts[:, 1]) * step, step


def _interpolation(geometry: Geometry, grid: Grid, axes: F64) -> F64:
    """`ViewResolution.interpolation`; `axes`: those of the views."""
    (columns, rows, beam), views = axes.swapaxes(0, 1), np.arange(geometry.n_views)
    run = np.abs(beam)
    across = np.where(run[:, 1] >= run[:, 0], 1, 0)  # the planes that sample a ray
    across = np.where(run[:, 2] > run[:, :2].max(1), 2, across)
    found = np.where(across[:, None] != np.arange(3), _ALL, 0.0)
    if geometry.is_cone:
        return found
    edges, first, count = (np.array(each[::-1]) for each in (grid.spacing, grid.first, grid.shape))
    lean = beam / beam[views, across][:, None]
    col, row = (each - each[views, across][:, None] * lean for each in (columns, rows))
    origin = np.array([geometry.axis_col, geometry.axis_row]) + geometry.shifts
    at = first[across][:, None] * lean - geometry.pixel_pitch * (origin[:, :1] * col + origin[:, 1:] * row) - first
    scale = geometry.pixel_pitch / edges
    steps = (
        (scale * row, 1 / _ON_ROWS * _STILL),  # slabs agree
        (scale * col, geometry.detector_shape[1]),
        (edges[across][:, None] * lean / edges, count[across][:, None]),
    )
    still = np.all([np.abs(step - np.rint(step)) * many < _STILL for step, many in steps], axis=0)
    d = at / edges
    d -= np.floor(d)
    return np.where(still & (found > 0), np.round(d * (1 - d), _DIGITS), found)


def at_voxel_resolution(views: F32, resolution: ViewResolution, counts: NDArray[np.bool_] | None = None) -> F32:
    """Views [view, col, row] at the resolution of projections of a volume by the model; only rays that count have part.

    A ray that does not count, or has few beside it that do, keeps its value.
    """
    sizes = enumerate(views.shape[1:])
    filters = [resolution.transfer(axis, np.asarray(np.fft.rfftfreq(n + 2 * _PAD), np.float64)) for axis, n in sizes]
    if counts is None or counts.all():
        return _filtered(views, filters)
    shares = _filtered(counts.astype(np.float32), filters)
    means = _filtered(np.where(counts, views, np.float32(0)), filters)
    return np.divide(means, shares, out=views.copy(), where=counts & (shares > 0.5))


def _filtered(views: F32, filters: list[F64]) -> F32:
    """Views [view, col, row] filtered along columns and rows, one after the other, so that few are held in float64."""
    out = np.empty_like(views)
    for at, view in enumerate(views):
        found = view.astype(np.float64)
        for axis, shares in enumerate(filters):
            n, share = view.shape[axis], shares[at]
            if n == 1 or (share == 1).all():
                continue
            wide = [(0, 0), (0, 0)]
            wide[axis] = _PAD, _PAD
            lines = np.moveaxis(np.pad(found, wide, mode="edge"), axis, 1)
            lines = np.fft.irfft(np.fft.rfft(lines) * share, n + 2 * _PAD)
            found = np.moveaxis(lines[:, _PAD : _PAD + n], 1, axis)
        out[at] = found
    return out


def smoothed(views: F32, resolution: ViewResolution, counts: NDArray[np.bool_] | None = None) -> F32:
    """Views [view, col, row], low-pass filtered to the resolution of coarse voxels; the same array for fine ones.

    Rays that do not count have no part.
    """
    along = resolution.smoothed
    if not along.any():
        return views
    if counts is None:
        return spread(views, along[:, 0], along[:, 1])
    shares = spread(counts.astype(np.float32), along[:, 0], along[:, 1])
    means = spread(np.where(counts, views, np.float32(0)), along[:, 0], along[:, 1])
    return np.divide(means, shares, out=np.zeros_like(views), where=counts)


def _axes(geometry: Geometry) -> F64:
    """[view, 3, 3], `Geometry.axes` of all views."""
    c, s, ct, st, cr, sr = (f(a) for a in (geometry.angles, geometry.tilt, geometry.roll) for f in (np.cos, np.sin))
    zero = np.zeros_like(c)
    u, v = np.stack((c, s, zero), 1), np.stack((-s * st, c * st, ct), 1)
    return np.stack((cr[:, None] * u + sr[:, None] * v, cr[:, None] * v - sr[:, None] * u,
                     np.stack((-s * ct, c * ct, -st), 1)), 1)  # fmt: skip
