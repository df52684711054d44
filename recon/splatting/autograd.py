"""Project, Voxelize: the operations of a backend as functions that torch differentiates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid
from recon.splatting.backend import Backend, Cpu, Pass


class On(NamedTuple):
    """Unit of the densities, kernel and backend for raw parameters."""

    unit: float
    kernel: Kernel
    backend: Backend[Any]


class Project(torch.autograd.Function):
    """Projection of raw parameters on a backend. The backward pass renders each view again, and stores no table of
    it."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, on: On, geometry: Geometry,
        how: tuple[float, float, RayModel],
    ) -> Tensor:  # fmt: skip
        """Images [view, row, col]; `how` has the faintness limit, the truncation in standard deviations, and the
        rays."""
        ctx.save_for_backward(means, log_scales, quaternions, raw)
        ctx.given = on, geometry, how
        run = _begin((means, log_scales, quaternions, raw), on)
        images = means.new_empty((geometry.n_views, *geometry.detector_shape))
        for view, image in enumerate(images):
            image.copy_(torch.as_tensor(run.view(geometry, view, *how).image))
        return images

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        on, geometry, how = ctx.given
        run = _begin(ctx.saved_tensors, on)
        for view, slope in enumerate(gradient):
            run.view(geometry, view, *how).backward(_native(slope, on.backend))
        return (*map(torch.as_tensor, run.gradients()), *[None] * 3)


class Voxelize(torch.autograd.Function):
    """Voxelization of raw parameters on a backend."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, on: On, grid: Grid,
        how: tuple[float, float],
    ) -> Tensor:  # fmt: skip
        """Density [z, y, x]; `how` has the faintness limit, and the truncation in standard deviations."""
        ctx.save_for_backward(means, log_scales, quaternions, raw)
        ctx.given = on, grid, how
        run = _begin((means, log_scales, quaternions, raw), on)
        return torch.as_tensor(run.box(grid, *how).density)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        on, grid, how = ctx.given
        run = _begin(ctx.saved_tensors, on)
        run.box(grid, *how).backward(_native(gradient, on.backend))
        return (*map(torch.as_tensor, run.gradients()), *[None] * 3)


def _begin(parameters: Sequence[Tensor], on: On) -> Pass[Any]:
    means, log_scales, quaternions, raw = (_native(tensor, on.backend) for tensor in parameters)
    return on.backend.begin(means, log_scales, quaternions, raw, on.unit, on.kernel)


def _native(tensor: Tensor, backend: Backend[Any]) -> Any:
    """The values as an array of the backend, without a copy where they are contiguous."""
    values = tensor.detach().contiguous()
    return values.numpy() if isinstance(backend, Cpu) else values
