"""project and voxelize: differentiable functions that compute line integrals, or voxels, of Gaussians.

Tensors are float32. On the CPU, the threaded CPU kernels are used; on a CUDA device, the GPU kernels.
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
    """Line integrals [view, row, col] (dimensionless) of the Gaussians. For a parallel beam the integrals are exact,
    except that each Gaussian is cut off. For a cone beam, `model` chooses how a Gaussian is integrated: with an affine
    approximation of its footprint, or exactly along each ray. The result is differentiable in all four parameter
    tensors.

    Raises:
        ValueError: the tensors are not float32.
        ImportError: the tensors are on a CUDA device and triton is not installed.
    """
    check_arguments(project, locals())
    from recon.splatting.autograd import Project

    chosen = geometry if views is None else geometry.select(views)
    g = turned_by_rows(gaussians, chosen, -1)
    chosen = chosen.at_row(0)
    cutoff = truncation or Truncation()
    # line integral at which footprints are cut off
    faint = cutoff.faint * g.density_unit * chosen.sample_pitch * chosen.detector_shape[1]
    return Project.apply(*_raw(g), chosen, (faint, cutoff.sigmas, model or RayModel()))


def voxelize(gaussians: Gaussians, grid: Grid, *, truncation: Truncation | None = None) -> Tensor:
    """Density [z, y, x] (1/mm) of the Gaussians at the voxel centres of a grid. Errors as in `project`."""
    check_arguments(voxelize, locals())
    from recon.splatting.autograd import Voxelize

    cutoff = truncation or Truncation()
    return Voxelize.apply(*_raw(gaussians), grid, (cutoff.faint * gaussians.density_unit, cutoff.sigmas))


def voxel_means(
    gaussians: Gaussians, grid: Grid, geometry: Geometry, *, truncation: Truncation | None = None
) -> Tensor:
    """Density [z, y, x] (1/mm) of fitted Gaussians, averaged over each voxel. Errors as in `voxelize`.

    A mean over the length h adds the variance h²/12. Gaussians fitted to projections with rays of zero width already
    contain the variance of a pixel, p²/12. So voxels of pixel size get the values at their centres.
    """
    pixel, edge = 0.0 if geometry.width.pixel else geometry.sample_pitch, min(grid.spacing)
    # a coarse voxel is divided into this many parts along each edge, because a Gaussian is a bad approximation of its
    # box
    parts = max(1, math.ceil(edge / (2 * geometry.sample_pitch)))
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
        raise ValueError(f"Gaussians must be float32, got {g.means.dtype}; convert their tensors")
    device = g.means.device
    backend = backend_for("cpu" if device.type == "cpu" else str(device))
    return g.means, g.log_scales, g.quaternions, g.raw_densities, Renderer(g.density_unit, g.kernel, backend)
