"""lost_mass: weak matter that FBP shows above its own air, and that a volume without negative densities lacks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, binary_opening, find_objects, gaussian_filter, label

from recon.base.arrays import F32
from recon.base.noise import air_level

_BLOCKS = 96  # blocks of a volume along its longest side, at most
_SMOOTH, _SIGMAS = 1.5, 5.0  # blocks; of air
_MARGIN, _RIM = 4, 0.92  # blocks around matter; share of the radius that all views see
_LEAST_AIR = 100  # blocks
_LEFT = 0.5  # share of FBP's density: a voxel with less has lost it
_CORE = 3, 5, 5  # blocks along z, y and x of the boxes that a region is made of
_LEAST = 64  # blocks of a region
_BESIDE = 2  # blocks beside slices without beam that these are smoothed into


@dataclass(frozen=True)
class Comparison:
    """The matter that an FBP of the same views shows and a volume lacks.

    Attributes:
        lost: (z, y, x), first and end, of the largest region that lost its matter; None: no region lost any.
        kept: mass in that region over the mass in FBP, each above its own air.
    """

    lost: tuple[tuple[int, int], tuple[int, int], tuple[int, int]] | None = None
    kept: float = 1.0


def compare(volume: F32, reference: F32, seen: NDArray[np.bool_] | None = None) -> Comparison | None:
    """The largest region in which a volume lost weak matter that the reference shows above its own air.

    In blocks of voxels, so that a volume that lies on disk takes little memory. A region is a union of boxes
    of 3 x 5 x 5 blocks [z, y, x]: streaks are thinner.

    Args:
        volume: [z, y, x], of any method.
        reference: [z, y, x], FBP or FDK.
        seen: [z], slices of rows that got beam, which alone are compared: in others FBP shows a filling. None: all.

    Returns:
        None if the reference shows no air.
    """
    factor = max(1, math.ceil(max(volume.shape) / _BLOCKS))
    factor = min(factor, *volume.shape)
    shown, found = _blocks(reference, factor), _blocks(volume, factor)
    ny, nx = shown.shape[1:]
    y, x = np.mgrid[:ny, :nx]
    disc = np.hypot(y - (ny - 1) / 2, x - (nx - 1) / 2) <= _RIM * min(ny, nx) / 2
    inside = np.repeat(disc[None], len(shown), axis=0)
    if seen is not None:
        blocks = seen[: len(shown) * factor].reshape(-1, factor).all(axis=1)
        inside &= binary_erosion(blocks, iterations=_BESIDE, border_value=1)[:, None, None]
    smooth = [min(_SMOOTH, n / 8) for n in shown.shape]
    shown, found = (gaussian_filter(values, smooth, mode="nearest") for values in (shown, found))
    if not inside.any():
        return None
    level, noise = air_level(shown[inside])
    matter = (shown - level > _SIGMAS * noise) & inside
    air = inside & ~binary_dilation(matter, iterations=_MARGIN)
    if noise == 0 or air.sum() < _LEAST_AIR:
        return None
    own = float(found[air].mean(dtype=np.float64))
    comparison = Comparison()
    gone = matter & (found - own < _LEFT * (shown - level))
    core = [min(n, wide) for n, wide in zip(gone.shape, _CORE, strict=True)]
    parts, n = label(binary_opening(gone, np.ones(core)))
    sizes = np.bincount(parts.ravel())[1:]
    if not n or sizes.max() < _LEAST:
        return comparison
    at = int(sizes.argmax())
    region = parts == at + 1
    kept = float((found[region] - own).sum(dtype=np.float64) / (shown[region] - level).sum(dtype=np.float64))
    spans = tuple((part.start * factor, part.stop * factor) for part in find_objects(parts)[at])
    return Comparison((spans[0], spans[1], spans[2]), kept)


def _blocks(volume: F32, factor: int) -> F32:
    """Means of blocks of so many voxels a side; voxels at the ends that do not fill a block are dropped."""
    nz, ny, nx = (n // factor for n in volume.shape)
    blocks = np.empty((nz, ny, nx), np.float32)
    for z in range(nz):
        image = volume[z * factor : (z + 1) * factor, : ny * factor, : nx * factor].mean(axis=0, dtype=np.float32)
        blocks[z] = image.reshape(ny, factor, nx, factor).mean(axis=(1, 3))
    return blocks
