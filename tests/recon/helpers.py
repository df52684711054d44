"""Gaussians as leaves of a graph, for gradient comparisons."""

from __future__ import annotations

import torch

from recon.splatting.gaussians import Gaussians


def in_double(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians as float64 leaves, so that the reference implementation runs and collects gradients."""
    leaves = [
        tensor.detach().double().requires_grad_()
        for tensor in (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.raw_densities)
    ]
    return Gaussians(*leaves, density_unit=gaussians.density_unit, kernel=gaussians.kernel)


def as_leaves(gaussians: Gaussians, device: torch.device | None = None) -> Gaussians:
    """The same Gaussians as float32 leaves that collect gradients, on a device if one is given."""
    leaves = [
        tensor.detach().to(device, copy=True).requires_grad_()
        for tensor in (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.raw_densities)
    ]
    return Gaussians(*leaves, density_unit=gaussians.density_unit, kernel=gaussians.kernel)


def gradients(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """Gradients by parameter name, in float64 on the host."""
    named = {
        "means": gaussians.means,
        "log_scales": gaussians.log_scales,
        "quaternions": gaussians.quaternions,
        "raw_densities": gaussians.raw_densities,
    }
    return {name: tensor.grad.double().cpu() for name, tensor in named.items() if tensor.grad is not None}
