"""Errors of the float32 kernels against the float64 reference, and the bounds of float32; see docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.helpers import as_leaves, gradients, in_double
from tests.recon.kernels.reference import on_grid as voxelize
from tests.recon.kernels.reference import project

WHOLE = Truncation(sigmas=9.0, faint=1e-12)  # nothing is cut off, so that kernel and reference sum the same terms
STEP = 2.0**-24  # half a float32 step, relative: the error of one rounding
RECURRENCE = 1e-5  # share of a footprint's weight, as stated in `cpu.project`
ROUNDINGS = 12  # roundings in a position on the detector: sums of three products, converted to pixels


@dataclass(frozen=True)
class Found:
    """Result of one comparison.

    Attributes:
        image: image or volume of the kernel.
        value: its largest error, divided by the largest value or the largest single weight, whichever is larger.
        gradients: largest error of the gradients for each parameter, divided by the largest gradient of that parameter
            or by the largest one that the whole weight of a Gaussian would make.
        slopes: gradients of the kernel.
    """

    image: Tensor
    value: float
    gradients: dict[str, float]
    slopes: dict[str, Tensor]

    @property
    def worst(self) -> float:
        return max(self.gradients.values())


def compare(
    g: Gaussians,
    where: Geometry | Grid,
    *,
    model: RayModel | None = None,
    seed: int = 0,
    device: torch.device | None = None,
) -> Found:
    """Compare kernel and reference on an image or volume weighted by random numbers; asserts that all is finite.

    It is the GPU kernel if a `device` is given, otherwise the CPU kernel.
    """
    fast, double = as_leaves(g, device), in_double(g)
    gpu = device is not None
    if isinstance(where, Grid):
        found, expected = voxelize(fast, where, truncation=WHOLE, gpu=gpu), voxelize(double, where)
        weight = float(g.densities.max())
    else:
        found = project(fast, where, truncation=WHOLE, model=model, gpu=gpu)
        expected = project(double, where, model=model)
        weight = float((g.densities * g.scales.amin(1)).max()) * math.sqrt(2 * math.pi)
    y = torch.from_numpy(np.random.default_rng(seed).normal(size=tuple(expected.shape)))
    (found * y.float().to(device)).sum().backward()
    (expected * y).sum().backward()
    slopes, exact = gradients(fast), gradients(double)
    found = found.detach().cpu()
    for name, values in (("image", found), *slopes.items()):
        assert torch.isfinite(values).all(), name
    top = max(float(expected.detach().abs().max()), weight)
    off = float((found - expected).detach().abs().max()) / top
    # The scale of a gradient is at least what the whole weight of one Gaussian makes, even if symmetry cancels it.
    pull = (exact["raw_densities"] / torch.sigmoid(double.raw_densities.detach()) * g.densities / g.density_unit).abs()
    size = {
        "means": float((pull / g.scales.amax(1)).max()),
        "log_scales": float(pull.max()),
        "quaternions": float((pull / g.quaternions.norm(dim=1)).max()),
        "raw_densities": 0.0,
    }
    worst = {
        name: float((slopes[name] - value).abs().max()) / max(float(value.abs().max()), size[name], 1e-300)
        for name, value in exact.items()
    }
    return Found(found, off, worst, slopes)


def bound(far: float, thin: float) -> float:
    """Largest error of G: the error of a float32 position at the distance `far` from the origin, times the steepest
    slope.

    |∂G/∂δ| <= exp(-1/2) / σ; both in the same unit (pixels, voxels or mm). `thin` is the smallest standard deviation in
    the image.
    """
    return RECURRENCE + math.exp(-0.5) * ROUNDINGS * STEP * far / thin


def gradient_bound(far: float, thin: float) -> float:
    """The same for first and second moments, which weight the flanks: sup |δ|²G' is about three times as large.

    As a share of the largest gradient. Random pixel weights cancel by at most another factor of three in these sets.
    """
    return 9 * bound(far, thin)
