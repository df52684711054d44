"""Backend: the operations of a fitting step as a Protocol, with implementations for CPU and GPU.

Arrays are numpy arrays on the CPU and torch tensors on a GPU. A fit passes these arrays from one operation to the next
without reading them. Losses can be converted with `float`. On a GPU this conversion waits for the device, so convert
losses rarely.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, SupportsFloat, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.choices import refuse_unknown_device
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.registry import loaded
from recon.base.volume import Grid
from recon.kernels.cpu import losses as losses_cpu
from recon.kernels.cpu.adam import adam_all, add_lengths
from recon.kernels.cpu.engine import Active, Gradients, RenderedView, Scratch, grid_layout, render_view
from recon.kernels.cpu.losses import ABSOLUTE, CpuProjectionLoss, DataTerm
from recon.kernels.fused_step import FusedStep, StepModel, StepPlan

Array = TypeVar("Array")


class SplatView(Protocol[Array]):
    """One rendered projection, with its backward pass."""

    @property
    def image(self) -> Array:
        """[row, col]."""

    def backward(self, gradient: Array) -> Array:
        """Back-propagate an image gradient [row, col]; returns the gradient with respect to centres [n, 2] in 1/px."""


class VoxelBox(Protocol[Array]):
    """One box of voxels: its density [z, y, x] and its backward pass."""

    density: Array

    def backward(self, gradient: Array, *, means_too: bool = True) -> None:
        """Back-propagate a gradient [z, y, x]. With `means_too=False`, the positions get no gradient."""


class Pass(Protocol[Array]):
    """One pass over a model: its physical parameters, and the sum of the gradients from its projections and voxel
    boxes."""

    def view(self, geometry: Geometry, view: int, faint: float, cut: float, model: RayModel) -> SplatView[Array]:
        """Render one projection. A footprint ends at `cut` standard deviations, or earlier if it falls below `faint`
        (in units of the image).

        Call `backward` of a projection before the next one is rendered, because they share memory.
        """

    def box(self, grid: Grid, faint: float, cut: float) -> VoxelBox[Array]:
        """Voxelise on a grid. `faint` is the density below which a Gaussian ends."""

    def gradients(self) -> tuple[Array, Array, Array, Array]:
        """Gradients with respect to means, log scales, quaternions and raw densities."""


class ProjectionLoss(Protocol[Array]):
    """mean w (D(x, y) + λ (1 - SSIM(x, y))), see `recon.kernels.cpu.losses`."""

    def target_maps(self, target: Array, weights: Array | None = None) -> Array:
        """The maps of a target [row, col] that are computed once and reused in every step."""

    def __call__(
        self, image: Array, target: Array, target_maps: Array, weights: Array | None = None
    ) -> tuple[SupportsFloat, Array]:
        """The loss and its gradient [row, col]. The next call overwrites the gradient."""


class Backend(Protocol[Array]):
    """The operations of a fitting step on one device."""

    def array(self, values: F32) -> Array:
        """A copy on the device."""

    def numpy(self, array: Array) -> F32:
        """A copy as a numpy array."""

    def begin(
        self, means: Array, log_scales: Array, quaternions: Array, raw: Array, unit: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> Pass[Array]:  # fmt: skip
        """A pass over raw parameters. The densities are unit * softplus(raw)."""

    def projection_loss(
        self, shape: tuple[int, int], ssim_weight: float, term: DataTerm = ABSOLUTE
    ) -> ProjectionLoss[Array]:
        """The loss for images of one shape."""

    def misfit(self, image: Array, target: Array, weights: Array | None) -> SupportsFloat:
        """||w (image - target)|| / ||w target||; 0 for a target of zeros."""

    def total_variation(self, volume: Array, weight: float) -> tuple[SupportsFloat, Array]:
        """weight * mean |difference of neighbours| of [z, y, x], and its gradient."""

    def add_lengths(self, vectors: Array, factor: float, sums: Array) -> None:
        """sums [n] += factor |vectors [n, 2]|."""

    def adam(
        self,
        parameters: Sequence[Array],
        gradients: Sequence[Array],
        first: Sequence[Array],
        second: Sequence[Array],
        rates: Sequence[float],
        step: int,
        bounds: Sequence[tuple[float, float] | None],
    ) -> None:
        """Update the four parameter arrays and their moments in place, within bounds. The first step has the number
        1."""

    def unit_quaternions(self, quaternions: Array, first: Array, second: Array) -> None:
        """Normalise quaternions [n, 4] to length 1 in place, and rescale Adam's moments accordingly.

        Quaternions of length zero are not changed.
        """

    def taken(self, array: Array, origin: NDArray[np.int64]) -> Array:
        """The rows `origin` of an array; zeros for -1."""

    def fused_step(self, model: StepModel, plan: StepPlan, earlier: FusedStep | None) -> FusedStep | None:
        """An object that makes complete steps on the device, without the host. None if this backend makes steps
        operation by operation.

        `earlier`: the previous fused step, which was made for another model or plan.
        """


def backend_for(device: str) -> Backend[Any]:
    """The backend for "cpu" or "cuda" (the current CUDA device, which may also be given by its number, as "cuda:0").

    Raises:
        ImportError: triton is not installed.
        RuntimeError: torch sees no CUDA device.
        ValueError: it is another kind of device, or a CUDA device that is missing or not the current one.
    """
    refuse_unknown_device(device)
    if device == "cpu":
        return Cpu()
    Gpu: Any = loaded("recon.kernels.gpu.engine").Gpu  # imported here, because it loads triton, which only a GPU needs

    return Gpu(device)


class Cpu:
    """A `Backend` for the CPU: numba kernels on numpy arrays."""

    adam, add_lengths = staticmethod(adam_all), staticmethod(add_lengths)

    def __init__(self) -> None:
        self._scratch: tuple[tuple[int, tuple[int, int]], Scratch] | None = None

    def array(self, values: F32) -> F32:
        return np.array(values, np.float32)

    def numpy(self, array: F32) -> F32:
        return array.copy()

    def begin(
        self, means: F32, log_scales: F32, quaternions: F32, raw: F32, unit: float, kernel: Kernel = Kernel.GAUSSIAN
    ) -> CpuPass:
        return CpuPass(self, Active.of(means, log_scales, quaternions, raw, unit, kernel), quaternions, raw, unit)

    def unit_quaternions(self, quaternions: F32, first: F32, second: F32) -> None:
        length = np.linalg.norm(quaternions.astype(np.float64), axis=1, keepdims=True)
        length[length < 1e-12] = 1
        quaternions[:], first[:], second[:] = quaternions / length, first * length, second * length**2

    def taken(self, array: F32, origin: NDArray[np.int64]) -> F32:
        rows = array[origin]
        rows[origin < 0] = 0
        return rows

    def fused_step(self, model: StepModel, plan: StepPlan, earlier: FusedStep | None) -> None:
        return None

    def scratch(self, n: int, detector_shape: tuple[int, int]) -> Scratch:
        """Scratch buffers for one projection of n Gaussians. The previous buffers are reused if they have the right
        size."""
        if self._scratch is None or self._scratch[0] != (n, detector_shape):
            self._scratch = ((n, detector_shape), Scratch.of(n, detector_shape))
        return self._scratch[1]

    def projection_loss(
        self, shape: tuple[int, int], ssim_weight: float, term: DataTerm = ABSOLUTE
    ) -> CpuProjectionLoss:
        return CpuProjectionLoss(shape, ssim_weight, term=term)

    def misfit(self, image: F32, target: F32, weights: F32 | None) -> float:
        residual = image - target if weights is None else weights * (image - target)
        measured = target if weights is None else weights * target
        power = float(np.vdot(measured, measured))
        return (float(np.vdot(residual, residual)) / power) ** 0.5 if power > 0 else 0.0

    def total_variation(self, volume: F32, weight: float) -> tuple[float, F32]:
        gradient = np.empty_like(volume)
        return losses_cpu.total_variation(volume, gradient, weight), gradient


class CpuPass:
    """A `Pass` that uses the numba kernels."""

    def __init__(self, backend: Cpu, active: Active, quaternions: F32, raw: F32, unit: float) -> None:
        self._backend, self.active, self._raw, self._unit = backend, active, (quaternions, raw), unit
        self.into = Gradients.zeros(raw.shape[0])

    def view(self, geometry: Geometry, view: int, faint: float, cut: float, model: RayModel) -> RenderedView:
        scratch = self._backend.scratch(len(self.active.densities), geometry.detector_shape)
        return render_view(self.active, self.into, geometry, view, faint, cut, model, scratch)

    def box(self, grid: Grid, faint: float, cut: float) -> CpuBox:
        return CpuBox(self, grid, faint, cut)

    def gradients(self) -> tuple[F32, F32, F32, F32]:
        return self.into.to_raw(*self._raw, self._unit)


class CpuBox:
    """A `VoxelBox` that uses the numba kernels."""

    def __init__(self, run: CpuPass, grid: Grid, faint: float, cut: float) -> None:
        self._into, self._layout = run.into, grid_layout(run.active, grid, faint, cut)
        self.density: F32 = np.ascontiguousarray(self._layout.fill())

    def backward(self, gradient: F32, *, means_too: bool = True) -> None:
        into = self._into
        self._layout.backward(
            gradient, into.means, into.log_scales, into.rotations, into.densities, means_too=means_too
        )  # fmt: skip
