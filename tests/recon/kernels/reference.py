"""Reference implementation, written for reading; the fast kernels for Gaussians are compared with it.

Projection and voxelisation are dense float64 sums over all Gaussians:

    density   σ(x) = Σ_i ρ_i exp(-1/2 (x - p_i)ᵀ Σ_i⁻¹ (x - p_i)),   Σ = R S² Rᵀ          (Zha et al. 2024)
    ray       ∫ σ dt = Σ_i ρ_i μ_i exp(-1/2 (u - m_i)ᵀ Σ₂⁻¹ (u - m_i))       (parallel beam: exact; cone: affine)

The covariance is mapped to the detector with the Jacobian of the projection at the centre, with a third row along the
ray. It is split as [[Σ₂, v], [vᵀ, f]]. Then the corrected factor is μ = sqrt(2π (f - vᵀ Σ₂⁻¹ v)). This is the Schur
complement, the square of the last pivot of Σ' = L Lᵀ. L is computed from J R S by orthogonal steps (QR), because for a
needle with an aspect ratio of 10⁴ the difference would vanish even in float64. The exact ray of a cone needs no
projection: with H = S⁻¹Rᵀ, δ from the source to the centre and D along the ray of a pixel,

    ∫ σ dt = Σ_i ρ_i sqrt(2π) |D| / |H D| exp(-1/2 |Hδ x HD|² / |HD|²)

If rays have a width, Σ₂ grows by it, and μ falls so that the mass is conserved (`cpu.wide_footprints`). Another
`Kernel` replaces exp(-q/2), with q the squared distance in standard deviations (in an image: its line integral), and
sqrt(2π) by its own length. The losses are below. Everything is plain torch, so that autograd gives the gradients for
comparison.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from itertools import product
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid
from recon.kernels.cpu.losses import ABSOLUTE, L1, L2, DataTerm, gaussian_window
from recon.splatting import splat
from recon.splatting.gaussians import Gaussians, turned_by_rows


def project(
    gaussians: Gaussians, geometry: Geometry, views: Any = None, *, model: RayModel | None = None,
    gpu: bool = False, **how: Any,
) -> Tensor:  # fmt: skip
    """`recon.splatting.splat.project`; for float64 Gaussians, the implementation of this module without truncation.

    Args:
        gpu: True: use the GPU kernels, which may be interpreted on CPU tensors.
    """
    if gaussians.means.dtype == torch.float32:
        with _kernels(gaussians, gpu):
            return splat.project(gaussians, geometry, views, model=model, **how)
    rays = model or RayModel()
    chosen = geometry if views is None else geometry.select(views)
    g = turned_by_rows(gaussians, chosen, -1)
    chosen = chosen.at_row(0)
    parameters, length, images = (g.means, g.scales, g.quaternions, g.densities), rays.length(chosen), []
    for view in range(chosen.n_views):
        exact = None
        if chosen.is_cone and rays.exact_above < math.inf:
            exact = affine_error(*parameters[:3], chosen, view, g.kernel) > rays.exact_above
        images.append(project_view(parameters, chosen, view, exact=exact, length=length, kernel=g.kernel))
    return torch.stack(images)


def on_grid(gaussians: Gaussians, grid: Grid, *, gpu: bool = False, **how: Any) -> Tensor:
    """`recon.splatting.splat.voxelize`; for float64 Gaussians, that of this module without truncation. `gpu`: as
    above."""
    if gaussians.means.dtype == torch.float32:
        with _kernels(gaussians, gpu):
            return splat.voxelize(gaussians, grid, **how)
    z, y, x = (torch.from_numpy(axis).to(gaussians.means.dtype) for axis in grid.coordinates())
    parameters = gaussians.means, gaussians.scales, gaussians.quaternions, gaussians.densities
    return voxelize(*parameters, (z, y, x), gaussians.kernel)


def _kernels(gaussians: Gaussians, gpu: bool) -> AbstractContextManager[object]:
    if not gpu:
        return nullcontext()
    engine = import_module("recon.kernels.gpu.engine")  # loads triton
    return patch.object(splat, "backend_for", lambda _: engine.Gpu(gaussians.means.device))


def density_profile(q: Tensor, kernel: Kernel) -> Tensor:
    """f of a kernel at squared distances q, in standard deviations."""
    return _profile(q, kernel, kernel.exponent)


def shadow_profile(q: Tensor, kernel: Kernel) -> Tensor:
    """Line integral of a kernel, divided by that through its centre, at squared distances q of the line."""
    return _profile(q, kernel, kernel.exponent + 0.5)


def _profile(q: Tensor, kernel: Kernel, exponent: float) -> Tensor:
    if kernel.is_compact:
        return (1 - q / kernel.radius**2).clamp(min=0) ** exponent
    return torch.exp(-0.5 * q)


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
    parameters: Sequence[Tensor],
    geometry: Geometry,
    view: int,
    *,
    exact: Tensor | None = None,  # bool [n]: Gaussians integrated along the true rays of a cone; None: none
    length: float = 0.0,  # mm, replaces μ if not 0: the uncorrected factor
    kernel: Kernel = Kernel.GAUSSIAN,
) -> Tensor:
    """Line integrals [row, col] of one projection: every Gaussian on every pixel, without truncation.

    Args:
        parameters: means [n, 3] mm (x, y, z), standard deviations [n, 3] mm, quaternions [n, 4], densities [n] 1/mm.
    """
    means, scales, quaternions, densities = parameters
    means = means - means.new_tensor(geometry.centres[view])
    in_view = means @ means.new_tensor(geometry.axes(view)).T  # along columns, rows and beam
    seen = in_front(means, geometry, view)
    rays = torch.zeros_like(seen) if exact is None or not geometry.is_cone else exact & seen
    flat = seen & ~rays
    image = _affine(in_view[flat], scales[flat], quaternions[flat], densities[flat], geometry, view, length, kernel)
    return image + _along_rays(means[rays], scales[rays], quaternions[rays], densities[rays], geometry, view, kernel)


def in_front(means: Tensor, geometry: Geometry, view: int) -> Tensor:
    """Mask [n] of the Gaussians at least 0.01 sod in front of the source plane; all for a parallel beam."""
    if not geometry.is_cone:
        return torch.ones(means.shape[0], dtype=torch.bool)
    return geometry.sod + means.detach() @ means.new_tensor(geometry.axes(view)[2]) > 0.01 * geometry.sod


def affine_error(
    means: Tensor, scales: Tensor, quaternions: Tensor, geometry: Geometry, view: int, kernel: Kernel = Kernel.GAUSSIAN
) -> Tensor:
    """ε [n], the estimate of `cpu.footprints` for the relative L2 error of a cone's affine footprints; no gradient."""
    means, scales, quaternions = means.detach(), scales.detach(), quaternions.detach()
    axes, means = means.new_tensor(geometry.axes(view)), means - means.new_tensor(geometry.centres[view])
    in_view, focal = means @ axes.T, geometry.sdd / geometry.pixel_pitch
    centre, jacobian = to_detector(in_view, geometry)
    turn = jacobian @ axes
    flat = (turn @ covariances(scales, quaternions) @ turn.transpose(1, 2))[:, :2, :2]
    whiten = rotation_matrices(quaternions).transpose(1, 2) / scales[:, :, None]
    source = (whiten @ (means + geometry.sod * axes[2])[:, :, None])[..., 0]
    eta = 1 / (source * source).sum(1)
    step = whiten @ axes[:2].T * ((in_view[:, 2] + geometry.sod) / focal)[:, None, None]  # H for a step of one pixel
    alpha = eta[:, None] * torch.einsum("nk,nku->nu", source, step)
    beta = centre / (focal**2 + (centre * centre).sum(1, keepdim=True))

    def between(x: Tensor, y: Tensor) -> Tensor:
        return torch.einsum("nu,nuv,nv->n", x, flat, y)

    bb, ab, aa, ee = kernel.affine_terms
    first = bb * between(beta, beta) + ab * between(alpha, beta) + aa * between(alpha, alpha)
    return torch.sqrt(first + ee * eta**2)


def pixels(geometry: Geometry, view: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Columns [col] and rows [row], relative to the pixel of the object's origin."""
    rows, cols = geometry.detector_shape
    col, row = geometry.origin(view)
    return torch.arange(cols, dtype=like.dtype) - col, torch.arange(rows, dtype=like.dtype) - row


def to_detector(in_view: Tensor, geometry: Geometry) -> tuple[Tensor, Tensor]:
    """Centres [n, 2] in px and the Jacobian [n, 3, 3] (px/mm, 1 along the ray) of points along the view's axes."""
    n = in_view.shape[0]
    if not geometry.is_cone:
        pitch = geometry.pixel_pitch
        return in_view[:, :2] / pitch, torch.diag(in_view.new_tensor([1 / pitch, 1 / pitch, 1.0])).expand(n, 3, 3)
    x, y = in_view[:, 0], in_view[:, 1]
    z = in_view[:, 2] + geometry.sod
    f, far = geometry.sdd / geometry.pixel_pitch, torch.sqrt(x * x + y * y + z * z)
    zero = torch.zeros_like(z)
    rows = (
        torch.stack((f / z, zero, -f * x / z**2), 1),
        torch.stack((zero, f / z, -f * y / z**2), 1),
        torch.stack((x / far, y / far, z / far), 1),
    )
    return f * in_view[:, :2] / z[:, None], torch.stack(rows, 1)


def _affine(
    in_view: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    densities: Tensor,
    geometry: Geometry,
    view: int,
    length: float,
    kernel: Kernel,
) -> Tensor:
    centre, jacobian = to_detector(in_view, geometry)
    turn = jacobian @ in_view.new_tensor(geometry.axes(view))
    shaped = turn @ rotation_matrices(quaternions) * scales[:, None, :]
    lower = torch.linalg.qr(shaped.transpose(1, 2)).R.transpose(1, 2)  # L, up to signs of its columns
    factor = torch.full_like(densities, length) if length > 0 else kernel.length * lower[:, 2, 2].abs()
    if geometry.width:
        narrow, lower = lower, _widened(lower, jacobian, in_view, geometry, view)
        factor = factor * (narrow[:, 0, 0] * narrow[:, 1, 1]).abs() / (lower[:, 0, 0] * lower[:, 1, 1])
    u, v = pixels(geometry, view, in_view)
    grid = torch.stack(torch.broadcast_tensors(u[None, :], v[:, None]), -1)
    offset = grid[None] - centre[:, None, None, :]
    first = offset[..., 0] / lower[:, 0, 0, None, None]
    second = (offset[..., 1] - lower[:, 1, 0, None, None] * first) / lower[:, 1, 1, None, None]
    return torch.einsum("n,nrc->rc", densities * factor, shadow_profile(first * first + second * second, kernel))


def _widened(lower: Tensor, jacobian: Tensor, in_view: Tensor, geometry: Geometry, view: int) -> Tensor:
    """L [n, 2, 2] of the covariance on the detector, including that of the pixel and of the path of the centre."""
    axes = in_view.new_tensor(geometry.axes(view))
    x, y, _ = (in_view @ axes).unbind(1)
    path = jacobian[:, :2] @ (torch.stack((-y, x, torch.zeros_like(x)), 1) @ axes.T)[:, :, None]
    flat, own = lower[:, :2, :2], torch.eye(2, dtype=lower.dtype) * geometry.width.variance
    moved = geometry.width.arc**2 / 12 * path @ path.transpose(1, 2)
    return torch.linalg.cholesky(flat @ flat.transpose(1, 2) + own + moved)


def _along_rays(
    means: Tensor, scales: Tensor, quaternions: Tensor, densities: Tensor, geometry: Geometry, view: int, kernel: Kernel
) -> Tensor:
    u, v = pixels(geometry, view, means)
    if means.shape[0] == 0:
        return means.new_zeros((v.shape[0], u.shape[0]))
    axes = means.new_tensor(geometry.axes(view))
    focal = torch.full((1, 1), geometry.sdd / geometry.pixel_pitch, dtype=means.dtype)
    ray = torch.stack(torch.broadcast_tensors(u[None, :], v[:, None], focal), -1) @ axes  # [row, col, 3]
    whiten = rotation_matrices(quaternions).transpose(1, 2) / scales[:, :, None]  # H
    centre = (whiten @ (means + geometry.sod * axes[2])[:, :, None])[:, None, None, :, 0]
    white = torch.einsum("nij,rcj->nrci", whiten, ray)
    power = (white * white).sum(-1)
    miss = torch.linalg.cross(centre.expand_as(white), white)
    factor = kernel.length * torch.linalg.norm(ray, dim=-1) / torch.sqrt(power)
    return torch.einsum("n,nrc->rc", densities, factor * shadow_profile((miss * miss).sum(-1) / power, kernel))


def voxelize(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    densities: Tensor,
    axes: tuple[Tensor, Tensor, Tensor],  # z [nz], y [ny], x [nx] in mm
    kernel: Kernel = Kernel.GAUSSIAN,
) -> Tensor:
    """Density [z, y, x] at voxel centres: every Gaussian in every voxel, without truncation."""
    z, y, x = axes
    grid = torch.stack(torch.broadcast_tensors(x[None, None, :], y[None, :, None], z[:, None, None]), -1)
    offset = grid[None] - means[:, None, None, None, :]
    whiten = rotation_matrices(quaternions).transpose(1, 2) / scales[:, :, None]  # S⁻¹Rᵀ
    white = torch.einsum("nij,nzyxj->nzyxi", whiten, offset)
    return torch.einsum("n,nzyx->zyx", densities, density_profile((white * white).sum(-1), kernel))


def ssim(image: Tensor, target: Tensor, c1: float = 0.01**2, c2: float = 0.03**2) -> Tensor:
    """Mean of `ssim_map`."""
    return ssim_map(image, target, c1, c2).mean()


def ssim_map(image: Tensor, target: Tensor, c1: float = 0.01**2, c2: float = 0.03**2) -> Tensor:
    """Structural similarity [row, col] of two images (Wang et al. 2004): 11 x 11 Gaussian window, zeros outside.

    c1 and c2 are (0.01 L)² and (0.03 L)² for a data range L; the fit works on data scaled so that L is about 1.
    """
    taps = torch.from_numpy(gaussian_window()).to(image.dtype)

    def blur(x: Tensor) -> Tensor:
        padded = x[None, None]
        across = torch.nn.functional.conv2d(padded, taps[None, None, None, :], padding=(0, 5))
        return torch.nn.functional.conv2d(across, taps[None, None, :, None], padding=(5, 0))[0, 0]

    mean_x, mean_y = blur(image), blur(target)
    var_x, var_y = blur(image * image) - mean_x**2, blur(target * target) - mean_y**2
    covariance = blur(image * target) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (var_x + var_y + c2)
    return luminance * structure


def data_term(image: Tensor, target: Tensor, term: DataTerm) -> Tensor:
    """Data term of each pixel [row, col], see `DataTerm`."""
    difference = image - target
    if term.kind == L1:
        return difference.abs()
    through = torch.ones_like(target) if term.kind == L2 else torch.exp(-term.depth * target.clamp(min=0))
    return through * difference**2 / (2 * term.delta)


def projection_loss(
    image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor | None = None, term: DataTerm = ABSOLUTE
) -> Tensor:
    """mean w (D(image, target) + ssim_weight (1 - SSIM)), weights w [row, col] >= 0; None: all 1.

    Zha et al. 2024 use D = |image - target|. In SSIM's windows, pixels of weight 0 count as zeros in both images, like
    pixels outside the image.
    """
    if weights is None:
        return data_term(image, target, term).mean() + ssim_weight * (1 - ssim(image, target))
    measured = weights > 0
    x, y = (torch.where(measured, a, torch.zeros_like(a)) for a in (image, target))
    return (weights * (data_term(x, y, term) + ssim_weight * (1 - ssim_map(x, y)))).mean()


def total_variation(volume: Tensor) -> Tensor:
    """Mean absolute difference of neighbours over the three axes of [z, y, x] (Zha et al. 2024)."""
    steps = [volume.diff(dim=axis).abs() for axis in range(3)]
    return torch.stack([step.sum() for step in steps]).sum() / sum(step.numel() for step in steps)


def sparse_patches(volume: Tensor, threshold: float) -> Tensor:
    """The mean of all blocks of [a, b, c], after cosine coefficients up to `threshold` are removed; see
    `cpu.patches`."""
    sizes = (4, 4, 4 if volume.shape[2] >= 4 else 1)
    beyond = volume
    for axis, size in enumerate(sizes):
        n = volume.shape[axis]
        at = torch.arange(1 - size, n + size - 1) % (2 * n)
        beyond = beyond.index_select(axis, torch.minimum(at, 2 * n - 1 - at))  # mirrored at both faces
    blocks = beyond
    for axis, size in enumerate(sizes):
        blocks = blocks.unfold(axis, size, 1)
    waves = [_cosines(size).to(volume.dtype) for size in sizes]
    found = torch.einsum("pqrabc,ia,jb,kc->pqrijk", blocks, *waves)
    kept = found.abs() > threshold
    kept[..., 0, 0, 0] = True
    values = torch.einsum("pqrijk,ia,jb,kc->pqrabc", found * kept, *waves)
    total, (p, q, r) = torch.zeros_like(beyond), values.shape[:3]
    for a, b, c in product(*(range(size) for size in sizes)):
        total[a : a + p, b : b + q, c : c + r] += values[..., a, b, c]
    inner = tuple(slice(size - 1, size - 1 + n) for size, n in zip(sizes, volume.shape, strict=True))
    return total[inner] / math.prod(sizes)


def _cosines(size: int) -> Tensor:
    """The orthonormal cosine transform (DCT-II) as a matrix."""
    order, at = torch.arange(size, dtype=torch.float64)[:, None], torch.arange(size, dtype=torch.float64)
    waves = torch.cos(math.pi / size * (at + 0.5) * order) * math.sqrt(2 / size)
    waves[0] /= math.sqrt(2)
    return waves
