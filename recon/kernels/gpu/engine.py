"""A fit's operations on a GPU: the same as the CPU's in `recon.backend`, on torch tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from recon.geometry import Geometry
from recon.kernels.activation import F32
from recon.kernels.gpu import losses, require
from recon.kernels.gpu.footprints import Footprints, footprints, footprints_backward
from recon.kernels.gpu.images import moments, render
from recon.kernels.gpu.parameters import activate, activation_backward, adam
from recon.kernels.gpu.voxels import Placed, fill, fill_backward, place
from recon.volume import Grid


class GpuPass:
    """Physical parameters of raw ones, and the gradients that views and boxes of voxels have added so far."""

    def __init__(self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float) -> None:
        self.raw_parameters, self.unit = (means, log_scales, quaternions, raw), unit
        scales, rotations, densities = activate(log_scales, quaternions, raw, unit)
        self.active = (means, scales, rotations, densities)
        self._gradients = (
            torch.zeros_like(means), torch.zeros_like(scales), torch.zeros_like(rotations), torch.zeros_like(densities)
        )  # fmt: skip

    def again(self) -> GpuPass:
        """The same parameters with gradients at zero."""
        return GpuPass(*self.raw_parameters, self.unit)

    def footprints(self, geometry: Geometry, view: int, faint: float, cut: float) -> Footprints:
        """Footprints in one view; `faint` in units of the image, `cut` in standard deviations."""
        return footprints(*self.active, geometry, view, faint, cut)

    def render(self, found: Footprints, geometry: Geometry) -> Tensor:
        """Image [row, col]."""
        return render(found, geometry.detector_shape)

    def render_backward(self, found: Footprints, geometry: Geometry, view: int, gradient: Tensor) -> Tensor:
        """Add what follows from an image gradient [row, col]; returns the gradient on centres [n, 2] in 1/px."""
        centres = self.active[0].new_empty((self.active[3].shape[0], 2))
        sums = moments(found, gradient)
        footprints_backward(found, sums, *self.active, geometry, view, *self._gradients, centres)
        return centres

    def place(self, grid: Grid, faint: float, cut: float) -> Placed:
        """Where the Gaussians fall on a grid; `faint` is a density."""
        return place(*self.active, grid, faint, cut)

    def fill(self, placed: Placed) -> Tensor:
        """Density [z, y, x]."""
        return fill(placed)

    def fill_backward(self, placed: Placed, gradient: Tensor, *, means_too: bool = True) -> None:
        """Add what follows from a gradient [z, y, x]."""
        fill_backward(placed, gradient, *self.active[1:], *self._gradients, means_too=means_too)

    def gradients(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients on means, log scales, quaternions and raw densities."""
        _, _, quaternions, raw = self.raw_parameters
        d_means, d_log_scales, d_rotations, d_densities = self._gradients
        return d_means, d_log_scales, *activation_backward(quaternions, raw, self.unit, d_rotations, d_densities)


class Gpu:
    """The Triton kernels on one device."""

    def __init__(self, device: str | torch.device) -> None:
        """Raises as `require`."""
        self.device = require(device)

    def array(self, values: F32) -> Tensor:
        """A copy on the device."""
        return torch.from_numpy(np.array(values, np.float32)).to(self.device)

    def numpy(self, array: Tensor) -> F32:
        """A copy for the host."""
        return array.detach().cpu().numpy().copy()

    def begin(self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float) -> GpuPass:
        """A pass over raw parameters; densities are unit * softplus(raw)."""
        return GpuPass(means, log_scales, quaternions, raw, unit)

    def projection_loss(self, shape: tuple[int, int], ssim_weight: float) -> losses.ProjectionLoss:
        """The loss on images of one shape."""
        return losses.ProjectionLoss(shape, ssim_weight, self.device)

    def total_variation(self, volume: Tensor, weight: float) -> tuple[Tensor, Tensor]:
        """weight * mean |difference of neighbours| of [z, y, x], and its gradient."""
        return losses.total_variation(volume, weight)

    def adam(
        self,
        parameters: Sequence[Tensor],
        gradients: Sequence[Tensor],
        first: Sequence[Tensor],
        second: Sequence[Tensor],
        rates: Sequence[float],
        step: int,
    ) -> None:
        """Update the four parameter arrays and their moments in place; `step` counts from 1."""
        adam(parameters, gradients, first, second, rates, step)
