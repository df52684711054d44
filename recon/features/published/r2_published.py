"""R2Published: R²-Gaussian with the published settings, for comparison (Zha et al. 2024, NeurIPS, and their code)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from recon.base.choices import Start
from recon.base.kernel import Kernel, Truncation
from recon.splatting.gaussians import Gaussians
from recon.splatting.r2 import R2
from recon.splatting.settings import DensityPolicy, FitSettings

_STEPS = 30_000


def published_fit() -> FitSettings:
    """The published weights, learning rates and limits.

    Three differences from the published code remain. Widths have a lower bound in pixels instead of a sigmoid. Total
    variation does not move centres (in the published code it has no effect on them either). A Gaussian ends at 3σ of
    its ellipse. In the published code it ends at a square of tiles.
    """
    policy = DensityPolicy(
        start=500 / _STEPS, stop=0.5, every=100, threshold=5e-5, large=0.1, prune_below=1e-5, growth=10.0,
        rule="published",
    )  # fmt: skip
    return FitSettings(
        loss="l1", ssim_weight=0.25, tv_weight=0.05, tv_size=32, tv_moves=False, rates=(2e-4, 5e-3, 1e-3, 1e-2),
        pace=1.0, paced_for=_STEPS, decay=0.1, policy=policy, truncation=Truncation(sigmas=3.0), smallest=0.128,
        views_per_step=1, kernel=Kernel.GAUSSIAN, joined_pixels=1,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class R2Published(R2):
    """The published R²-Gaussian: 30 000 steps of one projection, true Gaussians, no voxel refinement.

    Attributes: see `R2`.
    """

    name: ClassVar[str] = "r2-published"
    label: ClassVar[str] = "R²-Gaussian as published"
    error_bars: ClassVar[tuple[float, float] | None] = None

    steps: int | None = _STEPS
    gaussians: int | Gaussians | None = 50_000
    start: Start = "published"
    finish: int | None = 0
    fit: FitSettings = field(default_factory=published_fit)
