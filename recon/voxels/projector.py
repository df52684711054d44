"""The voxel projector: line integrals through a volume, and the exact transpose.

Both directions run on lines along z: volumes [y, x, z], projections [view, col, row], the last index fastest. A caller
that applies them again and again keeps that layout (`forward_lines`, `adjoint_lines`, `volume_lines`, ...); `forward`
and `adjoint` take and give the usual one. They pay a copy each way (256³: some 0.05 s on two cores).

A ray has no width: pixels should not be much larger than voxels, or voxels between the rays are not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.kernels.cpu import cone as cone_cpu
from recon.kernels.cpu import joseph as joseph_cpu
from recon.kernels.cpu import posed as posed_cpu
from recon.kernels.cpu.lines import rows_from_slices, slices_from_rows, swap_last

_ON_ROWS = 1e-6  # slices: slices this close to the rows lie on them
_TALL = 0.25  # of the box's height: views that climb by more within the field keep rays that leave it
_EDGE_ROWS = 0.01  # slices beyond the outer ones that still count as seen


@dataclass(frozen=True, eq=False)
class Projector:
    """Line integrals A through the voxels of `grid` along the rays of `geometry`, and their transpose Aᵀ.

    Joseph's interpolation (P. M. Joseph 1982, IEEE Trans. Med. Imaging 1, 192): a ray is sampled once in each plane
    of voxels, bilinearly. The volume is 0 outside the box. In mm times the volume's unit, float32.

    Raises:
        ValueError: for a box that reaches the source, or a wide cone seen under a large tilt (see `posed.ray_table`).
    """

    geometry: Geometry
    grid: Grid
    _rays: NDArray[np.float64] = field(init=False, repr=False)
    _axes: NDArray[Any] = field(init=False, repr=False)  # of the planes that sample each ray, as the kernels count them

    def __post_init__(self) -> None:
        reach = float(np.hypot(*np.abs(self.grid.edges[:, :2]).max(0)))
        if self.geometry.is_cone and reach >= self.geometry.sod:
            raise ValueError(
                f"the box reaches {reach:.4g} mm from the rotation axis, but the source stands at "
                f"{self.geometry.sod:.4g} mm: give a smaller grid"
            )
        kernels = joseph_cpu if self.geometry.is_straight else posed_cpu
        rays, axes = kernels.ray_table(self.geometry, self.grid)
        object.__setattr__(self, "_rays", rays)
        object.__setattr__(self, "_axes", axes)

    @property
    def projection_shape(self) -> tuple[int, int, int]:
        """(views, rows, cols)."""
        return (self.geometry.n_views, *self.geometry.detector_shape)

    def subset(self, views: Sequence[int] | NDArray[np.integer] | slice) -> Projector:
        """The same for some views only, in that order."""
        return Projector(self.geometry.select(views), self.grid)

    def forward(self, volume: F32) -> F32:
        """A x: volume [z, y, x] to projections [view, row, col]."""
        return projection_images(self.forward_lines(volume_lines(_fitting(volume, self.grid.shape, "volume"))))

    def adjoint(self, projections: F32) -> F32:
        """Aᵀ p: projections [view, row, col] to a volume [z, y, x]."""
        lines = projection_lines(_fitting(projections, self.projection_shape, "projections"))
        return volume_slices(self.adjoint_lines(lines))

    def forward_lines(self, volume: F32) -> F32:
        """A x: volume [y, x, z] to projections [view, col, row]."""
        views, rows, cols = self.projection_shape
        result = np.empty((views, cols, rows), np.float32)
        if not self.geometry.is_straight:
            posed_cpu.forward(volume, self._rays, self._axes, result)
        elif self.geometry.is_cone:
            cone_cpu.forward(volume, self._rays, self._axes, *self._heights(), self.geometry.pixel_pitch, result)
        elif self._on_rows():
            joseph_cpu.forward(volume, self._rays, self._axes, result)
        else:
            slices = np.empty((views, cols, self.grid.shape[0]), np.float32)
            joseph_cpu.forward(volume, self._rays, self._axes, slices)
            rows_from_slices(slices, *self._levels(), result)
        return result

    def adjoint_lines(self, projections: F32, out: F32 | None = None) -> F32:
        """Aᵀ p: projections [view, col, row] to a volume [y, x, z]."""
        nz, ny, nx = self.grid.shape
        result = np.empty((ny, nx, nz), np.float32) if out is None else out
        if not self.geometry.is_straight:
            posed_cpu.adjoint(projections, self._rays, self._axes, result)
        elif self.geometry.is_cone:
            cone_cpu.adjoint(projections, self._rays, self._axes, *self._heights(), self.geometry.pixel_pitch, result)
        elif self._on_rows():
            joseph_cpu.adjoint(projections, self._rays, self._axes, result)
        else:
            slices = np.empty((*projections.shape[:2], nz), np.float32)
            slices_from_rows(projections, *self._levels(), slices)
            joseph_cpu.adjoint(slices, self._rays, self._axes, result)
        return result

    def _heights(self) -> tuple[NDArray[np.float64], float]:
        """The row on which z = 0 falls in each view, and the slice at z = 0."""
        middle = (self.grid.shape[0] - 1) / 2 - self.grid.centre[0] / self.grid.spacing[0]
        return self.geometry.axis_row + self.geometry.shifts[:, 1], middle

    def _levels(self) -> tuple[NDArray[np.float64], float]:
        """The slice (fractional) that the first row of each view sees, and slices a row; parallel beam."""
        rows, middle = self._heights()
        step = self.geometry.pixel_pitch / self.grid.spacing[0]
        return middle - rows * step, step

    def _on_rows(self) -> bool:
        """Slice k lies on row k of every view."""
        first, step = self._levels()
        nz = self.grid.shape[0]
        return nz == self.geometry.detector_shape[0] and bool(
            np.abs(first).max() < _ON_ROWS and abs(step - 1) * nz < _ON_ROWS
        )


def volume_lines(volume: F32) -> F32:
    """[z, y, x] to a new [y, x, z]."""
    nz, ny, nx = volume.shape
    out = np.empty((ny, nx, nz), np.float32)
    swap_last(_plain(volume).reshape(1, nz, ny * nx), out.reshape(1, ny * nx, nz))
    return out


def volume_slices(lines: F32) -> F32:
    """[y, x, z] to a new [z, y, x]."""
    ny, nx, nz = lines.shape
    out = np.empty((nz, ny, nx), np.float32)
    swap_last(lines.reshape(1, ny * nx, nz), out.reshape(1, nz, ny * nx))
    return out


def projection_lines(projections: F32) -> F32:
    """[view, row, col] to a new [view, col, row]."""
    views, rows, cols = projections.shape
    out = np.empty((views, cols, rows), np.float32)
    swap_last(_plain(projections), out)
    return out


def projection_images(lines: F32) -> F32:
    """[view, col, row] to a new [view, row, col]."""
    views, cols, rows = lines.shape
    out = np.empty((views, rows, cols), np.float32)
    swap_last(lines, out)
    return out


def project(volume: Volume, geometry: Geometry) -> F32:
    """Line integrals [view, row, col] of a volume; see `Projector`."""
    return Projector(geometry, volume.grid).forward(volume.data)


def data_residual(
    volume: Volume, projections: NDArray[np.float32], geometry: Geometry, weights: F32 | None = None
) -> float:
    """||A x - p|| / ||p||: the share of the measured line integrals [view, row, col] that the volume does not explain.

    Args:
        weights: of the rays; None: equal weights. Rays of weight 0 do not count.

    Raises:
        ValueError: if `projections` does not fit `geometry`, or is all zero.
    """
    left, scale = residual_norms(volume, projections, geometry, weights)
    if scale == 0:
        raise ValueError("projections are all zero, so there is nothing to explain")
    return left / scale


def residual_norms(
    volume: Volume, projections: NDArray[np.float32], geometry: Geometry, weights: F32 | None = None
) -> tuple[float, float]:
    """||A x - p|| and ||p||; see `data_residual`."""
    expected = (geometry.n_views, *geometry.detector_shape)
    if projections.shape != expected:
        raise ValueError(f"projections have shape {projections.shape}, their geometry says {expected}")
    root = np.float32(1) if weights is None else np.sqrt(weights)
    left = float(np.linalg.norm(root * (project(volume, geometry) - projections)))
    return left, float(np.linalg.norm(root * projections))


def seen_rays(geometry: Geometry, grid: Grid) -> NDArray[np.bool_]:
    """[view, row, col] rays of a parallel beam between the outer slices of the grid, which the volume can explain.

    One column stands for all where views are straight. A ray that roll or tilt takes beyond these slices within the
    field is not among them. Of views that climb by a quarter of the box or more, the middle of each ray decides.
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
    if array.shape != shape:
        raise ValueError(f"the {name} has shape {array.shape}, the projector expects {shape}")
    return array
