"""Where a fit computes: the operations of a step as one protocol, done by the CPU's kernels or by a GPU's.

Arrays are numpy's on the CPU and torch tensors on a GPU; a fit passes them from one operation to the next and looks
into none of them. Losses come as something `float` takes: on a GPU that waits for the device, so do it seldom.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, SupportsFloat, TypeVar

import numpy as np

from recon.geometry import Geometry
from recon.kernels import losses_cpu
from recon.kernels.activation import F32
from recon.kernels.adam_cpu import adam
from recon.kernels.project_cpu import render
from recon.splat import Active, Gradients, grid_layout, view_backward, view_table
from recon.volume import Grid

Array = TypeVar("Array")


class View(Protocol[Array]):
    """One rendered view: its image [row, col], and the way back."""

    image: Array

    def backward(self, gradient: Array) -> Array:
        """Add what follows from an image gradient [row, col]; returns the gradient on centres [n, 2] in 1/px."""


class Box(Protocol[Array]):
    """One box of voxels: its density [z, y, x], and the way back."""

    density: Array

    def backward(self, gradient: Array, *, means_too: bool = True) -> None:
        """Add what follows from a gradient [z, y, x]; `means_too=False` leaves positions alone."""


class Pass(Protocol[Array]):
    """Physical parameters of a model, and the gradients that views and boxes of voxels have added so far."""

    def view(self, geometry: Geometry, view: int, faint: float, cut: float) -> View[Array]:
        """Render one view; footprints end below `faint` (units of the image) and at the latest after `cut` σ."""

    def box(self, grid: Grid, faint: float, cut: float) -> Box[Array]:
        """Voxelise on a grid; `faint` is a density."""

    def gradients(self) -> tuple[Array, Array, Array, Array]:
        """Gradients on means, log scales, quaternions and raw densities."""


class ProjectionLoss(Protocol[Array]):
    """mean |x - y| + λ (1 - SSIM(x, y))."""

    def target_maps(self, target: Array) -> Array:
        """What is computed once a target [row, col]: blurred y and y² [2, row, col]."""

    def __call__(self, image: Array, target: Array, target_maps: Array) -> tuple[SupportsFloat, Array]:
        """The loss and its gradient [row, col]."""


class Backend(Protocol[Array]):
    """The operations of a step on one device."""

    def array(self, values: F32) -> Array:
        """A copy on the device."""

    def numpy(self, array: Array) -> F32:
        """A copy for the host."""

    def begin(self, means: Array, log_scales: Array, quaternions: Array, raw: Array, unit: float) -> Pass[Array]:
        """A pass over raw parameters; densities are unit * softplus(raw)."""

    def projection_loss(self, shape: tuple[int, int], ssim_weight: float) -> ProjectionLoss[Array]:
        """The loss on images of one shape."""

    def total_variation(self, volume: Array, weight: float) -> tuple[SupportsFloat, Array]:
        """weight * mean |difference of neighbours| of [z, y, x], and its gradient."""

    def adam(
        self,
        parameters: Sequence[Array],
        gradients: Sequence[Array],
        first: Sequence[Array],
        second: Sequence[Array],
        rates: Sequence[float],
        step: int,
    ) -> None:
        """Update the four parameter arrays and their moments in place; `step` counts from 1."""


def backend_for(device: str) -> Backend[Any]:
    """The backend for "cpu" or for a CUDA device ("cuda", "cuda:1").

    Raises:
        ImportError: triton is not installed.
        RuntimeError: torch sees no CUDA device.
        ValueError: another kind of device.
    """
    if device == "cpu":
        return Cpu()
    from recon.kernels.gpu.engine import Gpu  # triton is loaded only where a GPU is asked for

    return Gpu(device)


class Cpu:
    """The numba kernels on numpy arrays."""

    def array(self, values: F32) -> F32:
        return np.array(values, np.float32)

    def numpy(self, array: F32) -> F32:
        return array.copy()

    def begin(self, means: F32, log_scales: F32, quaternions: F32, raw: F32, unit: float) -> CpuPass:
        return CpuPass(means, log_scales, quaternions, raw, unit)

    def projection_loss(self, shape: tuple[int, int], ssim_weight: float) -> CpuLoss:
        return CpuLoss(shape, ssim_weight)

    def total_variation(self, volume: F32, weight: float) -> tuple[float, F32]:
        gradient = np.empty_like(volume)
        return losses_cpu.total_variation(volume, gradient, weight), gradient

    def adam(
        self,
        parameters: Sequence[F32],
        gradients: Sequence[F32],
        first: Sequence[F32],
        second: Sequence[F32],
        rates: Sequence[float],
        step: int,
    ) -> None:
        for *arrays, rate in zip(parameters, gradients, first, second, rates, strict=True):
            p, g, m, v = (a.reshape(a.shape[0], -1) for a in arrays)
            adam(p, g, m, v, rate, step)


class CpuPass:
    """A pass by the numba kernels."""

    def __init__(self, means: F32, log_scales: F32, quaternions: F32, raw: F32, unit: float) -> None:
        self._raw, self._unit = (quaternions, raw), unit
        self.active = Active.of(means, log_scales, quaternions, raw, unit)
        self.into = Gradients.zeros(raw.shape[0])

    def view(self, geometry: Geometry, view: int, faint: float, cut: float) -> CpuView:
        return CpuView(self, geometry, view, faint, cut)

    def box(self, grid: Grid, faint: float, cut: float) -> CpuBox:
        return CpuBox(self, grid, faint, cut)

    def gradients(self) -> tuple[F32, F32, F32, F32]:
        return self.into.to_raw(*self._raw, self._unit)


class CpuView:
    """A view by the numba kernels."""

    def __init__(self, run: CpuPass, geometry: Geometry, view: int, faint: float, cut: float) -> None:
        self._run, self._geometry, self._view = run, geometry, view
        self._table = view_table(run.active, geometry, view, faint, cut)
        self.image: F32 = np.empty(geometry.detector_shape, np.float32)
        render(self._table, self.image)

    def backward(self, gradient: F32) -> F32:
        centres = np.empty((self._table.shape[0], 2), np.float32)
        view_backward(self._run.active, self._geometry, self._view, self._table, gradient, self._run.into, centres)
        return centres


class CpuBox:
    """A box of voxels by the numba kernels."""

    def __init__(self, run: CpuPass, grid: Grid, faint: float, cut: float) -> None:
        self._into, self._layout = run.into, grid_layout(run.active, grid, faint, cut)
        self.density: F32 = np.ascontiguousarray(self._layout.fill())

    def backward(self, gradient: F32, *, means_too: bool = True) -> None:
        into = self._into
        self._layout.backward(
            gradient, into.means, into.log_scales, into.rotations, into.densities, means_too=means_too
        )  # fmt: skip


class CpuLoss:
    """The fused loss by the numba kernels."""

    def __init__(self, shape: tuple[int, int], ssim_weight: float) -> None:
        self._loss = losses_cpu.ProjectionLoss(shape, ssim_weight)

    def target_maps(self, target: F32) -> F32:
        return self._loss.target_maps(target)

    def __call__(self, image: F32, target: F32, target_maps: F32) -> tuple[float, F32]:
        gradient = np.empty_like(image)
        return self._loss(image, target, target_maps, gradient), gradient
