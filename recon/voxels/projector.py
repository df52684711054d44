"""The voxel projector: line integrals through a volume, and the exact transpose.

Both directions compute on lines along z: volumes [y, x, z], projections [view, col, row], the last index fastest. A
caller that applies them many times keeps this layout (`forward_lines`, `adjoint_lines`, `volume_lines`, ...). `forward`
and `adjoint` use the normal layout and need a copy each way (256³ voxels: about 0.05 s on two cores).

A computed projection has the resolution of the measured ones, see `ViewResolution`: that of pixels one pitch wide, or
that of `Geometry.width`. With an arc, a projection is the mean of projections at angles within the arc. Both operations
are linear and are transposed exactly. Pixels should not be much larger than voxels, because otherwise no ray crosses
some voxels.

With `Geometry.skew`, bands of slices are projected at the angles of their rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, Mask
from recon.base.declared_types import check_settings
from recon.base.geometry import Geometry
from recon.base.slabs import bands_of
from recon.base.volume import Grid, Volume
from recon.kernels.cpu import cone as cone_cpu
from recon.kernels.cpu import joseph as joseph_cpu
from recon.kernels.cpu import one_slice as one_slice_cpu
from recon.kernels.cpu import posed as posed_cpu
from recon.kernels.cpu.lines import rows_from_slices, slices_from_rows, swap_last
from recon.kernels.cpu.spread import spread
from recon.kernels.cpu.vectors import combine
from recon.voxels.resolution import ViewResolution, levels, on_rows

_TALL = 0.25  # share of the box's height; if projections move along the axis by more, rays that leave the box are kept
_EDGE_ROWS = 0.01  # distance in slices beyond the outer ones that still counts as seen
_LOOK = 1.0  # px at the edge of the field of view between two angles within an exposure
_MOST_LOOKS = 16
_LOOKED_AT = 32  # approximate number of projections from which the rows that see a voxel are found
# slices of a parallel beam that are computed one by one, in 0.4 to 0.7 of the time of the kernel for sixteen
_FEW_SLICES = 2
_STEEP = 1e-8  # squared cosine below which columns run along the rotation axis


class _Rays(NamedTuple):
    """Rays of all projections at one time within their exposures, through a band of slices; see `ray_table`."""

    table: NDArray[np.float64]
    axes: NDArray[Any]  # of the planes in which each ray is sampled, numbered as in the kernels
    views: NDArray[np.float64] = np.empty(0)  # of a cone


@dataclass(frozen=True, eq=False)
class Projector:
    """Line integrals A through the voxels of `grid` along the rays of `geometry`, and their transpose Aᵀ.

    The method is Joseph's (1982, IEEE TMI 1, 192): a ray is sampled once in each plane of voxels, by bilinear
    interpolation. Outside `grid`, the volume is 0. Line integrals are float32, in mm times the unit of the volume.

    Attributes:
        matched: True: computed projections are sharpened to the resolution of the measured projections.
        device: device on which an iterative method computes with this projector, see `recon.voxels.devices`. The
            functions of this class always compute on the CPU.
        sharpened: [view, 2] variance in px² that the sharpening removes along columns and rows; None: no sharpening.

    Raises:
        ValueError: the box reaches the source, or a wide cone has a large tilt (see `posed.ray_table`).
    """

    geometry: Geometry
    grid: Grid
    matched: bool = True
    device: str = "cpu"
    resolution: ViewResolution = field(init=False, repr=False)
    sharpened: NDArray[np.float64] | None = field(init=False, repr=False)
    _bands: list[tuple[slice, list[_Rays]]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_settings(self)
        beyond = self.grid.voxel_size / 2  # the outermost voxels are interpolated to zero
        reach = float(np.hypot(*(np.abs(self.grid.edges[:, :2]).max(0) + beyond)))
        if self.geometry.is_cone and reach >= self.geometry.source_distance:
            raise ValueError(
                f"use a smaller grid: the grid, with half a voxel added on each side, reaches {reach:.4g} mm from "
                f"the rotation axis, but the source is only {self.geometry.source_distance:.4g} mm from the axis"
            )
        bands = [
            (band, [self._rays(moment_views) for moment_views in views_of_exposure(views)])
            for band, views in bands_of(self.geometry, self.grid)
        ]
        object.__setattr__(self, "_bands", bands)
        object.__setattr__(self, "resolution", ViewResolution.of(self.geometry, self.grid))
        variances = self.resolution.sharpened
        if not self.matched:
            variances = np.minimum(variances, 0)
        if self.geometry.detector_shape[0] == 1:
            variances[:, 1] = 0
        object.__setattr__(self, "sharpened", variances if variances.any() else None)

    @property
    def projection_shape(self) -> tuple[int, int, int]:
        """(views, rows, cols)."""
        return (self.geometry.n_views, *self.geometry.detector_shape)

    @property
    def plain(self) -> Projector:
        """The same projector without sharpening, so that the matrix has no negative entries."""
        return replace(self, matched=False) if self.matched else self

    def gain(self, weight: F32 | None = None) -> float:
        """An upper limit of the factor by which sharpening raises the largest eigenvalue of AᵀWA.

        If sharpening removes the variance s (px²), it amplifies the finest detail by the factor 1 + 2 s. All
        projections together amplify detail along the rotation axis. Detail across the axis is amplified only by
        projections in nearly the same direction. Two directions count as the same if rays at the edge of the field of
        view differ by less than a voxel. The limit assumes that every projection contributes equally to the
        eigenvector of the largest eigenvalue. If rays have different weights, the limit is raised.

        Args:
            weight: W, the weight of each ray; None: 1.
        """
        if self.sharpened is None:
            return 1.0
        cols, rows = ((1 + 2 * max(float(most), 0.0)) ** 2 for most in self.sharpened.max(0))
        # by a rotation of the sample
        turned = 1 - np.square(np.sin(self.geometry.roll) * np.cos(self.geometry.tilt)).max()
        angles = np.sort(np.mod(self.geometry.angles, np.pi))
        turns, alike = np.concatenate((angles, angles + np.pi)), 2 / self.geometry.detector_shape[1]
        last = np.searchsorted(turns, turns + alike / math.sqrt(max(turned, _STEEP)), "right")
        share = float((last - np.arange(turns.size)).max()) / angles.size
        if weight is not None and weight.any():
            share *= float(weight.max()) * np.count_nonzero(weight) / float(weight.sum(dtype=np.float64))
        return rows * (1 + (cols - 1) * min(share, 1.0))

    def subset(self, views: Sequence[int] | NDArray[np.integer] | slice) -> Projector:
        """The projector for only the projections `views`, in the order of `views`."""
        return replace(self, geometry=self.geometry.select(views))

    def __call__(self, volume: F32) -> F32:
        """A x, see `forward`."""
        return self.forward(volume)

    @property
    def T(self) -> Callable[[F32], F32]:  # noqa: N802, the name that linear operators have
        """Aᵀ: `adjoint`."""
        return self.adjoint

    def forward(self, volume: F32) -> F32:
        """Compute A x: the projections [view, row, col] of a volume x [z, y, x]."""
        return projection_images(self.forward_lines(volume_lines(_fitting(volume, self.grid.shape, "volume"))))

    def adjoint(self, projections: F32) -> F32:
        """Compute Aᵀ p: the back-projection, a volume [z, y, x], of projections p [view, row, col]."""
        lines = projection_lines(_fitting(projections, self.projection_shape, "projections"))
        return volume_slices(self.adjoint_lines(lines))

    def forward_lines(self, volume: F32) -> F32:
        """Compute A x: the projections [view, col, row] of a volume x [y, x, z]."""
        views, rows, cols = self.projection_shape
        result = np.empty((views, cols, rows), np.float32)
        if self._to_rows:
            self._mean("forward", volume, result)
        else:
            slices = np.empty((views, cols, self.grid.shape[0]), np.float32)
            self._mean("forward", volume, slices)
            rows_from_slices(slices, *levels(self.geometry, self.grid), result)
        return self._spread(result)

    def adjoint_lines(self, projections: F32, out: F32 | None = None) -> F32:
        """Compute Aᵀ p: the back-projection, a volume [y, x, z], of projections p [view, col, row]."""
        nz, ny, nx = self.grid.shape
        result = np.empty((ny, nx, nz), np.float32) if out is None else out
        projections = self._spread(projections)
        if not self._to_rows:
            slices = np.empty((*projections.shape[:2], nz), np.float32)
            slices_from_rows(projections, *levels(self.geometry, self.grid), slices)
            projections = slices
        self._mean("adjoint", projections, result)
        return result

    def _mean(self, direction: Literal["forward", "adjoint"], source: F32, out: F32) -> None:
        """The mean over the angles within an exposure, band of slices by band, from `source` into `out`."""
        for band, moments in self._bands:
            whole = band == slice(0, self.grid.shape[0])
            part = source if whole else np.ascontiguousarray(source[..., band])
            total = out if whole else np.empty((*out.shape[:2], part.shape[2]), np.float32)
            self._apply(direction, part, moments[0], total)
            if len(moments) > 1:
                more = np.empty_like(total)
                for rays in moments[1:]:
                    self._apply(direction, part, rays, more)
                    combine(1.0, total, 1.0, more, total)
                combine(1 / len(moments), total, 0.0, total, total)
            if not whole:
                out[..., band] = total

    @property
    def _kernels(self) -> Any:
        """The module with the kernels for these rays."""
        if not self.geometry.is_straight:
            return posed_cpu
        return one_slice_cpu if self._slice_by_slice() else cone_cpu if self.geometry.is_cone else joseph_cpu

    def _rays(self, views: Geometry) -> _Rays:
        kernels = posed_cpu if not self.geometry.is_straight else cone_cpu if self.geometry.is_cone else joseph_cpu
        return _Rays(*kernels.ray_table(views, self.grid))

    def _apply(self, direction: Literal["forward", "adjoint"], source: F32, rays: _Rays, out: F32) -> None:
        """One kernel at one time within the exposures, from `source` into `out`."""
        kernels = self._kernels
        if kernels is one_slice_cpu:
            for k in range(source.shape[2]):
                of_slice = np.empty(out.shape[:2], np.float32)
                getattr(kernels, direction)(np.ascontiguousarray(source[:, :, k]), *rays[:2], of_slice)
                out[:, :, k] = of_slice
            return
        getattr(kernels, direction)(source, *(rays if kernels is cone_cpu else rays[:2]), out)

    def _spread(self, lines: F32) -> F32:
        """Lines [view, col, row] at the resolution of the measured projections, see `ViewResolution`.

        It is its own transpose.
        """
        if self.sharpened is None:
            return lines
        return spread(lines, -self.sharpened[:, 0], -self.sharpened[:, 1])

    def _slice_by_slice(self) -> bool:
        """Whether all rays are in the planes of a few slices: a parallel beam without tilt, or a fan and its slice."""
        if self.geometry.is_cone:
            return self.geometry.is_fan and self.grid.shape[0] == 1 and self.grid.centre[0] == 0
        return self.grid.shape[0] <= _FEW_SLICES

    @cached_property
    def _to_rows(self) -> bool:
        """Whether the kernels return rows of the detector and not lines of slices.

        They do if each ray has its own height, or if slice k is on row k of every projection."""
        return not self.geometry.is_straight or self.geometry.is_cone or on_rows(self.geometry, self.grid)


def views_of_exposure(geometry: Geometry) -> list[Geometry]:
    """The projections at angles spread evenly over their exposures (midpoint rule); one if the stage does not turn."""
    arc = geometry.width.arc
    if arc == 0:
        return [geometry]
    travel = arc * geometry.reach / geometry.sample_pitch
    count = min(max(2, math.ceil(travel / _LOOK)), _MOST_LOOKS)
    turns = ((np.arange(count) + 0.5) / count - 0.5) * arc
    return [replace(geometry, angles=geometry.angles + turn) for turn in turns]


def volume_lines(volume: F32) -> F32:
    """Copies [z, y, x] to a new array [y, x, z]."""
    nz, ny, nx = volume.shape
    return projection_lines(_plain(volume).reshape(1, nz, ny * nx)).reshape(ny, nx, nz)


def measured_share(known: Mask, geometry: Geometry, grid: Grid) -> F32:
    """Share [z, y, x] of the rays through each voxel that end on known rows [row] of the detector; 0 if none does."""
    sampled = geometry.select(np.arange(0, geometry.n_views, max(1, geometry.n_views // _LOOKED_AT)))
    projector, rays = (
        Projector(sampled, grid, matched=False),
        np.ones((sampled.n_views, *sampled.detector_shape), np.float32),
    )
    every = projector.adjoint(rays)
    return np.asarray(projector.adjoint(rays * known[:, None]) / np.maximum(every, np.float32(1e-30)), np.float32)


def volume_slices(lines: F32) -> F32:
    """Copies [y, x, z] to a new array [z, y, x]."""
    ny, nx, nz = lines.shape
    return projection_lines(lines.reshape(1, ny * nx, nz)).reshape(nz, ny, nx)


def projection_lines(projections: F32) -> F32:
    """Copies [view, row, col] to a new array [view, col, row]."""
    views, rows, cols = projections.shape
    out = np.empty((views, cols, rows), np.float32)
    swap_last(_plain(projections), out)
    return out


projection_images = projection_lines
"""Copies [view, col, row] to a new array [view, row, col] (the same exchange of axes)."""


def project(volume: Volume, geometry: Geometry) -> F32:
    """Line integrals [view, row, col] of a volume; see `Projector`."""
    return Projector(geometry, volume.grid).forward(volume.data)


def seen_rays(geometry: Geometry, grid: Grid) -> NDArray[np.bool_]:
    """Mask [view, row, col] of the rays of a parallel beam that stay between the outer slices of the grid.

    Only these rays can be explained by the volume. Without roll and tilt, one column represents all columns. A ray that
    leaves these slices within the field of view because of roll or tilt is excluded. If projections move along the axis
    by a quarter of the box or more, the middle of each ray decides.
    """
    rows, cols = geometry.detector_shape
    down = np.arange(rows)[:, None] - geometry.axis_row - geometry.shifts[:, 1, None, None]
    middle, climb = down, np.zeros(1)
    if not geometry.is_straight:
        across = np.arange(cols) - geometry.axis_col - geometry.shifts[:, 0, None, None]
        lean = np.stack([geometry.axes(view)[:, 2] for view in range(geometry.n_views)])[:, :, None, None]
        middle = across * lean[:, 0] + down * lean[:, 1]
        climb = geometry.reach * np.abs(lean[:, 2])
        climb = np.where(climb < _TALL * grid.shape[0] * grid.spacing[0], climb, 0.0)
    off = np.abs(middle * geometry.pixel_pitch - grid.centre[0]) + climb
    return np.asarray(off / grid.spacing[0] <= (grid.shape[0] - 1) / 2 + _EDGE_ROWS)


def _plain(array: F32) -> F32:
    return np.ascontiguousarray(array, np.float32)


def _fitting(array: F32, shape: tuple[int, ...], name: str) -> F32:
    if np.shape(array) != shape:
        raise ValueError(f"the {name} must have the shape {shape} of the projector, got {np.shape(array)}")
    return array
