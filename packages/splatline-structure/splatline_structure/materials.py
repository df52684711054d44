"""Materials of a volume: their levels, labels of voxels, and the voxels that are undecided."""

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

_ROUNDS, _LOOKED_AT = 4, 160  # voxels of a side of the cube in the middle that shows the levels
_CORE = 2  # voxels from an edge from which on a voxel shows the level of its material
_TRIMMED = 0.02  # share of a core's voxels left out at each end: specks of others
_LEAST = 200  # voxels of a core, else the outer quarter of the material's values shows the level
MOST = 6  # materials
MOST_BETWEEN = 1.5
"""Voxels half-way between two levels over those near the rarer one; of one normal distribution cut in two, 2.2."""


@dataclass(frozen=True, eq=False)
class Materials:
    """Materials of a volume, from the least dense on.

    Attributes:
        levels: rising, [material], in the unit of the volume.
        spread: standard deviation of the voxels of each, away from edges.
        errors: standard error of each level, by the noise of its voxels.
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
    """The values of a volume of labels, which has been segmented: 2 to 6 different ones; none of grey values."""
    for some in (volume[len(volume) // 2], volume):
        values = np.unique(some)
        if values.size > MOST:
            return np.empty(0)
    return values.astype(np.float64) if values.size > 1 else np.empty(0)


def materials_of(volume: F32, count: int, seed: int = 0) -> Materials:
    """Levels of `count` materials: k-means, then the mean of each material's voxels more than two voxels from its edge.

    Partial voxels lie between levels: they take no part. Of a large volume the 160³ voxels in the middle are looked at.
    If the volume holds `count` labels, they are the levels.

    Raises:
        ValueError: one value, or no contrast between two materials.
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
            f"no contrast: materials {worst + 1} and {worst + 2} of {count} have the levels {levels[worst]:.4g} and "
            f"{levels[worst + 1]:.4g}, and {valleys[worst]:.2g} times as many voxels lie half-way between them as near "
            "the rarer one"
        )
    return Materials(levels, spread, spread * np.array([math.sqrt(8 / core.size) for core in cores]))


def _core(volume: F32, mask: Mask, k: int, count: int) -> F32:
    """Values of a material away from its edges; where it has no room for that, those that lie farthest from others."""
    core = volume[ndimage.binary_erosion(mask, ball(_CORE), border_value=1)]
    if core.size >= _LEAST:
        return core
    values = volume[mask]
    if not values.size:
        raise ValueError(f"fewer than {count} materials: no voxel is of material {k + 1}")
    low, high = (0, 25) if k == 0 else (75, 100) if k == count - 1 else (37.5, 62.5)
    low, high = np.percentile(values, (low, high))
    return values[(values >= low) & (values <= high)]


def _valleys(volume: F32, levels: F64) -> F64:
    """Voxels half-way between neighbouring levels, over those near the rarer one of the two."""
    gaps = np.diff(levels)
    near = np.minimum(np.r_[gaps[0], gaps], np.r_[gaps, gaps[-1]]) / 8
    at = [np.count_nonzero(np.abs(volume - level) < width) / width for level, width in zip(levels, near, strict=True)]
    middles = (levels[1:] + levels[:-1]) / 2
    between = [
        np.count_nonzero(np.abs(volume - middle) < gap / 8) / (gap / 8)
        for middle, gap in zip(middles, gaps, strict=True)
    ]
    return np.array(between) / np.maximum(np.minimum(at[1:], at[:-1]), 1e-9)


def labelled(volume: F32, thresholds: F64) -> Labels:
    """Number of each voxel's material, from 0, the least dense."""
    return np.searchsorted(thresholds, volume).astype(np.uint8)


def probabilities(volume: F32, thresholds: F64, deviation: F32 | float) -> F32:
    """[material, z, y, x] probability that a voxel is of a material, for a normal error of its value.

    Args:
        deviation: standard deviation of the error, of each voxel or of all.
    """
    below = (ndtr((threshold - volume) / deviation) for threshold in thresholds)
    edges = [np.zeros_like(volume), *below, np.ones_like(volume)]
    return np.stack([high - low for low, high in pairwise(edges)]).astype(np.float32)
