"""Gpu: the operations of a fit on a GPU, the Backend of `recon.splatting.backend` on torch tensors."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.ray_model import RayModel
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32
from recon.kernels.cpu.footprints import INEXACT
from recon.kernels.cpu.losses import ABSOLUTE, DataTerm
from recon.kernels.gpu import losses, require
from recon.kernels.gpu.footprints import HU, footprints, footprints_backward
from recon.kernels.gpu.images import moments, render
from recon.kernels.gpu.parameters import activate, activation_backward, adam
from recon.kernels.gpu.rays import GpuRays
from recon.kernels.gpu.voxels import fill, fill_backward, place

Parameters = tuple[Tensor, Tensor, Tensor, Tensor]  # means, scales (or their logarithms), rotations, densities


def _zeros(like: Parameters) -> Parameters:
    means, scales, rotations, densities = (torch.zeros_like(array) for array in like)
    return means, scales, rotations, densities


class GpuPass:
    """One pass over a model: physical parameters, and the gradients added by its views and boxes of voxels."""

    def __init__(
        self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> None:  # fmt: skip
        self._raw, self._unit, self.kernel = (quaternions, raw), unit, kernel
        scales, rotations, densities = activate(log_scales, quaternions, raw, unit)
        self.active = (means, scales, rotations, densities)
        self.into = _zeros(self.active)

    def view(self, geometry: Geometry, view: int, faint: float, cut: float, model: RayModel) -> GpuView:
        return GpuView(self, geometry, view, faint, cut, model)

    def box(self, grid: Grid, faint: float, cut: float) -> GpuBox:
        return GpuBox(self, grid, faint, cut)

    def gradients(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        d_means, d_log_scales, d_rotations, d_densities = self.into
        return d_means, d_log_scales, *activation_backward(*self._raw, self._unit, d_rotations, d_densities)


class GpuView:
    """One rendered view: its image [row, col] and its backward pass."""

    def __init__(self, run: GpuPass, geometry: Geometry, view: int, faint: float, cut: float, model: RayModel) -> None:
        if geometry.width:
            raise ValueError(f"rays with a width ({geometry.width}) are projected on the CPU only: use device 'cpu'")
        self._run, self._geometry, self._view, self._length = run, geometry, view, model.length(geometry)
        means, scales, rotations, densities = run.active
        if geometry.centres[view].any():  # where the view's axes start
            means = means - means.new_tensor(geometry.centres[view])
        self._active = means, scales, rotations, densities
        self.footprints = footprints(
            *self._active, geometry, view, faint, cut, self._length, model.exact_above, run.kernel
        )  # fmt: skip
        self.image = render(self.footprints, geometry.detector_shape, run.kernel)
        self._rays: tuple[Tensor, GpuRays] | None = None
        if geometry.is_cone and model.exact_above < math.inf:  # their number is only known after waiting for the device
            exact = torch.nonzero(self.footprints.table[:, HU.value] == INEXACT)[:, 0]
            if exact.numel() > 0:
                means, scales, rotations, densities = (array[exact] for array in self._active)
                rays = GpuRays((means, scales, rotations, densities), geometry, view, faint, cut, run.kernel)
                rays.add_to(self.image)
                self._rays = (exact, rays)

    def backward(self, gradient: Tensor) -> Tensor:
        run, found = self._run, self.footprints
        centres = found.table.new_empty((found.table.shape[0], 2))
        footprints_backward(
            found, moments(found, gradient, run.kernel), *self._active, self._geometry, self._view, *run.into, centres,
            self._length, run.kernel,
        )  # fmt: skip
        if self._rays is not None:
            exact, rays = self._rays
            some, moved = _zeros(rays.parameters), centres.new_empty((exact.numel(), 2))
            rays.backward(gradient, *some, moved)
            centres[exact] = moved
            for total, part in zip(run.into, some, strict=True):
                total[exact] += part  # no index is repeated, so the sum does not depend on an order
        return centres


class GpuBox:
    """One box of voxels: its density [z, y, x] and its backward pass."""

    def __init__(self, run: GpuPass, grid: Grid, faint: float, cut: float) -> None:
        self._run, self.placed = run, place(*run.active, grid, faint, cut, run.kernel)
        self.density = fill(self.placed)

    def backward(self, gradient: Tensor, *, means_too: bool = True) -> None:
        fill_backward(self.placed, gradient, *self._run.active[1:], *self._run.into, means_too=means_too)


class Gpu:
    """The Triton kernels on one device."""

    adam, total_variation = staticmethod(adam), staticmethod(losses.total_variation)

    def __init__(self, device: str | torch.device) -> None:
        """Raises as `require`."""
        self.device = require(device)

    def array(self, values: F32) -> Tensor:
        return torch.from_numpy(np.array(values, np.float32)).to(self.device)

    def numpy(self, array: Tensor) -> F32:
        return array.detach().cpu().numpy().copy()

    def begin(
        self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> GpuPass:  # fmt: skip
        return GpuPass(means, log_scales, quaternions, raw, unit, kernel)

    def projection_loss(
        self, shape: tuple[int, int], ssim_weight: float, term: DataTerm = ABSOLUTE
    ) -> losses.GpuProjectionLoss:
        return losses.GpuProjectionLoss(shape, ssim_weight, self.device, term)

    def misfit(self, image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        """||w (image - target)|| / ||w target|| (float64 scalar on the device); 0 for a target of zeros."""
        off, seen = image - target, target
        if weights is not None:
            off, seen = weights * off, weights * seen
        squares, power = (off * off).sum(dtype=torch.float64), (seen * seen).sum(dtype=torch.float64)
        return torch.where(power > 0, torch.sqrt(squares / power), 0.0)

    def add_lengths(self, vectors: Tensor, factor: float, sums: Tensor) -> None:
        sums.add_(torch.linalg.vector_norm(vectors, dim=1), alpha=factor)
