"""Contrast: how a region stands out of what is around it in a radiograph, and the curve of that over energies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from beamline.xafs.local import local_parabolas

Reals = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEARLY_BEST = 0.95
WINDOW = 7  # energies
ENOUGH = 50  # pixels to take a noise from
FEWEST = 16  # of them, to take any
DARK = 0.01  # of a region's pixels: with more of them dark, nothing is known of it
KNOWN = 0.5  # of a region's pixels, at least


@dataclass(frozen=True, eq=False)
class Regions:
    """Which pixels are compared.

    Attributes:
        inside: bool [row, col], of the material.
        around: bool [row, col], of what it is compared with, none of it inside; None: with nothing.
        thickness: mm of the material, mean over `inside`; None: not known.
    """

    inside: Mask
    around: Mask | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        for name, mask in (("inside", self.inside), ("around", self.around)):
            if mask is not None and mask.sum() < 1:
                raise ValueError(f"the region {name} the material has no pixel")


@dataclass(frozen=True, eq=False)
class Curve:
    """Absorption over energies.

    Attributes:
        energies: keV, rising, [n].
        absorption: [n], of the region less what is around it, in `unit`.
        contrast: the same as a line integral, [n]; None where only the absorption is known.
        noise: rms noise of the difference of a pixel inside and one around, as a line integral, [n]; None likewise, and
            where the regions are too small to tell.
        unit: "1/mm" where the thickness is known, else "line integral" or the file's own word.
        left_out: keV, rising, of the energies at which too little light came through, or too few pixels had a value.
    """

    energies: Reals
    absorption: Reals
    contrast: Reals | None = None
    noise: Reals | None = None
    unit: str = "line integral"
    left_out: Reals = field(default_factory=lambda: np.zeros(0))

    @property
    def contrast_to_noise(self) -> Reals | None:
        """|contrast| over noise, [n]; None where either is unknown or there is no noise at all.

        The noise of a few hundred pixels is known to 5 % only, which is as much as energies differ: it is smoothed over
        neighbouring ones.
        """
        if self.contrast is None or self.noise is None or not (self.noise > 0).all():
            return None
        smooth, _ = local_parabolas(self.energies, np.log(self.noise), min(WINDOW, self.noise.size))
        return np.abs(self.contrast) * np.exp(-smooth)

    @property
    def best(self) -> int:
        """Position of the energy of the highest contrast-to-noise; of the highest contrast, or absorption, where noise
        is unknown."""
        by = self.contrast_to_noise
        return int(np.argmax(np.abs(self.absorption) if by is None else by))

    @property
    def nearly_best(self) -> tuple[float, float]:
        """keV from and to which, around the best, at least 95 % of it is kept."""
        by = self.contrast_to_noise
        values = np.abs(self.absorption) if by is None else by
        good = values >= NEARLY_BEST * values[self.best]
        first = last = self.best
        while first > 0 and good[first - 1]:
            first -= 1
        while last < good.size - 1 and good[last + 1]:
            last += 1
        return float(self.energies[first]), float(self.energies[last])


def measured(frame: Reals, regions: Regions) -> tuple[float, float]:
    """Contrast of a radiograph of line integrals, and the noise of the difference of two of its pixels (NaN: too few
    pixels to tell).

    Both are NaN where nothing is known of a region: more than 1 % of its pixels are dark (+inf; what is left of such a
    region is not its mean, and the noise of no light is none), or less than half of them have a value.
    """
    inside, noise = _level(frame, regions.inside)
    if regions.around is None:
        return inside, noise
    around, noise_around = _level(frame, regions.around)
    return inside - around, float(np.hypot(noise, noise_around))


def curve_of(energies: Reals, points: Sequence[tuple[float, float]], regions: Regions) -> Curve:
    """The curve of the points that `measured` gave, in the order of the energies, of those that are known."""
    order = np.argsort(energies, kind="stable")
    contrast, noise = np.array(points, dtype=np.float64).reshape(-1, 2).T[:, order]
    known, e = np.isfinite(contrast), energies[order]
    contrast, noises = contrast[known], None if np.isnan(noise[known]).any() else noise[known]
    if regions.thickness is None:
        return Curve(e[known], contrast, contrast, noises, left_out=e[~known])
    return Curve(e[known], contrast / regions.thickness, contrast, noises, "1/mm", e[~known])


def _level(frame: Reals, mask: Mask) -> tuple[float, float]:
    """Mean over the mask, and the noise of a pixel of it.

    The noise is what is left of the image after a mask to which planes and products of lines are nothing (Immerkaer,
    Comput. Vis. Image Underst. 64, 300, 1996); its median over the pixels, for a normal distribution, so that edges
    within the region count for little. The region's own rim is left out where enough pixels are within it.
    """
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    # Only the region and the pixels next to it: frames may be far larger.
    part = slice(max(rows[0] - 1, 0), rows[-1] + 2), slice(max(cols[0] - 1, 0), cols[-1] + 2)
    frame, mask = frame[part], mask[part]
    values = frame[mask]
    dark, known = np.isposinf(values), np.isfinite(values)
    if dark.sum() > DARK * (dark | known).sum() or known.sum() < KNOWN * values.size:
        return math.nan, math.nan
    frame = np.where(np.isfinite(frame), frame, np.nan)
    curved = np.full_like(frame, np.nan)
    inner = frame[1:-1, 1:-1]
    sides = frame[:-2, 1:-1] + frame[2:, 1:-1] + frame[1:-1, :-2] + frame[1:-1, 2:]
    corners = frame[:-2, :-2] + frame[:-2, 2:] + frame[2:, :-2] + frame[2:, 2:]
    curved[1:-1, 1:-1] = 4 * inner - 2 * sides + corners
    left = curved[binary_erosion(mask, np.ones((3, 3)))]
    left = left[np.isfinite(left)]
    if left.size < ENOUGH:
        left = curved[mask & np.isfinite(curved)]
    noise = float(np.median(np.abs(left)) / 0.6745 / 6) if left.size >= FEWEST else math.nan
    return float(values[known].mean()), noise
