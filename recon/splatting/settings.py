"""Settings of a Gaussian fit: weights, learning rates and limits, and values that depend on the scan and the grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.choices import KERNEL, Loss
from recon.base.declared_types import Checked, check_settings
from recon.base.empirical import (
    APART,
    DEFAULT_STEPS,
    GROWTH,
    LOST,
    NARROWEST,
    PACE,
    TV_CHANGE,
    TV_LEAST,
    TV_MOST,
    TV_OF_NOISE,
    TV_SHARE,
    VIEWS_A_STEP,
)
from recon.base.kernel import Kernel, RayModel, Truncation
from recon.base.setting import Count, NonNegative, Positive
from recon.base.volume import Grid
from recon.splatting.problem import FitProblem

_PUBLISHED_SHRINK = 1.6  # the published split divides the widths of both halves by this

Rule = Literal["mass", "published"]


@dataclass(frozen=True)
class DensityPolicy(Checked):
    """Settings of density control (splitting, cloning and removing Gaussians): when it runs, and its thresholds.

    All values except `growth` and `rule` are those of Zha et al. 2024.

    Attributes:
        start, stop: first and last step with density control, as fractions of all steps.
        every: number of steps between two rounds.
        threshold: a Gaussian is split or cloned if the mean gradient of the loss with respect to its centre, per half
            detector width, is above this.
        large: a Gaussian longer than this fraction of the field of view is split, a smaller one is cloned. With the
            rule "mass" every such Gaussian is split.
        prune_below: a Gaussian with a density below this (in density units) is removed.
        growth: largest number of Gaussians, relative to the number at the start.
        rule: "mass": splits conserve the mass of the Gaussian, see `control`. "published": cloning replaces a Gaussian
            by two equal ones with half the density. Splitting draws two centres from the Gaussian; the two new
            Gaussians have half the density, and the width divided by 1.6. A Gaussian whose centre is outside the box is
            removed.
    """

    start: NonNegative = 500 / 30_000
    stop: NonNegative = 0.5
    every: Count = 100
    threshold: NonNegative = 5e-5
    large: NonNegative = 0.1
    prune_below: NonNegative = 1e-5
    growth: Positive = GROWTH
    rule: Rule = "mass"


@dataclass(frozen=True, eq=False)
class Change:
    """Result of one round of density control: the changes to the arrays of a model.

    Attributes:
        keep: int64, indices of the remaining Gaussians.
        parents: int64, indices (in the old arrays) of the Gaussians whose second half is appended.
        means, log_scales, raw: new values, first for the remaining Gaussians, then for the appended ones.
    """

    keep: NDArray[np.int64]
    parents: NDArray[np.int64]
    means: F32
    log_scales: F32
    raw: F32


def control(
    model: tuple[F32, F32, F32, F32],
    statistic: F32,
    policy: DensityPolicy,
    field: float,
    limit: int,
    box: NDArray[np.float64],
    rng: np.random.Generator,
) -> Change:
    """Compute one round of density control. With the rule "mass" a split conserves ρ √|Σ|, so projections hardly
    change.

    Pruning comes first, so that a model at its limit can add as many Gaussians as were pruned. The number then stays
    constant. In effect, faint Gaussians and Gaussians outside the box move to the positions with the largest statistic.
    Only the mass of the pruned Gaussians is lost; it is negligible.

    Args:
        model: means [n, 3] mm, log_scales [n, 3], rotations [n, 9], raw [n]; ρ = softplus(raw) in density units.
        statistic: [n], mean gradient that is compared with `policy.threshold`.
        field: width of the field of view, mm.
        limit: largest number of Gaussians.
        box: [2, 3] mm, lower and upper corner (x, y, z). A Gaussian is removed if its centre is outside by more than
            three standard deviations of its longest axis.
        rng: random generator for the centres of halves with the rule "published".
    """
    means, log_scales, rotations, raw = model
    density = np.logaddexp(0, raw)
    lost = LOST if policy.rule == "mass" else 0.0
    reach = lost * np.exp(log_scales.max(axis=1, keepdims=True))
    is_kept = (density >= policy.prune_below) & ((means >= box[0] - reach) & (means <= box[1] + reach)).all(axis=1)
    wanted = np.flatnonzero(is_kept & (statistic > policy.threshold))
    free = max(0, limit - int(is_kept.sum()))
    if wanted.size > free:
        wanted = wanted[np.argsort(-statistic[wanted], kind="stable")[:free]]
        wanted.sort()

    widths, turned = log_scales[wanted], rotations.reshape(-1, 3, 3)[wanted]
    if policy.rule == "mass":
        first, second, narrower, divisor = _halves(widths, turned)
    else:
        split = np.exp(widths.max(axis=1)) > policy.large * field
        first, second, narrower, divisor = _published_halves(widths, turned, split, rng)
    new_means, new_scales, new_raw = means.copy(), log_scales.copy(), raw.copy()
    new_means[wanted] += first
    new_scales[wanted] += narrower
    new_raw[wanted] = _inverse(density[wanted] / divisor)
    keep = np.flatnonzero(is_kept)
    return Change(
        keep,
        wanted,
        np.concatenate((new_means[keep], means[wanted] + second)),
        np.concatenate((new_scales[keep], new_scales[wanted])),
        np.concatenate((new_raw[keep], new_raw[wanted])),
    )


def _halves(log_scales: F32, rotations: F32) -> tuple[F32, F32, F32, float]:
    """Splits Gaussians with the rule "mass".

    Two Gaussians at ±0.75 σ along the longest axis with σ √(1 - 0.75²) conserve mass, mean and covariance.

    Returns:
        Shifts of the first and the second halves [n, 3] mm, the values to add to their log scales [n, 3], and the
        divisor of their density.
    """
    index, axis = np.arange(len(log_scales)), log_scales.argmax(axis=1)
    distance, shrink = APART * np.exp(log_scales[index, axis]), math.sqrt(1 - APART**2)
    offset = (distance[:, None] * rotations[index, :, axis]).astype(np.float32)
    narrower = np.zeros_like(log_scales)
    narrower[index, axis] = math.log(shrink)
    return offset, -offset, narrower, 2 * shrink


def _published_halves(
    log_scales: F32, rotations: F32, split: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[F32, F32, F32, float]:
    """Splits Gaussians with the rule "published", which does not conserve mass and covariance."""
    own = np.exp(log_scales) * rng.standard_normal((2, *log_scales.shape))
    first, second = np.einsum("nij,hnj->hni", rotations, own * split[:, None]).astype(np.float32)
    narrower = np.where(split, -np.log(_PUBLISHED_SHRINK), 0.0)[:, None].astype(np.float32)
    return first, second, np.broadcast_to(narrower, log_scales.shape), 2.0


def _inverse(density: NDArray[np.floating]) -> F32:
    value = np.maximum(density, 1e-12)
    return (value + np.log(-np.expm1(-value))).astype(np.float32)


TV_WIDEST = 96
"""Largest side, in voxels, of the box in which total variation acts.

Without this limit, a step on a grid of 512³ voxels would take longer (not measured).
"""

NAMES = ("means", "log_scales", "quaternions", "raw")  # parameters of the model, in the order of their rates

TV_LEAST_SIDE = 32  # smallest side, in voxels, of the box of total variation (Zha et al. 2024)


@dataclass(frozen=True)
class FitSettings:
    """Settings of a Gaussian fit. Defaults are the published values (Zha et al. 2024) unless stated otherwise.

    The default weight of total variation is at most 0.25. The default weight is lower for samples with strong edges: if
    the density changes from voxel to voxel by more than 0.16 density units, the weight falls with the square of this
    change. In the published code (weight 0.05), the gradient of total variation with respect to the centres is too
    small by the square of the voxel size, so total variation does not move the centres. The correct gradient raises the
    PSNR of the walnut by 0.2 dB (60 projections) and that of the battery by 0.4 dB (90 projections).

    The published learning rates are for 30 000 steps, and a fit of 1000 steps with the published rates is far from
    convergence. With `pace` 20 (all rates are 20 times the published ones), two projections per step and a low last
    rate, a fit of 1000 steps gains 1 to 4 dB over a fit with the published rates. With rates 26 times the published
    ones and a higher last rate, 400 steps before the voxel refinement suffice for a volume that needs 500 steps with
    `pace` 20.

    Attributes:
        loss: "l1" (published), "l2", or "poisson" (squares weighted by the transmission).
        ssim_weight: weight of 1 - SSIM, which is added to the loss.
        tv_weight: weight of total variation; None: 3e5 s² / n, where n is the number of pixels that a Gaussian covers,
            and s is the noise of a pixel, divided by (density unit x half the width of the field of view).
        tv_least: smallest weight of total variation in a fit of `paced_for` steps; lower in a longer fit, see
            `in_steps`.
        tv_size: voxels per side of the random box on which total variation acts; None: a quarter of the grid's side, 32
            to 96.
        tv_moves: True: total variation may move the centres of Gaussians.
        rates: learning rates at the first step: of centres (in units of half the width of the field of view), log
            scales, quaternions and raw densities.
        pace: factor on all published rates.
        paced_for: largest number of steps for which `pace` is used unchanged, see `in_steps`.
        decay: last rate / first rate; in between, the logarithm of the rate falls linearly.
        policy: density control; None: the number of Gaussians stays the same.
        truncation: distance at which Gaussians are cut off; compact kernels end at a finite radius and are not cut off.
        smallest: smallest standard deviation in pixels, because a thinner Gaussian could lie between the points at
            which pixels are sampled.
        views_per_step: number of projections whose gradients are averaged in a step.
        joined_pixels: factor by which pixels are binned for the fit (not for the voxel refinement); None: pixels become
            as wide as the Gaussians (see `initialise.joined_for`), which changes the pixels only in large volumes.
        rays: how the integral of a Gaussian along a ray is computed; it matters for cone beams.
        kernel: radial profile of the Gaussians, or its name; a fit that starts from an existing model keeps the kernel
            of that model.
    """

    loss: Loss = "l1"
    ssim_weight: NonNegative = 0.25
    tv_weight: NonNegative | None = None
    tv_least: NonNegative = TV_LEAST
    tv_size: Count | None = None
    tv_moves: bool = True
    rates: tuple[float, float, float, float] = (2e-4, 5e-3, 1e-3, 1e-2)
    pace: Positive = PACE
    paced_for: Count = DEFAULT_STEPS
    decay: Positive = 0.1
    policy: DensityPolicy | None = field(default_factory=DensityPolicy)
    truncation: Truncation = field(default_factory=Truncation)
    smallest: Positive = NARROWEST
    views_per_step: Count = VIEWS_A_STEP
    joined_pixels: Count | None = None
    rays: RayModel = field(default_factory=RayModel)
    kernel: Kernel = KERNEL

    def __post_init__(self) -> None:
        check_settings(self)
        object.__setattr__(self, "kernel", Kernel(self.kernel))
        if len(self.rates) != len(NAMES) or not all(0 <= rate < math.inf for rate in self.rates):
            raise ValueError(
                f"rates must be {len(NAMES)} finite numbers, each 0 or more ({', '.join(NAMES)}), got {self.rates}"
            )


def in_steps(settings: FitSettings, steps: float) -> FitSettings:
    """The settings for a fit of `steps` steps. If `steps` is larger than `paced_for`, the rates are lower.

    The rates and the smallest weight of total variation are divided by the square root of steps / paced_for. A short
    fit needs the larger weight to be smooth.
    """
    share = min(1.0, math.sqrt(settings.paced_for / max(steps, 1.0)))
    return replace(settings, pace=share * settings.pace, tv_least=share * settings.tv_least)


def tv_weight(settings: FitSettings, problem: FitProblem, count: int) -> float:
    """The weight of total variation in a fit of at most `count` Gaussians: the given weight, or a weight computed from
    the noise of the data."""
    if settings.tv_weight is not None:
        return settings.tv_weight
    rows, cols = problem.geometry.detector_shape
    pixels = problem.geometry.n_views * rows * cols / count
    change_ratio = max(problem.change / TV_CHANGE, 1.0)
    return min(max(TV_OF_NOISE * (problem.noise / change_ratio) ** 2 / pixels, settings.tv_least), TV_MOST)


def tv_size(settings: FitSettings, grid: Grid) -> int:
    """Voxels per side of the box in which total variation acts: the given number, or a number computed from the size of
    the grid."""
    if settings.tv_size is not None:
        return settings.tv_size
    side = round(math.prod(grid.shape) ** (1 / 3) / TV_SHARE / 16) * 16  # a multiple of the kernels' vector length
    return min(max(side, TV_LEAST_SIDE), TV_WIDEST)


def growth(settings: FitSettings) -> float:
    """Largest number of Gaussians, as a multiple of the number at the start."""
    return 1.0 if settings.policy is None else settings.policy.growth
