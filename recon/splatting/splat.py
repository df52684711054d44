"""project and voxelize: Gaussians to line integrals and to voxels, differentiable.

Tensors are float32: on the CPU the threaded CPU kernels are used, on a CUDA device the GPU kernels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.backend import backend_for
from recon.splatting.gaussians import Gaussians, turned_by_rows

if TYPE_CHECKING:
    from torch import Tensor


def project(
    gaussians: Gaussians,
    geometry: Geometry,
    views: Sequence[int] | slice | None = None,
    *,
    truncation: Truncation | None = None,
    model: RayModel | None = None,
) -> Tensor:
    """Line integrals [view, row, col] (dimensionless) of the Gaussians; exact for a parallel beam up to truncation.

    In a cone the footprint is affine, or integrated along the true ray if `model` asks for it. Differentiable in all
    four parameter tensors.

    Raises:
        ValueError: tensors that are not float32.
        ImportError: the tensors are on a CUDA device and triton is not installed.
    """
    check_arguments(project, locals())
    from recon.splatting.autograd import Project

    chosen = geometry if views is None else geometry.select(views)
    g = turned_by_rows(gaussians, chosen, -1)
    chosen = chosen.at_row(0)
    cut = truncation or Truncation()
    faint = cut.faint * g.density_unit * chosen.sample_pitch * chosen.detector_shape[1]  # line integral of a cut
    return Project.apply(*_raw(g), chosen, (faint, cut.sigmas, model or RayModel()))


def voxelize(gaussians: Gaussians, grid: Grid, *, truncation: Truncation | None = None) -> Tensor:
    """Density [z, y, x] (1/mm) of the Gaussians at the centres of any grid's voxels. Raises as `project`."""
    check_arguments(voxelize, locals())
    from recon.splatting.autograd import Voxelize

    cut = truncation or Truncation()
    return Voxelize.apply(*_raw(gaussians), grid, (cut.faint * gaussians.density_unit, cut.sigmas))


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


def _raw(g: Gaussians) -> tuple[Any, ...]:
    """The first arguments of `Project` and `Voxelize`."""
    import torch

    from recon.splatting.autograd import Renderer

    if g.means.dtype != torch.float32:
        raise ValueError(f"Gaussians must be float32, these are {g.means.dtype}: convert their tensors")
    device = g.means.device
    backend = backend_for("cpu" if device.type == "cpu" else str(device))
    return g.means, g.log_scales, g.quaternions, g.raw_densities, Renderer(g.density_unit, g.kernel, backend)
