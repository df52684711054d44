"""Density control: clones, splits and prunes Gaussians by the gradients of the loss; a policy and pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.declared_types import check_settings
from recon.base.empirical import APART, GROWTH, LOST

_PUBLISHED_SHRINK = 1.6  # the published split divides the widths of both halves by this

Rule = Literal["mass", "published"]


@dataclass(frozen=True)
class DensityPolicy:
    """When density control runs, and its thresholds.

    All but `growth` and `rule` are those of Zha et al. 2024.

    Attributes:
        start, stop: first and last step as fractions of all steps.
        every: steps between two rounds.
        threshold: mean gradient of the loss with respect to a centre, per half detector width, above which a Gaussian
            is split or cloned.
        large: a Gaussian longer than this fraction of the field is split; a smaller one is cloned. By the rule "mass"
            all are split.
        prune_below: density (in density units) below which a Gaussian is removed.
        growth: largest number of Gaussians, relative to the number at the start.
        rule: "mass": splits conserve the mass of the Gaussian, see `control`. "published": a clone is two equal
            Gaussians of half the density. A split draws two centres from the Gaussian, with half its density and its
            width over 1.6. A Gaussian is removed where its centre leaves the box.
    """

    start: float = 500 / 30_000
    stop: float = 0.5
    every: int = 100
    threshold: float = 5e-5
    large: float = 0.1
    prune_below: float = 1e-5
    growth: float = GROWTH
    rule: Rule = "mass"

    def __post_init__(self) -> None:
        check_settings(
            self,
            whole={"every": 1},
            least=dict.fromkeys(("start", "stop", "threshold", "large", "prune_below"), 0.0),
            above={"growth": 0.0},
        )


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
    """Compute one round. By the rule "mass" every split conserves ρ √|Σ|: the projections hardly change.

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
        rng: draws the centres of halves by the rule "published".
    """
    means, log_scales, rotations, raw = model
    density = np.logaddexp(0, raw)
    lost = LOST if policy.rule == "mass" else 0.0
    reach = lost * np.exp(log_scales.max(axis=1, keepdims=True))
    alive = (density >= policy.prune_below) & ((means >= box[0] - reach) & (means <= box[1] + reach)).all(axis=1)
    wanted = np.flatnonzero(alive & (statistic > policy.threshold))
    free = max(0, limit - int(alive.sum()))
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
    keep = np.flatnonzero(alive)
    return Change(
        keep,
        wanted,
        np.concatenate((new_means[keep], means[wanted] + second)),
        np.concatenate((new_scales[keep], new_scales[wanted])),
        np.concatenate((new_raw[keep], new_raw[wanted])),
    )


def _halves(log_scales: F32, rotations: F32) -> tuple[F32, F32, F32, float]:
    """Splits Gaussians by the rule "mass".

    Two Gaussians at ±0.75 σ along the longest axis with σ √(1 - 0.75²) conserve mass, mean and covariance.

    Returns:
        Shifts of the first and second halves [n, 3] mm, what is added to their log scales [n, 3], and what their
        density is divided by.
    """
    at, axis = np.arange(len(log_scales)), log_scales.argmax(axis=1)
    apart, shrink = APART * np.exp(log_scales[at, axis]), math.sqrt(1 - APART**2)
    offset = (apart[:, None] * rotations[at, :, axis]).astype(np.float32)
    narrower = np.zeros_like(log_scales)
    narrower[at, axis] = math.log(shrink)
    return offset, -offset, narrower, 2 * shrink


def _published_halves(
    log_scales: F32, rotations: F32, split: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[F32, F32, F32, float]:
    """The same by the rule "published": mass and covariance are not conserved."""
    own = np.exp(log_scales) * rng.standard_normal((2, *log_scales.shape))
    first, second = np.einsum("nij,hnj->hni", rotations, own * split[:, None]).astype(np.float32)
    narrower = np.where(split, -np.log(_PUBLISHED_SHRINK), 0.0)[:, None].astype(np.float32)
    return first, second, np.broadcast_to(narrower, log_scales.shape), 2.0


def _inverse(density: NDArray[np.floating]) -> F32:
    value = np.maximum(density, 1e-12)
    return (value + np.log(-np.expm1(-value))).astype(np.float32)
