"""Density control: clone, split and prune Gaussians where the data ask for it; a policy and pure operations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32

# A split moves the halves this many standard deviations apart from the middle along the longest axis.
_APART = 0.75

# Gaussians go whose centre is this many standard deviations (of their longest axis) outside the box: of a nearer one
# the views need the tail that reaches in, and cutting it takes matter from the border (0.05 to 0.16 dB, measured).
_LOST = 3.0


@dataclass(frozen=True)
class DensityPolicy:
    """When and what. The rounds, their end and the threshold are those of Zha et al. 2024; the rest is for short fits.

    Theirs for 30 000 steps: from step 500, split above 0.1 of the field, prune below 1e-5, no
    more than 500 000.

    Attributes:
        start, stop: first and last step as fractions of all steps.
        every: steps between two rounds.
        threshold: mean gradient of the loss with respect to a centre, per half detector width, above which a Gaussian
            grows.
        large: a growing Gaussian longer than this fraction of the field splits, a smaller one is cloned.
        prune_below: densities (in density units) that go.
        growth: at most this many times the initial count.
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
    """What a round of density control does to the arrays of a model.

    Attributes:
        keep: int64, positions of the Gaussians that stay.
        parents: int64, positions (in the old arrays) of those that get a copy appended.
        means, log_scales, raw: their new values, for the kept ones first and then for the copies.
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
    """Decide one round. Mass ρ √|Σ| is conserved by every clone and split, so the projections barely move.

    Pruning comes first, and a model at its limit grows into the room that it leaves. There the two together relocate
    Gaussians: from where they are faint or lost to where the data ask for more, most wanted first, at a constant
    number. Only the mass of those pruned is lost, which is next to none.

    Args:
        means [n, 3] mm, log_scales [n, 3], rotations [n, 9], raw [n]: the model; ρ = softplus(raw) in density units.
        statistic: [n], the mean gradient that `policy.threshold` is held against.
        field: mm, the width of the field of view.
        limit: no more Gaussians than this.
        box: [2, 3] mm, lower and upper corner (x, y, z); Gaussians whose centre is more than three standard deviations
            of their longest axis outside go.
        rng: picks sides of clones.
    """
    density = np.logaddexp(0, raw)
    reach = _LOST * np.exp(log_scales.max(axis=1, keepdims=True))
    alive = (density >= policy.prune_below) & ((means >= box[0] - reach) & (means <= box[1] + reach)).all(axis=1)
    wanted = np.flatnonzero(alive & (statistic > policy.threshold))
    room = max(0, limit - int(alive.sum()))
    if wanted.size > room:
        wanted = wanted[np.argsort(-statistic[wanted], kind="stable")[:room]]
        wanted.sort()

    new_means, new_scales, new_raw = means.copy(), log_scales.copy(), raw.copy()
    axis = log_scales[wanted].argmax(axis=1)
    longest = np.exp(log_scales[wanted, axis])
    direction = rotations.reshape(-1, 3, 3)[wanted, :, axis]
    split = longest > policy.large * field
    # Splitting: two Gaussians at ±0.75 σ along the longest axis with σ √(1 - 0.75²) keep mass, mean and covariance.
    # Cloning: two of half the density, set a little apart, since two equal ones would get equal gradients for ever.
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
