"""The device on which a voxel method computes: the operations of its loops as one Protocol, for the CPU or a GPU.

A loop moves its arrays to the device once, and back at its end. Between loops all arrays are numpy arrays: choices and
noise are computed on the CPU.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import numpy as np
from scipy.fft import irfft2, rfft2

from recon.base.arrays import F32
from recon.base.choices import refuse_unknown_device
from recon.base.registry import loaded
from recon.kernels.cpu import patches, tents, tv, vectors
from recon.kernels.cpu.tv import Weights
from recon.voxels.projector import Projector, views_of_exposure

Array = TypeVar("Array")


class LineProjector(Protocol[Array]):
    """A projector and its transpose on lines along z; see `recon.voxels.projector`."""

    def forward_lines(self, volume: Array) -> Array:
        """Volume [y, x, z] to projections [view, col, row]."""

    def adjoint_lines(self, projections: Array, out: Array | None = None) -> Array:
        """Projections [view, col, row] to a volume [y, x, z]."""


class VoxelDevice(Protocol[Array]):
    """Operations on volumes and projections, in place if one of the arrays is named as the result.

    Operations with the names of those in `recon.kernels.cpu.vectors`, `tv` and `patches` do the same.
    """

    def array(self, values: F32) -> Array:
        """The values on the device; on the CPU the array itself."""

    def numpy(self, array: Array) -> F32:
        """The values as a numpy array; on the CPU the array itself."""

    def zeros(self, shape: tuple[int, ...]) -> Array: ...
    def copy(self, array: Array) -> Array: ...
    def combine(self, alpha: float, a: Array, beta: float, b: Array, out: Array) -> None: ...
    def maximum(self, a: Array, b: Array, out: Array) -> None: ...
    def add_product(self, x: Array, factor: float, a: Array, b: Array, nonnegative: bool) -> None: ...

    def replace_by_residual(
        self, data: Array, model: Array, weight: Array | None = None, scale: Array | None = None
    ) -> float: ...
    def turn_of_steps(self, before: Array, start: Array, end: Array) -> float: ...
    def extrapolate(self, x: Array, factor: float, last: Array, start: Array) -> None: ...
    def dot(self, a: Array, b: Array) -> float: ...
    def norm(self, x: Array) -> float: ...

    def tent_sums(self, x: Array, width: int) -> Array: ...
    def add_tents(self, x: Array, factor: float, cells: Array, width: int) -> None: ...

    def filtered(self, cells: Array, transfer: F32) -> Array:
        """Cells [a, b, z], filtered along a and b with this transfer function [a, b of rfft2]."""

    def dual_field(self, shape: tuple[int, int, int]) -> Any: ...
    def dual_scratch(self, shape: tuple[int, int, int]) -> Any: ...

    def dual_step(
        self, x: Array, p: Any, threshold: float, weights: Weights, nonnegative: bool, scratch: Any,
        back: tuple[int, int] = (0, 0),
    ) -> None: ...  # fmt: skip

    def primal(
        self, x: Array, p: Any, threshold: float, weights: Weights, nonnegative: bool, scratch: Any, out: Array
    ) -> None: ...  # fmt: skip

    def patch_scratch(self, shape: tuple[int, int, int]) -> Any: ...
    def denoise(self, x: Array, threshold: float, nonnegative: bool, scratch: Any, out: Array) -> None: ...

    def pulled_step(
        self, x: Array, change: Array, momentum: float, step_size: float, gradient: Array, pull: float, z: Array,
        nonnegative: bool,
    ) -> None: ...  # fmt: skip


class CpuVolumes:
    """The numba kernels on numpy arrays."""

    combine, extrapolate = staticmethod(vectors.combine), staticmethod(vectors.extrapolate)
    replace_by_residual, add_product = staticmethod(vectors.replace_by_residual), staticmethod(vectors.add_product)
    maximum = np.maximum
    turn_of_steps = staticmethod(vectors.turn_of_steps)
    dot, norm = staticmethod(vectors.dot), staticmethod(vectors.norm)
    tent_sums, add_tents = staticmethod(tents.tent_sums), staticmethod(tents.add_tents)
    dual_field, dual_scratch = staticmethod(tv.dual_field), staticmethod(tv.dual_scratch)
    dual_step, primal = staticmethod(tv.dual_step), staticmethod(tv.primal)
    patch_scratch, denoise = staticmethod(patches.patch_scratch), staticmethod(patches.denoise)
    pulled_step = staticmethod(patches.pulled_step)

    def array(self, values: F32) -> F32:
        return values

    def numpy(self, array: F32) -> F32:
        return array

    def zeros(self, shape: tuple[int, ...]) -> F32:
        return np.zeros(shape, np.float32)

    def copy(self, array: F32) -> F32:
        return array.copy()

    def filtered(self, cells: F32, transfer: F32) -> F32:
        waves = rfft2(cells, axes=(0, 1))
        waves *= transfer[:, :, None]
        return np.ascontiguousarray(irfft2(waves, cells.shape[:2], axes=(0, 1)), np.float32)


CPU: VoxelDevice[Any] = CpuVolumes()


def voxel_device(device: str) -> VoxelDevice[Any]:
    """The operations on "cpu", or on "cuda" (the current CUDA device).

    Raises:
        ImportError, RuntimeError, ValueError: as for `recon.kernels.gpu.require`.
    """
    refuse_unknown_device(device)
    if device == "cpu":
        return CPU
    gpu: VoxelDevice[Any] = loaded("recon.kernels.gpu.volumes").GpuVolumes(device)  # loads triton
    return gpu


def projector_on(device: VoxelDevice[Array], projector: Projector) -> LineProjector[Any]:
    """The projector for arrays of a device."""
    return projector if device is CPU else _GpuProjector(projector, device)


class _GpuProjector:
    """A projector on a GPU. Tilted projections, and those with a skew, are projected on the CPU."""

    def __init__(self, projector: Projector, device: Any) -> None:
        self._projector, self._device, geometry = projector, device, projector.geometry
        self._joseph = loaded("recon.kernels.gpu.joseph")
        moments = views_of_exposure(geometry) if geometry.is_straight and not geometry.skew else []
        self._moments = [self._joseph.JosephRays.of(views, projector.grid, device.device) for views in moments]

    def forward_lines(self, volume: Any) -> Any:
        if not self._moments:
            return self._device.array(self._projector.forward_lines(self._device.numpy(volume)))
        views, rows, cols = self._projector.projection_shape
        return self._spread(self._mean(self._joseph.forward, volume, self._device.zeros((views, cols, rows))))

    def adjoint_lines(self, projections: Any, out: Any = None) -> Any:
        if not self._moments:
            volume = self._device.array(self._projector.adjoint_lines(self._device.numpy(projections)))
            return volume if out is None else out.copy_(volume)
        nz, ny, nx = self._projector.grid.shape
        out = self._device.zeros((ny, nx, nz)) if out is None else out
        return self._mean(self._joseph.adjoint, self._spread(projections), out)

    def _mean(self, project: Any, source: Any, out: Any) -> Any:
        """The mean over the angles within an exposure."""
        first, *others = self._moments
        project(source, first, out)
        for rays in others:
            further = self._device.zeros(out.shape)
            project(source, rays, further)
            out += further
        if others:
            out /= len(self._moments)
        return out

    def _spread(self, lines: Any) -> Any:
        sharpened = self._projector.sharpened
        return lines if sharpened is None else self._device.spread(lines, -sharpened[:, 0], -sharpened[:, 1])
