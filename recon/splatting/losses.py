"""Losses in plain torch: the readable twins of the fused ones, differentiable, for any image or volume."""

from __future__ import annotations

import torch
from torch import Tensor

from recon.kernels.cpu.losses import ABSOLUTE, L1, L2, DataTerm, gaussian_window


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
    """What each pixel costs [row, col]: see `DataTerm`."""
    difference = image - target
    if term.kind == L1:
        return difference.abs()
    through = torch.ones_like(target) if term.kind == L2 else torch.exp(-term.depth * target.clamp(min=0))
    return through * difference**2 / (2 * term.delta)


def projection_loss(
    image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor | None = None, term: DataTerm = ABSOLUTE
) -> Tensor:
    """mean w (D(image, target) + ssim_weight (1 - SSIM)), weights w [row, col] >= 0; None: all 1.

    Zha et al. 2024 take D = |image - target|. Pixels of no weight are left out: SSIM's windows take them for zeros in
    both images, as they do what lies outside.
    """
    if weights is None:
        return data_term(image, target, term).mean() + ssim_weight * (1 - ssim(image, target))
    seen = weights > 0
    x, y = (torch.where(seen, a, torch.zeros_like(a)) for a in (image, target))
    return (weights * (data_term(x, y, term) + ssim_weight * (1 - ssim_map(x, y)))).mean()


def total_variation(volume: Tensor) -> Tensor:
    """Mean absolute difference of neighbours over the three axes of [z, y, x] (Zha et al. 2024)."""
    steps = [volume.diff(dim=axis).abs() for axis in range(3)]
    return torch.stack([step.sum() for step in steps]).sum() / sum(step.numel() for step in steps)
