"""Materials of a volume: their grey levels, the labels of voxels, and the probability of each material."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr
from scipy.stats import trim_mean
from skimage.morphology import ball

from recon.post import clusters

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Labels = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Spacing = tuple[float, float, float]

_ROUNDS, _LOOKED_AT = 4, 160  # side in voxels of the central cube from which the levels are found
_CORE = 2  # least distance from an edge, in voxels, of the voxels from which the level of a material is computed
_TRIMMED = 0.02  # fraction of a core's voxels left out at each end, because of specks of other materials
_LEAST = 200  # fewest voxels of a core; with fewer, the outer quarter of the material's values gives the level
MOST = 6  # largest number of materials
MOST_BETWEEN = 1.5
"""Largest ratio of voxels half-way between two levels to voxels near the rarer level. For one normal distribution cut
in two the ratio is 2.2."""


@dataclass(frozen=True, eq=False)
class Materials:
    """Materials of a volume, the least dense first.

    Attributes:
        levels: [material], rising, in the unit of the volume.
        spread: standard deviation of each material's voxels, away from edges.
        errors: standard error of each level, from the noise of its voxels.
    """

    levels: F64
    spread: F64
    errors: F64

    @property
    def thresholds(self) -> F64:
        """Half-way between neighbouring levels (ISO 50 % rule)."""
        return (self.levels[1:] + self.levels[:-1]) / 2


def central(mask: NDArray[Any], side: int, spacing: Spacing = (1, 1, 1)) -> NDArray[Any]:
    """The cube in the middle of `side` voxels of the shortest edge, cut to the volume."""
    sides = [max(round(side * min(spacing) / edge), 1) for edge in spacing]
    firsts = [max((n - each) // 2, 0) for n, each in zip(mask.shape, sides, strict=True)]
    return mask[tuple(slice(first, first + each) for first, each in zip(firsts, sides, strict=True))]


def label_values(volume: F32) -> F64:
    """The different values of a segmented volume (labels), 2 to 6 of them. Empty if the volume contains grey values."""
    for voxels in (volume[len(volume) // 2], volume):
        values = np.unique(voxels)
        if values.size > MOST:
            return np.empty(0)
    return values.astype(np.float64) if values.size > 1 else np.empty(0)


def materials_of(volume: F32, count: int, seed: int = 0) -> Materials:
    """Levels of `count` materials: k-means, then the mean of each material's voxels more than two voxels from its edge.

    Partial-volume voxels are between levels and are not used. In a large volume the 160³ voxels in the middle are used.
    If the volume holds `count` labels, they are the levels.

    Raises:
        ValueError: the volume has only one value, or two materials have no contrast.
    """
    if (known := label_values(volume)).size == count:
        return Materials(known, np.full(count, 1e-3 * np.diff(known).min()), np.zeros(count))
    volume = central(volume, _LOOKED_AT)
    levels = clusters(volume, count, seed).centres
    for _ in range(_ROUNDS):
        labels = labelled(volume, (levels[1:] + levels[:-1]) / 2)
        cores = [_core(volume, labels == k, k, count) for k in range(count)]
        levels = np.array([float(trim_mean(core, _TRIMMED)) for core in cores])
    spread = np.array(
        [1.4826 * float(np.median(np.abs(core - level))) for core, level in zip(cores, levels, strict=True)]
    )
    valleys = _valleys(volume, levels)
    if valleys.max() > MOST_BETWEEN:
        worst = int(valleys.argmax())
        raise ValueError(
            f"materials {worst + 1} and {worst + 2} of {count} have no contrast: their grey levels are "
            f"{levels[worst]:.4g} and {levels[worst + 1]:.4g}. The number of voxels half-way between the two grey "
            f"levels is {valleys[worst]:.2g} times the number of voxels near the rarer grey level; expected at most "
            f"{MOST_BETWEEN:g} times"
        )
    return Materials(levels, spread, spread * np.array([math.sqrt(8 / core.size) for core in cores]))


def _core(volume: F32, mask: Mask, k: int, count: int) -> F32:
    """Values of a material away from its edges; in thin parts, the values farthest from those of other materials."""
    core = volume[ndimage.binary_erosion(mask, ball(_CORE), border_value=1)]
    if core.size >= _LEAST:
        return core
    values = volume[mask]
    if not values.size:
        raise ValueError(
            f"give a smaller --materials: the volume contains fewer than {count} materials, because no voxel is of "
            f"material {k + 1}"
        )
    low, high = (0, 25) if k == 0 else (75, 100) if k == count - 1 else (37.5, 62.5)
    low, high = np.percentile(values, (low, high))
    return values[(values >= low) & (values <= high)]


def _valleys(volume: F32, levels: F64) -> F64:
    """Ratio of voxels half-way between neighbouring levels to voxels near the rarer of the two levels."""
    gaps = np.diff(levels)
    near = np.minimum(np.r_[gaps[0], gaps], np.r_[gaps, gaps[-1]]) / 8
    counts_per_width = [
        np.count_nonzero(np.abs(volume - level) < width) / width for level, width in zip(levels, near, strict=True)
    ]
    middles = (levels[1:] + levels[:-1]) / 2
    between = [
        np.count_nonzero(np.abs(volume - middle) < gap / 8) / (gap / 8)
        for middle, gap in zip(middles, gaps, strict=True)
    ]
    return np.array(between) / np.maximum(np.minimum(counts_per_width[1:], counts_per_width[:-1]), 1e-9)


def labelled(volume: F32, thresholds: F64) -> Labels:
    """Number of each voxel's material, from 0, the least dense."""
    return np.searchsorted(thresholds, volume).astype(np.uint8)


def probabilities(volume: F32, thresholds: F64, deviation: F32 | float) -> F32:
    """[material, z, y, x] probability that a voxel is of a material, if its value has a normal error.

    Args:
        deviation: standard deviation of the error, for each voxel or for all.
    """
    below = (ndtr((threshold - volume) / deviation) for threshold in thresholds)
    edges = [np.zeros_like(volume), *below, np.ones_like(volume)]
    return np.stack([high - low for low, high in pairwise(edges)]).astype(np.float32)
