"""The readable twin: projection and voxelisation of Gaussians as dense float64 sums, the oracle of every fast kernel.

    density   σ(x) = Σ_i ρ_i exp(-1/2 (x - p_i)ᵀ Σ_i⁻¹ (x - p_i)),   Σ = R S² Rᵀ          (Zha et al. 2024)
    ray       ∫ σ dt = Σ_i ρ_i μ_i exp(-1/2 (u - m_i)ᵀ Σ₂⁻¹ (u - m_i))                    (parallel beam: exact)

With the covariance in view coordinates split as [[Σ₂, v], [vᵀ, f]] (f along the ray), the corrected factor is
μ = sqrt(2π (f - vᵀ Σ₂⁻¹ v)): the Schur complement, never negative, with no difference of large determinants.
Everything is plain torch, so autograd gives the gradients that the fast kernels are held against.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices [n, 3, 3] of quaternions [n, 4] (w, x, y, z), of any non-zero length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1, eps=1e-30).unbind(1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), 1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), 1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), 1),
    )
    return torch.stack(rows, 1)


def covariances(scales: Tensor, quaternions: Tensor) -> Tensor:
    """Σ = R S² Rᵀ, [n, 3, 3], from standard deviations [n, 3] and quaternions [n, 4]."""
    shaped = rotation_matrices(quaternions) * scales[:, None, :]
    return shaped @ shaped.transpose(1, 2)


def project_view(
    means: Tensor,  # [n, 3] mm, (x, y, z)
    scales: Tensor,  # [n, 3] mm
    quaternions: Tensor,  # [n, 4]
    densities: Tensor,  # [n] 1/mm
    angle: float,
    detector_shape: tuple[int, int],
    pixel_pitch: float,
    axis_col: float,
) -> Tensor:
    """Line integrals [row, col] of one parallel view; every Gaussian on every pixel, no cut-off."""
    rows, cols = detector_shape
    c, s = math.cos(angle), math.sin(angle)
    view = means.new_tensor([[c, s, 0.0], [0.0, 0.0, 1.0], [-s, c, 0.0]])  # rows: u, v, ray
    centre = means @ view.T
    covariance = view @ covariances(scales, quaternions) @ view.T
    flat, across, along = covariance[:, :2, :2], covariance[:, :2, 2:], covariance[:, 2:, 2:]
    inverse = torch.linalg.inv(flat)
    schur = (along - across.transpose(1, 2) @ inverse @ across).reshape(-1)
    factor = torch.sqrt(2 * math.pi * schur)

    u = (torch.arange(cols, dtype=means.dtype) - axis_col) * pixel_pitch
    v = (torch.arange(rows, dtype=means.dtype) - (rows - 1) / 2) * pixel_pitch
    grid = torch.stack(torch.broadcast_tensors(u[None, :], v[:, None]), -1)
    offset = grid[None] - centre[:, None, None, :2]
    exponent = torch.einsum("nrci,nij,nrcj->nrc", offset, inverse, offset)
    return torch.einsum("n,nrc->rc", densities * factor, torch.exp(-0.5 * exponent))


def voxelize(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    densities: Tensor,
    axes: tuple[Tensor, Tensor, Tensor],  # z [nz], y [ny], x [nx] in mm
) -> Tensor:
    """Density [z, y, x] at voxel centres; every Gaussian in every voxel, no cut-off."""
    z, y, x = axes
    grid = torch.stack(torch.broadcast_tensors(x[None, None, :], y[None, :, None], z[:, None, None]), -1)
    offset = grid[None] - means[:, None, None, None, :]
    inverse = torch.linalg.inv(covariances(scales, quaternions))
    exponent = torch.einsum("nzyxi,nij,nzyxj->nzyx", offset, inverse, offset)
    return torch.einsum("n,nzyx->zyx", densities, torch.exp(-0.5 * exponent))
