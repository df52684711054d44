"""Density control: clones, splits and prunes Gaussians by the gradients of the loss; a policy and pure functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32

# Each half of a split moves this far from the centre, in standard deviations along the longest axis.
_APART = 0.75

# Standard deviations (of the longest axis) outside the box beyond which a Gaussian is removed. The tail of a nearer one
# is part of the views: without it, matter at the border is lost (0.05 to 0.16 dB, measured).
_LOST = 3.0

_PUBLISHED_SHRINK = 1.6  # the published split divides the widths of both halves by this

Rule = Literal["mass", "published"]


@dataclass(frozen=True)
class DensityPolicy:
    """When density control runs, and its thresholds.

    `every`, `stop` and `threshold` are those of Zha et al. 2024, the others are for short fits. `published` has all
    published settings.

    Attributes:
        start, stop: first and last step as fractions of all steps.
        every: steps between two rounds.
        threshold: mean gradient of the loss with respect to a centre, per half detector width, above which a Gaussian
            is split or cloned.
        large: a Gaussian longer than this fraction of the field is split; a smaller one is cloned.
        prune_below: density (in density units) below which a Gaussian is removed.
        growth: largest number of Gaussians, relative to the number at the start.
        rule: "mass": clones and splits conserve the mass of the Gaussian, see `control`. "published": a clone is two
            equal Gaussians of half the density. A split draws two centres from the Gaussian, with half its density and
            its width over 1.6. A Gaussian is removed where its centre leaves the box.
    """

    start: float = 0.05
    stop: float = 0.5
    every: int = 100
    threshold: float = 5e-5
    large: float = 0.01
    prune_below: float = 1e-4
    growth: float = 1.5
    rule: Rule = "mass"

    def __post_init__(self) -> None:
        if self.rule not in get_args(Rule):
            raise ValueError(f"rule must be one of {', '.join(get_args(Rule))}, got {self.rule!r}")


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
    model: tuple[F32, F32, F32, F32],
    statistic: F32,
    policy: DensityPolicy,
    field: float,
    limit: int,
    box: NDArray[np.float64],
    rng: np.random.Generator,
) -> Change:
    """Compute one round. By the rule "mass" every clone and split conserves ρ √|Σ|: the projections hardly change.

    Pruning comes first: a model at its limit may add as many Gaussians as were pruned. The number then stays constant,
    and faint or outside Gaussians are in effect relocated to places where the statistic is largest.
    Only the mass of the pruned ones is lost, which is negligible.

    Args:
        model: means [n, 3] mm, log_scales [n, 3], rotations [n, 9], raw [n]; ρ = softplus(raw) in density units.
        statistic: [n], the mean gradient that is compared with `policy.threshold`.
        field: width of the field of view, mm.
        limit: largest number of Gaussians.
        box: [2, 3] mm, lower and upper corner (x, y, z); a Gaussian whose centre is more than three standard deviations
            of its longest axis outside is removed.
        rng: draws the direction in which a clone or half moves.
    """
    means, log_scales, rotations, raw = model
    density = np.logaddexp(0, raw)
    lost = _LOST if policy.rule == "mass" else 0.0
    reach = lost * np.exp(log_scales.max(axis=1, keepdims=True))
    alive = (density >= policy.prune_below) & ((means >= box[0] - reach) & (means <= box[1] + reach)).all(axis=1)
    wanted = np.flatnonzero(alive & (statistic > policy.threshold))
    free = max(0, limit - int(alive.sum()))
    if wanted.size > free:
        wanted = wanted[np.argsort(-statistic[wanted], kind="stable")[:free]]
        wanted.sort()

    split = np.exp(log_scales[wanted].max(axis=1)) > policy.large * field
    halves = _halves if policy.rule == "mass" else _published_halves
    first, second, narrower, divisor = halves(log_scales[wanted], rotations.reshape(-1, 3, 3)[wanted], split, rng)
    new_means, new_scales, new_raw = means.copy(), log_scales.copy(), raw.copy()
    new_means[wanted] += first
    new_scales[wanted] += narrower
    new_raw[wanted] = _inverse(density[wanted] / divisor)
    keep = np.flatnonzero(alive)
    return Change(
        keep,
        wanted,
        np.concatenate((new_means[keep], means[wanted] + second)),
        np.concatenate((new_scales[keep], new_scales[wanted])),
        np.concatenate((new_raw[keep], new_raw[wanted])),
    )


def _halves(
    log_scales: F32, rotations: F32, split: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[F32, F32, F32, NDArray[np.float64]]:
    """Splits and clones Gaussians by the rule "mass".

    Splitting: two Gaussians at ±0.75 σ along the longest axis with σ √(1 - 0.75²) conserve mass, mean and covariance.
    Cloning: two of half the density, a small distance apart, since equal ones would always get equal gradients.

    Returns:
        Shifts of the first and second halves [n, 3] mm, what is added to their log scales [n, 3], and what their
        density is divided by [n].
    """
    at, axis = np.arange(split.size), log_scales.argmax(axis=1)
    sign = np.where(rng.random(split.size) < 0.5, 1, -1)
    apart = np.where(split, _APART, 0.25) * np.exp(log_scales[at, axis]) * sign
    shrink = np.where(split, np.sqrt(1 - _APART**2), 1.0)
    offset = (apart[:, None] * rotations[at, :, axis]).astype(np.float32)
    narrower = np.zeros_like(log_scales)
    narrower[at, axis] = np.log(shrink)
    return offset, -offset, narrower, 2 * shrink


def _published_halves(
    log_scales: F32, rotations: F32, split: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[F32, F32, F32, NDArray[np.float64]]:
    """The same by the rule "published": mass and covariance are not conserved."""
    own = np.exp(log_scales) * rng.standard_normal((2, *log_scales.shape))
    first, second = np.einsum("nij,hnj->hni", rotations, own * split[:, None]).astype(np.float32)
    narrower = np.where(split, -np.log(_PUBLISHED_SHRINK), 0.0)[:, None].astype(np.float32)
    return first, second, np.broadcast_to(narrower, log_scales.shape), np.full(split.size, 2.0)


def _inverse(density: NDArray[np.floating]) -> F32:
    value = np.maximum(density, 1e-12)
    return (value + np.log(-np.expm1(-value))).astype(np.float32)
