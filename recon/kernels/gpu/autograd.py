"""project and voxelize on a GPU: autograd functions of the raw parameters."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.ray_model import RayModel
from recon.base.volume import Grid
from recon.kernels.gpu import require
from recon.kernels.gpu.engine import GpuPass


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor,
        unit: float, geometry: Geometry, faint: float, cut: float, model: RayModel, kernel: Kernel,
    ) -> Tensor:  # fmt: skip
        run = _pass(means, log_scales, quaternions, raw, unit, kernel)
        views = [run.view(geometry, view, faint, cut, model) for view in range(geometry.n_views)]
        ctx.state = (run, views)
        return torch.stack([view.image for view in views])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        run, views = ctx.state
        run.clear()
        for view, slope in zip(views, gradient, strict=True):
            view.backward(slope.contiguous())
        return (*run.gradients(), None, None, None, None, None, None)


class _Voxelize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor,
        unit: float, grid: Grid, faint: float, cut: float, kernel: Kernel,
    ) -> Tensor:  # fmt: skip
        run = _pass(means, log_scales, quaternions, raw, unit, kernel)
        box = run.box(grid, faint, cut)
        ctx.state = (run, box)
        return box.density

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        run, box = ctx.state
        run.clear()
        box.backward(gradient.contiguous())
        return (*run.gradients(), None, None, None, None, None)


def _pass(means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float, kernel: Kernel) -> GpuPass:
    require(means.device)
    p, s, q, r = (t.detach().contiguous() for t in (means, log_scales, quaternions, raw))
    return GpuPass(p, s, q, r, unit, kernel)


def project(
    means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor,
    unit: float, geometry: Geometry, faint: float, cut: float, model: RayModel, kernel: Kernel = Kernel.GAUSSIAN,
) -> Tensor:  # fmt: skip
    """Line integrals [view, row, col]; `faint` in units of the image, `cut` in σ; differentiable in the tensors."""
    return _Project.apply(means, log_scales, quaternions, raw, unit, geometry, faint, cut, model, kernel)


def voxelize(
    means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor,
    unit: float, grid: Grid, faint: float, cut: float, kernel: Kernel = Kernel.GAUSSIAN,
) -> Tensor:  # fmt: skip
    """Density [z, y, x] at the grid's voxel centres; `faint` a density, `cut` in σ; differentiable in the tensors."""
    return _Voxelize.apply(means, log_scales, quaternions, raw, unit, grid, faint, cut, kernel)
