"""How much more blurred projections of voxels are than measured projections, and the correction of this blur.

A pixel of a measured projection is the mean of line integrals over its area, with the variance p²/12 along columns and
along rows. A voxel is the mean of the object over its edges h, with the variance h²/12 along every direction. The
projection of voxels by Joseph's method interpolates between the voxels of a plane. At a distance d (in voxels) from the
nearest voxel, this adds the variance d (1 - d) h², on average h²/6, along the two axes in the plane. So the variance of
the blur of a computed projection is larger than that of a measured one by

    e = Σ U_k² h_k² / 12 + Σ U_k² h_k² / 6 - (w² / 12 + b²) k: axes of the grid; the second sum without the axis
    perpendicular to the planes

along the columns, whose direction is U, and by the same with V instead of U along the rows. h is in pixels at the
middle of the box. w and b are the pixel and the blur of `RayWidth`; w is 1 if it is not known. docs/numerics.md derives
it.
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
)  # px²; excess that sharpening corrects, which is that of voxels as wide as pixels. The rest smooths the projections
_ALL = 1 / 6  # variance of the interpolation in squared edges, averaged over all distances
_ROW_TOLERANCE = 1e-6  # distance in slices up to which slices count as being on the rows
_ROUNDING_ERROR = 1e-9  # px²; rounding error
# voxels; if a ray drifts by less than this within the box, it crosses all planes at the same position
_LARGEST_DRIFT = 0.1
_DIGITS = 4  # digits of a variance, so that it does not depend on where a slab begins
_PAD = 16  # px beyond the edges to which the outer pixels are repeated


@dataclass(frozen=True, eq=False)
class ViewResolution:
    """The blur of line integrals through voxels and of the measured projections, along (columns, rows).

    Attributes:
        voxels: [view, 2, 3], edges of a voxel along the axes (x, y, z), in px as seen along columns and rows.
        interpolation: [view, 3], variance of the interpolation along these axes, in squared edges: 1/6 (the mean over
            all distances d). For a parallel projection along a grid axis, all rays have the same d, and it is d (1 -
            d).
        views: variance of a pixel and of the detector's blur in px².
        sharpens_rows: True for a cone, whose rows all interpolate between slices: rows are also sharpened. False for a
            parallel beam, because otherwise a slab would depend on the rows next to it, and slightly tilted projections
            would depend on the tilt.
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
        """The resolution of these projections, in their order."""
        return replace(self, voxels=self.voxels[views], interpolation=self.interpolation[views])

    @property
    def excess(self) -> F64:
        """Variance [view, 2] in px² by which computed projections are more blurred than measured ones.

        Negative: less.
        """
        squares = self.voxels**2
        own = squares.sum(2) / 12 + (squares * self.interpolation[:, None]).sum(2)
        excess = own - sum(self.views)
        return np.where(np.abs(excess) > _ROUNDING_ERROR, excess, 0.0)

    @property
    def sharpened(self) -> F64:
        """Variance [view, 2] in px² that the model removes from its projections by sharpening.

        Negative: that it adds.
        """
        most = self._most[:, None] * (1.0, float(self.sharpens_rows))
        return np.minimum(np.where(self.excess > 0, SHARPENED * self.excess, self.excess), most)

    @property
    def _most(self) -> F64:
        """Excess [view] in px² of voxels as wide as pixels."""
        return np.maximum(self.interpolation.max(1), _MOST)

    @property
    def smoothed(self) -> F64:
        """Variance [view, 2] in px² added to measured projections, because coarse voxels show no sharp edges."""
        beyond = self.excess - self._most[:, None]
        return np.where(beyond > _ROUNDING_ERROR, beyond, 0.0)

    def transfer(self, axis: int, f: F64) -> F64:
        """Transfer function [view, frequency] of the model relative to measured projections, at f cycles per pixel."""
        edges, variance = self.voxels[:, axis, :, None] * f, self.interpolation[..., None]
        response = np.sinc(edges)
        d = (1 - np.sqrt(np.maximum(1 - 4 * variance, 0))) / 2
        of_two = (1 - d) * np.cos(2 * np.pi * edges * d) + d * np.cos(2 * np.pi * edges * (1 - d))  # in phase
        share = response.prod(1) * np.where(variance == _ALL, response**2, of_two).prod(1)  # a triangle's is sinc²
        pixel, blur = self.views
        view_transfer = np.sinc(np.sqrt(12 * pixel) * f) * np.exp(-2 * np.pi**2 * blur * f**2)
        passes = max(passes_of(self.sharpened), 1)
        model = (1 + self.sharpened[:, axis, None] / passes * (1 - np.cos(2 * np.pi * f))) ** passes
        return np.clip(
            np.divide(share * model, view_transfer, out=np.ones_like(share), where=view_transfer > share * model), 0, 1
        )


def on_rows(geometry: Geometry, grid: Grid) -> bool:
    """Whether slice k is on row k in every projection of a parallel beam."""
    if geometry.is_cone or not geometry.is_straight:
        return False
    first, step = levels(geometry, grid)
    nz = grid.shape[0]
    return nz == geometry.detector_shape[0] and bool(
        np.abs(first).max() < _ROW_TOLERANCE and abs(step - 1) * nz < _ROW_TOLERANCE
    )


def levels(geometry: Geometry, grid: Grid) -> tuple[F64, float]:
    """The (fractional) slice that the first row of each projection sees, and slices per row; parallel beam."""
    middle = (grid.shape[0] - 1) / 2 - grid.centre[0] / grid.spacing[0]
    step = geometry.pixel_pitch / grid.spacing[0]
    return middle - (geometry.axis_row + geometry.shifts[:, 1]) * step, step


def _interpolation(geometry: Geometry, grid: Grid, axes: F64) -> F64:
    """`ViewResolution.interpolation`; `axes`: the axes of the projections."""
    (columns, rows, beam), views = axes.swapaxes(0, 1), np.arange(geometry.n_views)
    run = np.abs(beam)
    across = np.where(run[:, 1] >= run[:, 0], 1, 0)  # the planes in which a ray is sampled
    across = np.where(run[:, 2] > run[:, :2].max(1), 2, across)
    variances = np.where(across[:, None] != np.arange(3), _ALL, 0.0)
    if geometry.is_cone:
        return variances
    edges, first, count = (np.array(each[::-1]) for each in (grid.spacing, grid.first, grid.shape))
    lean = beam / beam[views, across][:, None]
    col, row = (each - each[views, across][:, None] * lean for each in (columns, rows))
    origin = np.array([geometry.axis_col, geometry.axis_row]) + geometry.shifts
    offset = first[across][:, None] * lean - geometry.pixel_pitch * (origin[:, :1] * col + origin[:, 1:] * row) - first
    scale = geometry.pixel_pitch / edges
    steps = (
        (scale * row, 1 / _ROW_TOLERANCE * _LARGEST_DRIFT),  # so that slabs agree
        (scale * col, geometry.detector_shape[1]),
        (edges[across][:, None] * lean / edges, count[across][:, None]),
    )
    still = np.all([np.abs(step - np.rint(step)) * many < _LARGEST_DRIFT for step, many in steps], axis=0)
    d = offset / edges
    d -= np.floor(d)
    return np.where(still & (variances > 0), np.round(d * (1 - d), _DIGITS), variances)


def at_voxel_resolution(views: F32, resolution: ViewResolution, counts: NDArray[np.bool_] | None = None) -> F32:
    """Measured projections [view, col, row] at the resolution of computed ones, from rays that count only.

    A ray that does not count, or has few neighbours that do, keeps its value.
    """
    sizes = enumerate(views.shape[1:])
    filters = [resolution.transfer(axis, np.asarray(np.fft.rfftfreq(n + 2 * _PAD), np.float64)) for axis, n in sizes]
    if counts is None or counts.all():
        return _filtered(views, filters)
    shares = _filtered(counts.astype(np.float32), filters)
    means = _filtered(np.where(counts, views, np.float32(0)), filters)
    return np.divide(means, shares, out=views.copy(), where=counts & (shares > 0.5))


def _filtered(views: F32, filters: list[F64]) -> F32:
    """Projections [view, col, row] filtered along columns and rows, a few at a time, to save memory in float64."""
    out = np.empty_like(views)
    for index, view in enumerate(views):
        filtered = view.astype(np.float64)
        for axis, shares in enumerate(filters):
            n, share = view.shape[axis], shares[index]
            if n == 1 or (share == 1).all():
                continue
            wide = [(0, 0), (0, 0)]
            wide[axis] = _PAD, _PAD
            lines = np.moveaxis(np.pad(filtered, wide, mode="edge"), axis, 1)
            lines = np.fft.irfft(np.fft.rfft(lines) * share, n + 2 * _PAD)
            filtered = np.moveaxis(lines[:, _PAD : _PAD + n], 1, axis)
        out[index] = filtered
    return out


def smoothed(views: F32, resolution: ViewResolution, counts: NDArray[np.bool_] | None = None) -> F32:
    """Projections [view, col, row], low-pass filtered to the resolution of coarse voxels; for fine voxels the same
    array.

    Rays that do not count are not used.
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
    """`Geometry.axes` of all projections, [view, 3, 3]."""
    c, s, ct, st, cr, sr = (f(a) for a in (geometry.angles, geometry.tilt, geometry.roll) for f in (np.cos, np.sin))
    zero = np.zeros_like(c)
    u, v = np.stack((c, s, zero), 1), np.stack((-s * st, c * st, ct), 1)
    return np.stack((cr[:, None] * u + sr[:, None] * v, cr[:, None] * v - sr[:, None] * u,
                     np.stack((-s * ct, c * ct, -st), 1)), 1)  # fmt: skip
