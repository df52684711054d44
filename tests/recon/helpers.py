"""Gaussians as leaves of a torch graph, for gradient comparisons; and many steps of a fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.optimise import FitState, step
from recon.splatting.problem import FitProblem
from recon.splatting.settings import FitSettings
from recon.voxels.projector import Projector, project


def in_double(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians as float64 leaves, so that the reference implementation runs and collects gradients."""
    leaves = [
        tensor.detach().double().requires_grad_()
        for tensor in (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.raw_densities)
    ]
    return Gaussians(leaves[0], leaves[1], leaves[2], leaves[3], gaussians.density_unit, gaussians.kernel)


def as_leaves(gaussians: Gaussians, device: torch.device | None = None) -> Gaussians:
    """The same Gaussians as float32 leaves that collect gradients, on a device if one is given."""
    leaves = [
        tensor.detach().to(device, copy=True).requires_grad_()
        for tensor in (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.raw_densities)
    ]
    return Gaussians(leaves[0], leaves[1], leaves[2], leaves[3], gaussians.density_unit, gaussians.kernel)


def gradients(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """Gradients by parameter name, in float64 on the host."""
    named = {
        "means": gaussians.means,
        "log_scales": gaussians.log_scales,
        "quaternions": gaussians.quaternions,
        "raw_densities": gaussians.raw_densities,
    }
    return {name: tensor.grad.double().cpu() for name, tensor in named.items() if tensor.grad is not None}


def run_steps(
    state: FitState,
    problem: FitProblem,
    settings: FitSettings,
    steps: int,
    on_step: Callable[[FitState], bool] | None = None,
) -> FitState:
    """Make `steps` steps of a full schedule; `on_step` may end it early by returning True."""
    for k in range(steps):
        step(state, problem, settings, k / max(1, steps))
        if on_step is not None and on_step(state):
            break
    return state


def assert_transpose(projector: Projector, rng: np.random.Generator, rel: float, abs: float = 0.0) -> tuple[F32, F32]:
    """Assert <A x, p> = <x, Aᵀ p> for a random volume x and projections p; returns x and A x."""
    volume = rng.random(projector.grid.shape, dtype=np.float32)
    views = rng.random(projector.projection_shape, dtype=np.float32)
    forward = projector.forward(volume)
    left = np.vdot(forward.astype(np.float64), views)
    right = np.vdot(volume.astype(np.float64), projector.adjoint(views))
    assert left == pytest.approx(right, rel=rel, abs=abs)
    return volume, forward


def data_residual(volume: Volume, projections: F32, geometry: Geometry, weights: F32 | None = None) -> float:
    """||A x - p|| / ||p||: the share of the line integrals [view, row, col] that the volume does not explain.

    Args:
        weights: of the rays; None: equal weights. Rays of weight 0 do not count.
    """
    root = np.float32(1) if weights is None else np.sqrt(weights)
    known = projections if weights is None else np.where(weights > 0, projections, np.float32(0))
    return float(np.linalg.norm(root * (project(volume, geometry) - known)) / np.linalg.norm(root * known))
