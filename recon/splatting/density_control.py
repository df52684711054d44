"""Density control: clones, splits and prunes Gaussians by the gradients of the loss; a policy and pure functions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32

# Standard deviations, along the longest axis, by which each half of a split moves from the centre.
_APART = 0.75

# Standard deviations (of the longest axis) outside the box beyond which a Gaussian is removed. The tail of a nearer one
# is part of the views: without it, matter at the border is lost (0.05 to 0.16 dB, measured).
_LOST = 3.0


@dataclass(frozen=True)
class DensityPolicy:
    """When density control runs, and its thresholds.

    `every`, `stop` and `threshold` are those of Zha et al. 2024, the rest is for short fits. Theirs for 30 000 steps:
    from step 500, split above 0.1 of the field, prune below 1e-5, at most 500 000 Gaussians.

    Attributes:
        start, stop: first and last step as fractions of all steps.
        every: steps between two rounds.
        threshold: mean gradient of the loss with respect to a centre, per half detector width, above which a Gaussian
            is split or cloned.
        large: fraction of the field above whose length it is split; a smaller one is cloned.
        prune_below: density (in density units) below which a Gaussian is removed.
        growth: largest number of Gaussians, relative to the number at the start.
    """

    start: float = 0.05
    stop: float = 0.5
    every: int = 100
    threshold: float = 5e-5
    large: float = 0.01
    prune_below: float = 1e-4
    growth: float = 1.5


@dataclass(frozen=True, eq=False)
class Change:
    """Result of a round of density control: changes to the arrays of a model.

    Attributes:
        keep: int64, indices of the Gaussians that stay.
        parents: int64, indices (in the old arrays) of those whose second half is appended.
        means, log_scales, raw: new values, first for those that stay, then for the appended ones.
    """

    keep: NDArray[np.int64]
    parents: NDArray[np.int64]
    means: F32
    log_scales: F32
    raw: F32


def control(
    means: F32,
    log_scales: F32,
    rotations: F32,
    raw: F32,
    statistic: F32,
    policy: DensityPolicy,
    field: float,
    limit: int,
    box: NDArray[np.float64],
    rng: np.random.Generator,
) -> Change:
    """Compute one round. Every clone and split conserves the mass ρ √|Σ|, so the projections hardly change.

    Pruning comes first: a model at its limit may add as many Gaussians as were pruned. Together the two then relocate
    Gaussians, at a constant number, from where they are faint or outside the box to where the statistic is largest.
    Only the mass of the pruned ones is lost, which is negligible.

    Args:
        means [n, 3] mm, log_scales [n, 3], rotations [n, 9], raw [n]: the model; ρ = softplus(raw) in density units.
        statistic: [n], the mean gradient that is compared with `policy.threshold`.
        field: width of the field of view, mm.
        limit: largest number of Gaussians.
        box: [2, 3] mm, lower and upper corner (x, y, z); a Gaussian whose centre is more than three standard deviations
            of its longest axis outside is removed.
        rng: draws the direction in which a clone or half moves.
    """
    density = np.logaddexp(0, raw)
    reach = _LOST * np.exp(log_scales.max(axis=1, keepdims=True))
    alive = (density >= policy.prune_below) & ((means >= box[0] - reach) & (means <= box[1] + reach)).all(axis=1)
    wanted = np.flatnonzero(alive & (statistic > policy.threshold))
    free = max(0, limit - int(alive.sum()))
    if wanted.size > free:
        wanted = wanted[np.argsort(-statistic[wanted], kind="stable")[:free]]
        wanted.sort()

    new_means, new_scales, new_raw = means.copy(), log_scales.copy(), raw.copy()
    axis = log_scales[wanted].argmax(axis=1)
    longest = np.exp(log_scales[wanted, axis])
    direction = rotations.reshape(-1, 3, 3)[wanted, :, axis]
    split = longest > policy.large * field
    # Splitting: two Gaussians at ±0.75 σ along the longest axis with σ √(1 - 0.75²) conserve mass, mean and covariance.
    # Cloning: two of half the density, a small distance apart, since two equal ones would always get equal gradients.
    apart = np.where(split, _APART, 0.25) * longest * np.where(rng.random(wanted.size) < 0.5, 1, -1)
    shrink = np.where(split, np.sqrt(1 - _APART**2), 1.0)
    child_density = density[wanted] / (2 * shrink)
    offset = (apart[:, None] * direction).astype(np.float32)
    new_means[wanted] += offset
    new_scales[wanted, axis] += np.log(shrink).astype(np.float32)
    new_raw[wanted] = _inverse(child_density)
    keep = np.flatnonzero(alive)
    return Change(
        keep,
        wanted,
        np.concatenate((new_means[keep], means[wanted] - offset)),
        np.concatenate((new_scales[keep], new_scales[wanted])),
        np.concatenate((new_raw[keep], new_raw[wanted])),
    )


def _inverse(density: NDArray[np.floating]) -> F32:
    value = np.maximum(density, 1e-12)
    return (value + np.log(-np.expm1(-value))).astype(np.float32)
