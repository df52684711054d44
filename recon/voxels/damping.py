"""Damping: steps that are longer for fine detail (small eigenvalues) than for coarse shapes (large eigenvalues).

The eigenvalue of AᵀA for a wave of f cycles per side falls as 1 / f. A step that is safe for the coarsest shapes is
short for fine detail, which then needs hundreds of iterations. So coarse shapes are damped. L is a low-pass filter, and
the steps follow P g = gain (1 - L) g. They are up to `gain` times as long for fine detail.

    L(f) = 1 - clip(f / 2 cycles a side, 1, gain) / gain

L acts on coarse cells in the plane of a slice (tents of `recon.kernels.cpu.tents`), so that it costs little compared
with a projection. It acts on each slice alone, so that slabs do not depend on each other. (Preconditioners for
tomography: Fessler & Booth 1999, IEEE Trans. Image Process. 8, 688. Proximal steps in another metric: Combettes & Vũ
2014, Optimization 63, 1289.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import eigh_tridiagonal

from recon.base.arrays import F32
from recon.kernels.cpu.tents import cells_of, least_width, spectrum_of_tents
from recon.voxels.devices import VoxelDevice, projector_on, voxel_device
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import one_of_like_rows

_CELLS = 64  # largest number of cells along the longer side; finer detail is not damped
_UNDAMPED_CYCLES, _LARGEST_GAIN = 2.0, 32.0  # cycles per side, above which steps are longer; the largest gain
_GAIN_A_VIEW = 2 / 3  # longer steps for detail that the projections do not resolve would only add noise
_LEAST_OF_TENTS = 0.2  # smallest share of a wave that remains in the tents and is still compensated
_LANCZOS_STEPS, _MARGIN = 8, 1.1  # safety factor, because Lanczos' estimate is too low
_ROUNDING_ERROR = 1e-6  # size of the rounding error


@dataclass(frozen=True)
class Damping:
    """The filter L for volumes of one shape.

    Attributes:
        shape: [y, x, z] of a volume.
        gain: step of the finest detail, divided by that of the coarsest shapes; 1: L is zero.
    """

    shape: tuple[int, int, int]
    gain: float

    @classmethod
    def of(cls, shape: tuple[int, int, int], n_views: int) -> Damping:
        """The damping for steps that use this number of projections."""
        return cls(shape, min(max(_GAIN_A_VIEW * n_views, 1.0), _LARGEST_GAIN))

    @property
    def width(self) -> int:
        """Width of a cell in voxels."""
        return least_width(max(self.shape[:2]), _CELLS)

    @cached_property
    def _transfer(self) -> F32:
        """Transfer function [a, b of rfft2] of L in the sums of cells."""
        rows, cols = (cells_of(n, self.width) for n in self.shape[:2])
        row_frequencies = np.fft.fftfreq(rows) * rows
        column_frequencies = np.fft.rfftfreq(cols) * cols
        axes = ((row_frequencies, rows), (column_frequencies, cols))
        spectra = [
            np.maximum(spectrum_of_tents(f.astype(np.float64), n * self.width, self.width), _LEAST_OF_TENTS)
            for f, n in axes
        ]
        side = max(rows, cols)
        cycles = np.hypot(row_frequencies[:, None] * side / rows, column_frequencies[None] * side / cols)
        transfer = 1 - np.clip(cycles / _UNDAMPED_CYCLES, 1, self.gain) / self.gain
        transfer = np.minimum(
            transfer / (spectra[0][:, None] * spectra[1][None]), 1 - 1 / self.gain
        )  # L must stay below 1
        return (transfer / self.width**2).astype(np.float32)

    def cells(self, device: VoxelDevice[Any], x: Any) -> Any:
        """The sums of a volume [y, x, z] in coarse cells, on which L acts."""
        return device.tent_sums(x, self.width)

    def take_off(self, device: VoxelDevice[Any], x: Any, cells: Any) -> None:
        """x -= L of the volume with these `cells`, in place."""
        device.add_tents(x, -1.0, device.filtered(cells, self._transfer), self.width)


def largest_damped(projector: Projector, weight: F32 | None, damping: Damping) -> float:
    """An upper estimate of the largest eigenvalue of gain (1 - L) AᵀWA, by Lanczos steps from noise.

    It is also an eigenvalue of the symmetric matrix √W A gain (1 - L) Aᵀ √W. If all rows are equivalent, it is computed
    on one row. (Lanczos 1950, J. Res. Natl. Bur. Stand. 45, 255; from a random vector: Kuczyński & Woźniakowski 1992,
    SIAM J. Matrix Anal. Appl. 13, 1094.)
    """
    device = voxel_device(projector.device)
    projector_of_like_rows = one_of_like_rows(projector.plain, weight)
    lines, (nz, ny, nx) = projector_on(device, projector_of_like_rows), projector_of_like_rows.grid.shape
    row_damping = replace(damping, shape=(ny, nx, nz))
    root = None if weight is None else device.array(np.sqrt(weight))
    noise = np.random.default_rng(0).standard_normal(_ray_shape(projector_of_like_rows), np.float32)
    q = device.array(noise if weight is None else noise * (weight > 0))
    size, previous = device.norm(q), device.zeros(noise.shape)
    diagonal, off_diagonal = list[float](), list[float]()
    for _ in range(_LANCZOS_STEPS):
        if size <= _ROUNDING_ERROR * math.sqrt(noise.size):
            break
        device.combine(1 / size, q, 0.0, q, q)
        back = lines.adjoint_lines(q if root is None else q * root)
        row_damping.take_off(device, back, row_damping.cells(device, back))
        image = lines.forward_lines(back)
        if root is not None:
            image *= root
        off_diagonal.append(size)
        device.combine(1.0, image, -size if diagonal else 0.0, previous, image)
        diagonal.append(device.dot(q, image))
        device.combine(1.0, image, -diagonal[-1], q, image)
        previous, q = q, image
        size = device.norm(q)
    if not diagonal or not (largest := float(eigh_tridiagonal(diagonal, off_diagonal[1:], eigvals_only=True)[-1])) > 0:
        return math.inf  # no ray crosses the box
    return _MARGIN * projector.gain(weight) * row_damping.gain * largest


def _ray_shape(projector: Projector) -> tuple[int, int, int]:
    """Shape [view, col, row] of the lines of a projector."""
    views, rows, cols = projector.projection_shape
    return views, cols, rows
