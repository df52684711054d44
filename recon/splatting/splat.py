"""project and voxelize: Gaussians to line integrals and to voxels, differentiable.

The implementation follows from the tensors: float32 on the CPU uses the threaded CPU kernels, float32 on a CUDA device
the GPU kernels. float64 (or `implementation="reference"`) uses the reference implementation, which runs on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.backend import Backend, Cpu
from recon.splatting.gaussians import Gaussians, turned_by_rows

if TYPE_CHECKING:
    from torch import Tensor

Implementation = Literal["auto", "cpu", "gpu", "reference"]


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
    check_arguments(project, locals())
    import torch

    from recon.kernels import reference
    from recon.splatting.autograd import Project

    rays = model or RayModel()
    chosen = geometry if views is None else geometry.select(views)
    g, which = turned_by_rows(gaussians, chosen, -1), _chosen(gaussians, implementation)
    chosen = chosen.at_row(0)
    if which == "reference":
        parameters = (g.means, g.scales, g.quaternions, g.densities)
        length = rays.length(chosen)
        images = []
        for view in range(chosen.n_views):
            exact = None
            if chosen.is_cone and rays.exact_above < math.inf:
                exact = reference.affine_error(*parameters[:3], chosen, view, g.kernel) > rays.exact_above
            images.append(reference.project_view(parameters, chosen, view, exact=exact, length=length, kernel=g.kernel))
        return torch.stack(images)
    cut = truncation or Truncation()
    return Project.apply(*_raw(g, which), chosen, (_faint(cut, g, chosen), cut.sigmas, rays))


def voxelize(
    gaussians: Gaussians, grid: Grid, *, truncation: Truncation | None = None, implementation: Implementation = "auto"
) -> Tensor:
    """Density [z, y, x] (1/mm) of the Gaussians at the centres of any grid's voxels. Raises as `project`."""
    check_arguments(voxelize, locals())
    import torch

    from recon.kernels import reference
    from recon.splatting.autograd import Voxelize

    g, which = gaussians, _chosen(gaussians, implementation)
    if which == "reference":
        z, y, x = (torch.from_numpy(axis).to(g.means.dtype) for axis in grid.coordinates())
        return reference.voxelize(g.means, g.scales, g.quaternions, g.densities, (z, y, x), g.kernel)
    cut = truncation or Truncation()
    return Voxelize.apply(*_raw(g, which), grid, (cut.faint * g.density_unit, cut.sigmas))


def voxel_means(
    gaussians: Gaussians, grid: Grid, geometry: Geometry, *, truncation: Truncation | None = None
) -> Tensor:
    """Density [z, y, x] (1/mm) of a fit's Gaussians, each voxel the mean over its edges; raises as `voxelize`.

    A mean over h has the variance h²/12. Gaussians that were fitted to views whose rays have no width hold that of a
    pixel, p²/12, already; so voxels of a pixel take the centres' values.
    """
    pixel, edge = 0.0 if geometry.width.pixel else geometry.sample_pitch, min(grid.spacing)
    parts = max(1, math.ceil(edge / (2 * geometry.sample_pitch)))  # of a coarse voxel's edge, whose box is no Gaussian
    nz, ny, nx = (parts * n for n in grid.shape)
    slices = None if grid.slice_pitch is None else grid.slice_pitch / parts
    fine = Grid((nz, ny, nx), grid.voxel_size / parts, grid.centre, slices)
    density = voxelize(gaussians.widened(((edge / parts) ** 2 - pixel**2) / 12), fine, truncation=truncation)
    if parts == 1:
        return density
    z, y, x = grid.shape
    return density.reshape(z, parts, y, parts, x, parts).mean(dim=(1, 3, 5))


def _raw(g: Gaussians, implementation: Implementation) -> tuple[Any, ...]:
    """The first arguments of `Project` and `Voxelize`."""
    from recon.splatting.autograd import Renderer

    if implementation == "gpu":
        Gpu: Any = import_module("recon.kernels.gpu.engine").Gpu  # loads triton, so only if a GPU is used

        backend: Backend[Any] = Gpu(g.means.device)
    else:
        backend = Cpu()
    return g.means, g.log_scales, g.quaternions, g.raw_densities, Renderer(g.density_unit, g.kernel, backend)


def _faint(truncation: Truncation, gaussians: Gaussians, geometry: Geometry) -> float:
    """Line integral below which a footprint is cut off."""
    return truncation.faint * gaussians.density_unit * geometry.sample_pitch * geometry.detector_shape[1]


def _chosen(gaussians: Gaussians, implementation: Implementation) -> Implementation:
    import torch

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
