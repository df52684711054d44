"""Gpu: the operations of a fit on a GPU, the Backend of `recon.splatting.backend` on torch tensors."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.base.kernel import Kernel
from recon.kernels.cpu.activation import F32
from recon.kernels.cpu.losses import ABSOLUTE, DataTerm
from recon.kernels.fused_step import StepModel, StepPlan
from recon.kernels.gpu import require
from recon.kernels.gpu.fused import GpuStep
from recon.kernels.gpu.losses import GpuProjectionLoss, total_variation
from recon.kernels.gpu.parameters import adam, add_lengths
from recon.kernels.gpu.passes import GpuPass


class Gpu:
    """The Triton kernels on one device."""

    adam, add_lengths, total_variation = staticmethod(adam), staticmethod(add_lengths), staticmethod(total_variation)

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
    ) -> GpuProjectionLoss:
        return GpuProjectionLoss(shape, ssim_weight, self.device, term)

    def misfit(self, image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        """||w (image - target)|| / ||w target|| (float64 scalar on the device); 0 for a target of zeros."""
        off, seen = image - target, target
        if weights is not None:
            off, seen = weights * off, weights * seen
        squares, power = (off * off).sum(dtype=torch.float64), (seen * seen).sum(dtype=torch.float64)
        return torch.where(power > 0, torch.sqrt(squares / power), 0.0)

    def unit_quaternions(self, quaternions: Tensor, first: Tensor, second: Tensor) -> None:
        length = torch.linalg.vector_norm(quaternions.double(), dim=1, keepdim=True)
        length = torch.where(length < 1e-12, 1.0, length)
        quaternions.copy_(quaternions / length)
        first.copy_(first * length)
        second.copy_(second * length**2)

    def taken(self, array: Tensor, origin: NDArray[np.int64]) -> Tensor:
        rows = torch.from_numpy(origin).to(self.device)
        kept = array[rows.clamp(min=0)]
        kept[rows < 0] = 0
        return kept

    def fused_step(self, model: StepModel, plan: StepPlan, earlier: GpuStep | None) -> GpuStep | None:
        exact = plan.geometry.is_cone and plan.rays.exact_above < math.inf
        return (
            None if exact else GpuStep(model, plan, self.device, earlier)
        )  # the number of exact rays is only known on the host
