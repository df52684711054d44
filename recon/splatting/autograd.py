"""Project, Voxelize: the operations of a backend as torch functions with gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid
from recon.splatting.backend import Backend, Cpu, Pass


class Renderer(NamedTuple):
    """The values that are needed to interpret raw parameters: density unit, kernel and backend."""

    unit: float
    kernel: Kernel
    backend: Backend[Any]


class Project(torch.autograd.Function):
    """Projection of the raw parameters, computed by a backend. The backward pass renders each projection again, to save
    memory."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, renderer: Renderer,
        geometry: Geometry, how: tuple[float, float, RayModel],
    ) -> Tensor:  # fmt: skip
        """Images [view, row, col]. `how` contains the faintness limit, the truncation in standard deviations, and the
        ray model."""
        ctx.save_for_backward(means, log_scales, quaternions, raw)
        ctx.given = renderer, geometry, how
        run = _begin((means, log_scales, quaternions, raw), renderer)
        images = means.new_empty((geometry.n_views, *geometry.detector_shape))
        for view, image in enumerate(images):
            image.copy_(torch.as_tensor(run.view(geometry, view, *how).image))
        return images

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        renderer, geometry, how = ctx.given
        run = _begin(ctx.saved_tensors, renderer)
        for view, slope in enumerate(gradient):
            run.view(geometry, view, *how).backward(_native(slope, renderer.backend))
        return (*map(torch.as_tensor, run.gradients()), *[None] * 3)


class Voxelize(torch.autograd.Function):
    """Voxelization of the raw parameters, computed by a backend."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, renderer: Renderer, grid: Grid,
        how: tuple[float, float],
    ) -> Tensor:  # fmt: skip
        """Density [z, y, x]. `how` contains the faintness limit, and the truncation in standard deviations."""
        ctx.save_for_backward(means, log_scales, quaternions, raw)
        ctx.given = renderer, grid, how
        run = _begin((means, log_scales, quaternions, raw), renderer)
        return torch.as_tensor(run.box(grid, *how).density)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        renderer, grid, how = ctx.given
        run = _begin(ctx.saved_tensors, renderer)
        run.box(grid, *how).backward(_native(gradient, renderer.backend))
        return (*map(torch.as_tensor, run.gradients()), *[None] * 3)


def _begin(parameters: Sequence[Tensor], renderer: Renderer) -> Pass[Any]:
    means, log_scales, quaternions, raw = (_native(tensor, renderer.backend) for tensor in parameters)
    return renderer.backend.begin(means, log_scales, quaternions, raw, renderer.unit, renderer.kernel)


def _native(tensor: Tensor, backend: Backend[Any]) -> Any:
    """The values as an array of the backend. Contiguous values are not copied."""
    values = tensor.detach().contiguous()
    return values.numpy() if isinstance(backend, Cpu) else values
