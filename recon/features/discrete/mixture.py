"""Mixture model of discrete levels and partial voxels: finds the levels by EM, and the posterior mean of each voxel.

A voxel's value is y = t + noise. Its true density t is either that of a material k (m_k with a spread s), or that of a
partial voxel (any value equally likely). By Tweedie's formula (Robbins 1956; Efron 2011, J. Am. Stat. Assoc. 106, 1602)
the posterior mean E[t | y] is y minus the gradient of φ(y) = -σ² log p(y), so that a pull towards it descends φ, as
long as the probabilities stay the same. The probabilities come from the neighbours, see `recon.kernels.cpu.materials`.

Batenburg & Sijbers 2011, IEEE Trans. Image Process. 20, 2542 (DART) set voxels away from edges to their levels. Here
every voxel is pulled in proportion to the probability that it belongs to one material.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_closing, grey_opening
from scipy.special import ndtr

from recon.base.arrays import F32, F64, some_values
from recon.base.decisions import MaterialPrior
from recon.kernels.cpu.materials import MaterialTable, posterior_mean

NOISE, LEAST_NOISE, SPREAD = 0.2, 0.08, 0.06
"""Noise of a voxel (in the final volume; smallest value in test reconstructions) and spread of a material.

All are divided by the gap between levels. 0.08 instead of 0.2 costs 0.2 dB with 60 projections of 192 columns. Held-out
projections prefer 0.08 there, by 1.4 %, and with 0.2 they reject discrete levels for 90 projections of 256 columns. So
test reconstructions use 0.08 divided by the square root of the share of total variation.
"""
DOUBT = 0.16
"""Error of a voxel near the middle between two levels, divided by their gap, for `undecided_share`.

It was set on packed grains from 36 projections, before `APART` was introduced. Since then, expected and actual shares
of misclassified voxels are: packed grains from 60 projections 2.1 and 2.1 %, from 36 projections 2.5 and 2.9 %; a
cathode from 45 projections 2.4 and 2.3 %; ellipsoids from 36 projections 1.1 and 1.0 %. Of the voxels with an expected
probability of 10 to 20 % to be misclassified, 13 to 19 % are; with 40 % and more, 45 %; with less than 1 % (84 to 93 %
of all voxels), up to 0.1 %.
"""
THIN = 0.2
"""A part one or two voxels thick that differs by more than this share of the gap is not pulled towards its
surroundings.

The difference is measured before the pull. Without this rule, cracks of half a voxel to one voxel keep 0.90 instead of
0.97 of the depth that total variation gives them (60 projections of 192 columns). On a packing that was not used for
tuning they keep 0.69 of their depth from 60 projections and 0.36 from 36; with total variation 0.63 and 0.20.
"""
APART = 1.1
"""Factor by which the levels of the pull are farther apart than those of the volume.

The reason: total variation draws voxels together. With a factor of 1 and 10⁴ photons: -0.1 dB on packed grains from 36
and 45 projections, -0.3 dB on a cathode from 45. Cracks of half a voxel to one voxel keep 0.61 instead of 0.65 of their
depth from 60 projections. A factor of 1.16 loses as much as it gains. Together with the share of total variation
interpolated between factors of two, four packings that were not used for tuning gain 0.4 to 0.8 dB from 36 projections,
and 0.2 and 0.5 dB from 60, where cracks keep 0.69 instead of 0.65. Ellipsoids in a cone lose 0.1 dB.
"""
PARTIAL = (0.5, 0.9)
"""Probability of a partial voxel inside a material, and at the border of two materials."""
EMPTY = 0.02
"""Share of a typical high density; voxels below it are not used in the fit of levels."""
LEAST_GAP = 0.1
"""Smallest gap between neighbouring levels from EM, divided by the distance of the outer levels.

The air of a walnut from 50 projections was divided into two levels 0.03 apart. These lowered the residual in held-out
projections by 3 %, changed the volume by 0.03 dB, and prevented PnP-DCT and a Gaussian fit from being tried. The matrix
of packed grains is divided in the same way at 0.02 and 0.04, bone at 0.06. On scans that were not used for tuning (a
walnut with twice the columns from 60 projections; pores, polyhedra of two densities, cracks), levels are divided at
0.01 to 0.04, and no volume changes: held-out projections rejected the third level there, and 16 iterations are saved.
"""
_ROWS, _REACH = 4096, 6.0  # rows of the tables; their reach beyond the outer levels in standard deviations
_BINS, _ROUNDS, _LOOKED_AT = 400, 60, 300_007


def fitted_levels(values: F32, count: int) -> tuple[F64, F64]:
    """Levels [count] of the values in ascending order, and their weights, found by EM on the histogram.

    Classes have normal distributions; a flat class between the outer levels takes partial voxels. Voxels near zero,
    such as air around a sample, do not count. With 90 projections they moved the lower of two levels from 0.28 to 0.24
    of the upper one.
    """
    sampled = some_values(values, _LOOKED_AT)
    sampled = sampled[sampled >= EMPTY * np.percentile(sampled, 99.5)]
    counts, edges = np.histogram(sampled, _BINS, range=tuple(np.percentile(sampled, (0.05, 99.95))))
    middles, quantiles = (edges[1:] + edges[:-1]) / 2, (np.arange(count) + 0.5) / count
    mean = np.quantile(sampled, quantiles if count > 2 else (0.1, 0.9)).astype(float)
    span, weight = float(np.ptp(middles)), np.full(count + 1, 1 / (count + 1))
    deviation = np.full(count, span / 6)
    for _ in range(_ROUNDS):
        normalised = (middles - mean[:, None]) / deviation[:, None]
        normal = weight[:count, None] / deviation[:, None] * np.exp(-0.5 * normalised**2)
        between_levels = (middles > mean.min()) & (middles < mean.max())
        flat = weight[count] * math.sqrt(2 * math.pi) * between_levels / (np.ptp(mean) + 1e-6 * span) + 1e-12 / span
        share = np.vstack((normal, flat))
        share *= counts / share.sum(0)
        class_sizes = share.sum(1) + 1e-9
        weight, mean = class_sizes / class_sizes.sum(), share[:count] @ middles / class_sizes[:count]
        deviation = np.sqrt((share[:count] * (middles - mean[:, None]) ** 2).sum(1) / class_sizes[:count])
        deviation = deviation.clip(1e-3 * span, max(0.15 * float(np.ptp(mean)), 1e-3 * span))
    order = np.argsort(mean)
    return mean[order], weight[:count][order] / weight[:count].sum()


def undecided_share(x: F32, materials: MaterialPrior) -> float:
    """Expected share of misclassified voxels (wrong side of the middle between two levels), from a sample of x."""
    sampled, levels = some_values(x, _LOOKED_AT), materials.levels
    distances = [np.abs(sampled - (high + low) / 2) / (high - low) for low, high in pairwise(levels)]
    return float(ndtr(-np.min(distances, axis=0) / DOUBT).mean())


def are_apart(levels: F64) -> bool:
    """Whether levels from EM belong to different materials. In a volume with fewer materials, two levels may be one."""
    return bool(np.diff(levels).min() > LEAST_GAP * np.ptp(levels))


def gap_of(materials: MaterialPrior) -> float:
    """The geometric mean of the gaps between levels."""
    return float(np.exp(np.log(np.diff(materials.levels)).mean()))


def drawn_apart(materials: MaterialPrior) -> MaterialPrior:
    """The materials with levels moved apart by the factor `APART`, from the middle between the outer levels."""
    levels = np.array(materials.levels)
    middle = (levels[0] + levels[-1]) / 2
    return materials._replace(levels=tuple((middle + APART * (levels - middle)).tolist()))


def thin_parts(x: F32, materials: MaterialPrior) -> NDArray[np.int8]:
    """Parts that are one or two voxels thick: 1 if less dense than both sides, -1 if denser, otherwise 0.

    Memory: briefly four volumes of x [y, x, z].
    """
    missing_density, excess_density = grey_closing(x, 3) - x, x - grey_opening(x, 3)
    thin = np.sign(missing_density - excess_density).astype(np.int8)
    thin[np.maximum(missing_density, excess_density) <= THIN * gap_of(materials)] = 0
    return thin


def table_of(materials: MaterialPrior) -> MaterialTable:
    """The table of these materials for the kernel."""
    levels, weight = np.array(materials.levels), np.array(materials.weights)
    gaps, spread = np.diff(levels), SPREAD * gap_of(materials)
    variance = (materials.noise * gap_of(materials)) ** 2 + spread**2
    margin = _REACH * math.sqrt(variance)
    values = np.linspace(levels[0] - margin, levels[-1] + margin, _ROWS)
    likelihoods = np.exp(-0.5 * (values[:, None] - levels) ** 2 / variance) / math.sqrt(2 * math.pi * variance)
    pure, partial = 0.5 * weight * likelihoods, 0.5 / gaps.size / gaps * np.ones((_ROWS, 1))
    total = pure.sum(1, keepdims=True) + partial.sum(1, keepdims=True)
    place_in_gap = np.clip((values[:, None] - levels[:-1]) / gaps, 0, 1)
    shares = pure / total
    shares[:, :-1] += partial / total * (1 - place_in_gap)
    shares[:, 1:] += partial / total * place_in_gap
    kept_share = np.full(levels.size, spread**2 / variance, np.float32)
    step = float(values[1] - values[0])
    return MaterialTable(
        shares.astype(np.float32), likelihoods.astype(np.float32), levels.astype(np.float32), kept_share,
        (1 / gaps).astype(np.float32), float(values[0]), 1 / step, *PARTIAL,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MaterialPull:
    """The pull of voxels towards discrete levels; a `recon.voxels.ordered_fista.Pull`.

    Attributes:
        where: [y, x, z] voxels that are pulled.
        thin: [y, x, z], see `thin_parts`.
        follows: True: levels are fitted again to each volume.
    """

    materials: MaterialPrior
    where: NDArray[np.bool_]
    thin: NDArray[np.int8]
    follows: bool = False

    @property
    def share(self) -> float:
        return self.materials.pull

    def materials_in(self, x: F32) -> MaterialPrior:
        """The materials; if `follows`, with levels fitted to the volume, unless these are not apart."""
        if not self.follows:
            return self.materials
        levels, weights = fitted_levels(x[self.where], len(self.materials.levels))
        if not are_apart(levels):
            return self.materials
        return self.materials._replace(levels=tuple(levels.tolist()), weights=tuple(weights.tolist()))

    def target(self, x: F32) -> F32:
        z = np.empty_like(x)
        posterior_mean(x, table_of(self.materials_in(x)), z)
        for pulled, own, is_pulled, thin in zip(z, x, self.where, self.thin, strict=True):
            np.copyto(pulled, own, where=~is_pulled | ((pulled - own) * thin > 0))
        return z


def probabilities(x: F32, materials: MaterialPrior) -> F32:
    """[material, ...] posterior probability that a voxel of x [a, b, c] belongs to a material.

    The rest is the probability of a partial voxel. The values are cautious: of the voxels with a half and more, over 99
    % are within a quarter of the gap from that material. Memory: one volume per material, plus one.
    """
    shares = np.empty((len(materials.levels), *x.shape), np.float32)
    posterior_mean(x, table_of(materials._replace(noise=LEAST_NOISE)), np.empty_like(x), shares)
    return shares
