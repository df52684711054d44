"""project and voxelize: Gaussians to line integrals and to voxels, differentiable.

The implementation follows from the tensors: float32 on the CPU uses the threaded CPU kernels, float32 on a CUDA device
the GPU kernels. float64 (or `implementation="reference"`) uses the reference implementation, which runs on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.ray_model import RayModel, Truncation
from recon.base.volume import Grid
from recon.kernels import reference
from recon.kernels.cpu.activation import F32
from recon.kernels.cpu.engine import Active, Gradients, Scratch, grid_layout, render_view
from recon.kernels.cpu.footprints import footprint_table
from recon.splatting.gaussians import Gaussians

Implementation = Literal["auto", "cpu", "gpu", "reference"]


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor,
        unit: float, geometry: Geometry, faint: float, cut: float, model: RayModel, kernel: Kernel,
    ) -> Tensor:  # fmt: skip
        active = Active.of(_array(means), _array(log_scales), _array(quaternions), _array(raw), unit, kernel)
        images = np.empty((geometry.n_views, *geometry.detector_shape), np.float32)
        shared, views = Scratch.of(len(active.densities), geometry.detector_shape), []
        differentiable = any(ctx.needs_input_grad)
        for view, image in enumerate(images):
            # Each view needs its own table until its backward pass, if there will be one.
            scratch = replace(shared, table=footprint_table(len(active.densities))) if differentiable else shared
            rendered = render_view(active, geometry, view, faint, cut, model, image=image, scratch=scratch)
            if differentiable:
                views.append(rendered)
        ctx.state = (_array(quaternions), _array(raw), unit, views)
        return torch.from_numpy(images)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        quaternions, raw, unit, views = ctx.state
        into = Gradients.zeros(len(raw))
        centres = np.empty((len(raw), 2), np.float32)
        for view, image in zip(views, gradient.contiguous().numpy(), strict=True):
            view.backward(image, into, centres)
        return (*(torch.from_numpy(a) for a in into.to_raw(quaternions, raw, unit)), None, None, None, None, None, None)


class _Voxelize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor,
        unit: float, grid: Grid, faint: float, cut: float, kernel: Kernel,
    ) -> Tensor:  # fmt: skip
        active = Active.of(_array(means), _array(log_scales), _array(quaternions), _array(raw), unit, kernel)
        layout = grid_layout(active, grid, faint, cut)
        ctx.state = (_array(quaternions), _array(raw), layout, unit)
        return torch.from_numpy(np.ascontiguousarray(layout.fill()))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        quaternions, raw, layout, unit = ctx.state
        into = Gradients.zeros(len(raw))
        layout.backward(gradient.contiguous().numpy(), into.means, into.log_scales, into.rotations, into.densities)
        return (*(torch.from_numpy(a) for a in into.to_raw(quaternions, raw, unit)), None, None, None, None, None)


def _array(tensor: Tensor) -> F32:
    return tensor.detach().contiguous().numpy()


def project(
    gaussians: Gaussians,
    geometry: Geometry,
    views: Sequence[int] | slice | None = None,
    *,
    truncation: Truncation | None = None,
    model: RayModel | None = None,
    implementation: Implementation = "auto",
) -> Tensor:
    """Line integrals [view, row, col] (dimensionless) of the Gaussians; exact for a parallel beam up to truncation.

    In a cone the footprint is affine, or integrated along the true ray if `model` asks for it. Differentiable in all
    four parameter tensors. The reference implementation does not truncate.

    Raises:
        ValueError: the implementation does not support tensors of this type or on this device.
        ImportError: the tensors are on a CUDA device and triton is not installed.
    """
    rays = model or RayModel()
    chosen = geometry if views is None else geometry.select(views)
    g, which = gaussians, _chosen(gaussians, implementation)
    if which == "reference":
        parameters = (g.means, g.scales, g.quaternions, g.densities)
        length = rays.length(chosen)
        images = []
        for view in range(chosen.n_views):
            exact = None
            if chosen.is_cone and rays.exact_above < math.inf:
                exact = reference.affine_error(*parameters[:3], chosen, view, g.kernel) > rays.exact_above
            images.append(
                reference.project_view(*parameters, chosen, view, exact=exact, length=length, kernel=g.kernel)
            )
        return torch.stack(images)
    cut, raw = truncation or Truncation(), (g.means, g.log_scales, g.quaternions, g.raw_densities)
    if which == "gpu":
        from recon.kernels.gpu import autograd  # loads triton, so only if a GPU is used

        return autograd.project(*raw, g.density_unit, chosen, _faint(cut, g, chosen), cut.sigmas, rays, g.kernel)
    return _Project.apply(*raw, g.density_unit, chosen, _faint(cut, g, chosen), cut.sigmas, rays, g.kernel)


def voxelize(
    gaussians: Gaussians, grid: Grid, *, truncation: Truncation | None = None, implementation: Implementation = "auto"
) -> Tensor:
    """Density [z, y, x] (1/mm) of the Gaussians at the centres of any grid's voxels. Raises as `project`."""
    g, which = gaussians, _chosen(gaussians, implementation)
    if which == "reference":
        z, y, x = (torch.from_numpy(axis).to(g.means.dtype) for axis in grid.coordinates())
        return reference.voxelize(g.means, g.scales, g.quaternions, g.densities, (z, y, x), g.kernel)
    cut, raw = truncation or Truncation(), (g.means, g.log_scales, g.quaternions, g.raw_densities)
    faint = cut.faint * g.density_unit
    if which == "gpu":
        from recon.kernels.gpu import autograd

        return autograd.voxelize(*raw, g.density_unit, grid, faint, cut.sigmas, g.kernel)
    return _Voxelize.apply(*raw, g.density_unit, grid, faint, cut.sigmas, g.kernel)


def _faint(truncation: Truncation, gaussians: Gaussians, geometry: Geometry) -> float:
    """Line integral below which a footprint is cut off."""
    return truncation.faint * gaussians.density_unit * geometry.sample_pitch * geometry.detector_shape[1]


def _chosen(gaussians: Gaussians, implementation: Implementation) -> Implementation:
    dtype, device = gaussians.means.dtype, gaussians.means.device.type
    suited: Implementation = "reference" if dtype != torch.float32 else "cpu" if device == "cpu" else "gpu"
    chosen = suited if implementation == "auto" else implementation
    if chosen != "reference" and dtype != torch.float32:
        raise ValueError(f"the {chosen} implementation works in float32, the Gaussians are {dtype}")
    if chosen != "gpu" and device != "cpu":
        raise ValueError(
            f"the {chosen} implementation runs on the cpu, the Gaussians are {dtype} on {device}: move them"
        )
    return chosen
