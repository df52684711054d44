"""Project, Voxelize: the operations of a backend as functions that torch differentiates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.ray_model import RayModel
from recon.base.volume import Grid
from recon.splatting.backend import Backend, Cpu, Pass


class Project(torch.autograd.Function):
    """Views of raw parameters on a backend. The backward pass renders each view again, and keeps no table of it."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float, kernel: Kernel,
        backend: Backend[Any], geometry: Geometry, faint: float, cut: float, model: RayModel,
    ) -> Tensor:  # fmt: skip
        ctx.save_for_backward(means, log_scales, quaternions, raw)
        ctx.given = (unit, kernel, backend), geometry, (faint, cut, model)
        run = _begin((means, log_scales, quaternions, raw), unit, kernel, backend)
        images = means.new_empty((geometry.n_views, *geometry.detector_shape))
        for view, image in enumerate(images):
            image.copy_(torch.as_tensor(run.view(geometry, view, faint, cut, model).image))
        return images

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        on, geometry, how = ctx.given
        run = _begin(ctx.saved_tensors, *on)
        for view, slope in enumerate(gradient):
            run.view(geometry, view, *how).backward(_native(slope, on[-1]))
        return (*map(torch.as_tensor, run.gradients()), *[None] * 7)


class Voxelize(torch.autograd.Function):
    """Voxels of raw parameters on a backend."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float, kernel: Kernel,
        backend: Backend[Any], grid: Grid, faint: float, cut: float,
    ) -> Tensor:  # fmt: skip
        ctx.save_for_backward(means, log_scales, quaternions, raw)
        ctx.given = (unit, kernel, backend), (grid, faint, cut)
        run = _begin((means, log_scales, quaternions, raw), unit, kernel, backend)
        return torch.as_tensor(run.box(grid, faint, cut).density)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        on, where = ctx.given
        run = _begin(ctx.saved_tensors, *on)
        run.box(*where).backward(_native(gradient, on[-1]))
        return (*map(torch.as_tensor, run.gradients()), *[None] * 6)


def _begin(parameters: Sequence[Tensor], unit: float, kernel: Kernel, backend: Backend[Any]) -> Pass[Any]:
    means, log_scales, quaternions, raw = (_native(tensor, backend) for tensor in parameters)
    return backend.begin(means, log_scales, quaternions, raw, unit, kernel)


def _native(tensor: Tensor, backend: Backend[Any]) -> Any:
    """The values as an array of the backend, without a copy where they are contiguous."""
    values = tensor.detach().contiguous()
    return values.numpy() if isinstance(backend, Cpu) else values
