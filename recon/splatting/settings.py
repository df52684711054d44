"""Settings of a fit: weights, rates and limits, and values that depend on the scan and the grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from recon.base.choices import KERNEL
from recon.base.declared_types import check_settings
from recon.base.empirical import (
    DEFAULT_STEPS,
    NARROWEST,
    PACE,
    TV_CHANGE,
    TV_LEAST,
    TV_MOST,
    TV_OF_NOISE,
    TV_SHARE,
    VIEWS_A_STEP,
)
from recon.base.kernel import Kernel
from recon.base.ray_model import RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.density_control import DensityPolicy
from recon.splatting.problem import FitProblem, Loss

TV_WIDEST = 96
"""Voxels of that side, at most. Without: a step in 512³ voxels takes longer; not measured."""

NAMES = ("means", "log_scales", "quaternions", "raw")  # Parameters of the model, in the order of their rates

TV_LEAST_SIDE = 32  # voxels of the box of total variation (Zha et al. 2024)


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit. Defaults are the published ones (Zha et al. 2024) unless stated otherwise.

    Attributes:
        loss: "l1" (published), "l2", or "poisson" (squares weighed by the transmission).
        ssim_weight: of 1 - SSIM beside it.
        tv_weight: of total variation. None takes 3e5 times the variance of a pixel's noise (in units of the half field
            times the density unit). That is divided by the pixels of a Gaussian. Where matter changes by more than 0.16
            of the density unit a voxel, it falls with the square of this change. It is at most 0.25.
        tv_least: the least of these weights, in a fit of `paced_for` steps; more steps need less, see `in_steps`.
        tv_size: voxels per side of the random box on which total variation acts; None takes a quarter of the grid's
            side, 32 to 96.
        tv_moves: total variation may move centres. In the published code that gradient is too small by the voxel size
        squared, and has no effect (its weight there is 0.05). With the right gradient we measure +0.2
            dB on the walnut (60 views) and +0.4 dB on the battery (90 views).
        rates: of means (per half field), log scales, quaternions, raw densities, at the first step.
        pace: factor on all rates. The published ones are for 30 000 steps; with them a fit of 1000 is far from its end.
            Twenty times as fast, with two views a step and a low last rate, gains 1 to 4 dB there. 26 times with a
            higher last rate gives in 400 steps and a finish as much as 20 in 500 (see docs/notes/exploration.md).
        paced_for: steps of the longest fit that `pace` holds for, see `in_steps`.
        decay: last rate / first rate; log-linear in between.
        policy: density control; None keeps the count.
        truncation: where Gaussians end; a compact kernel ends by itself.
        smallest: least standard deviation, in pixels: point sampling sees nothing thinner.
        views_per_step: gradients of so many views are averaged.
        joined_pixels: pixels of the views are joined by this factor for the fit, not for its finish. None joins as
            many as Gaussians are wide, see `initialise.joined_for`: of large volumes alone.
        rays: the integral of a Gaussian along a ray; matters for cones.
        kernel: radial profile of the Gaussians, also by its name; a fit that starts from a model keeps the model's.
    """

    loss: Loss = "l1"
    ssim_weight: float = 0.25
    tv_weight: float | None = None
    tv_least: float = TV_LEAST
    tv_size: int | None = None
    tv_moves: bool = True
    rates: tuple[float, float, float, float] = (2e-4, 5e-3, 1e-3, 1e-2)
    pace: float = PACE
    paced_for: int = DEFAULT_STEPS
    decay: float = 0.1
    policy: DensityPolicy | None = field(default_factory=DensityPolicy)
    truncation: Truncation = field(default_factory=Truncation)
    smallest: float = NARROWEST
    views_per_step: int = VIEWS_A_STEP
    joined_pixels: int | None = None
    rays: RayModel = field(default_factory=RayModel)
    kernel: Kernel = KERNEL

    def __post_init__(self) -> None:
        check_settings(
            self,
            whole=dict.fromkeys(("views_per_step", "joined_pixels", "tv_size", "paced_for"), 1),
            least=dict.fromkeys(("ssim_weight", "tv_weight", "tv_least"), 0.0),
            above=dict.fromkeys(("pace", "decay", "smallest"), 0.0),
        )
        object.__setattr__(self, "kernel", Kernel(self.kernel))
        if len(self.rates) != len(NAMES) or not all(0 <= rate < math.inf for rate in self.rates):
            raise ValueError(
                f"rates must be {len(NAMES)} finite numbers of 0 or more ({', '.join(NAMES)}), got {self.rates}"
            )


def in_steps(settings: FitSettings, steps: float) -> FitSettings:
    """The settings of a fit of so many steps, where these are more than `paced_for`.

    Its rates fall with their square root. So does the least weight of total variation, which a short fit needs to be
    smooth.
    """
    share = min(1.0, math.sqrt(settings.paced_for / max(steps, 1.0)))
    return replace(settings, pace=share * settings.pace, tv_least=share * settings.tv_least)


def tv_weight(settings: FitSettings, problem: FitProblem, count: int) -> float:
    """The weight of total variation in a fit of at most `count` Gaussians: as set, or by the noise of the data."""
    if settings.tv_weight is not None:
        return settings.tv_weight
    rows, cols = problem.geometry.detector_shape
    pixels = problem.geometry.n_views * rows * cols / count
    sharp = max(problem.change / TV_CHANGE, 1.0)
    return min(max(TV_OF_NOISE * (problem.noise / sharp) ** 2 / pixels, settings.tv_least), TV_MOST)


def tv_size(settings: FitSettings, grid: Grid) -> int:
    """Voxels per side of the box of total variation: as set, or by the size of the grid."""
    if settings.tv_size is not None:
        return settings.tv_size
    side = round(math.prod(grid.shape) ** (1 / 3) / TV_SHARE / 16) * 16  # whole lanes of the kernels
    return min(max(side, TV_LEAST_SIDE), TV_WIDEST)


def growth(settings: FitSettings) -> float:
    """Largest number of Gaussians, as a multiple of the first count."""
    return 1.0 if settings.policy is None else settings.policy.growth
