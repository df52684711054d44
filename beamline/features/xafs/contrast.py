"""Contrast: of a region against its surroundings in a radiograph, and its curve over energies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from recon.base.arrays import Mask

Reals = NDArray[np.float64]

NEARLY_BEST = 0.95
WINDOW = 7  # energies
ENOUGH = 50  # pixels inside the rim for an estimate of the noise; with fewer the rim is used, too
FEWEST = 16  # pixels for any estimate of the noise
DARK = 0.01  # largest share of dark pixels in a region
KNOWN = 0.5  # least share of pixels with a value in a region


@dataclass(frozen=True, eq=False)
class ContrastRegions:
    """The pixels that are compared.

    Attributes:
        inside: bool [row, col], of the material.
        around: bool [row, col], of its surroundings, disjoint from `inside`; None: no comparison.
        thickness: mm of the material, mean over `inside`; None: not known.
    """

    inside: Mask
    around: Mask | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        for name, mask in (("inside", self.inside), ("around", self.around)):
            if mask is not None and mask.sum() < 1:
                raise ValueError(f"the region {name} the material has no pixels")


@dataclass(frozen=True, eq=False)
class XafsCurve:
    """Absorption over energies.

    Attributes:
        energies: keV, rising, [n].
        absorption: [n], of the region minus that of its surroundings, in `unit`.
        contrast: the same as a line integral, [n]; None where only the absorption is known.
        noise: rms noise of the difference of a pixel inside and one around, as a line integral, [n]; None likewise, and
            where the regions are too small.
        unit: "1/mm" where the thickness is known, else "line integral" or that of the file.
        left_out: keV, rising, energies at which too little light was transmitted or too few pixels had a value.
    """

    energies: Reals
    absorption: Reals
    contrast: Reals | None = None
    noise: Reals | None = None
    unit: str = "line integral"
    left_out: Reals = field(default_factory=lambda: np.zeros(0))

    @property
    def contrast_to_noise(self) -> Reals | None:
        """|contrast| over noise, [n]; None where either is unknown or the noise is 0.

        Noise of a few hundred pixels is known to 5 %, and differs as much between energies: it is smoothed
        over neighbouring energies.
        """
        if self.contrast is None or self.noise is None or not (self.noise > 0).all():
            return None
        smooth, _ = local_parabolas(self.energies, np.log(self.noise), min(WINDOW, self.noise.size))
        return np.abs(self.contrast) * np.exp(-smooth)

    @property
    def best(self) -> int:
        """Index of the energy of the highest contrast-to-noise; of the highest absorption where noise is unknown."""
        by = self.contrast_to_noise
        return int(np.argmax(np.abs(self.absorption) if by is None else by))

    @property
    def nearly_best(self) -> tuple[float, float]:
        """Range in keV around the best energy with at least 95 % of its contrast-to-noise."""
        by = self.contrast_to_noise
        values = np.abs(self.absorption) if by is None else by
        good = values >= NEARLY_BEST * values[self.best]
        first = last = self.best
        while first > 0 and good[first - 1]:
            first -= 1
        while last < good.size - 1 and good[last + 1]:
            last += 1
        return float(self.energies[first]), float(self.energies[last])


def contrast_of(frame: Reals, regions: ContrastRegions) -> tuple[float, float]:
    """Contrast of a radiograph of line integrals, and the noise of the difference of two of its pixels (NaN: too few
    pixels).

    Both are NaN where a region is not usable: more than 1 % of its pixels are dark (+inf), or less than half of them
    have a value. The mean of the others is not the region's then, and pixels without light have no noise.
    """
    inside, noise = _level(frame, regions.inside)
    if regions.around is None:
        return inside, noise
    around, noise_around = _level(frame, regions.around)
    return inside - around, float(np.hypot(noise, noise_around))


def curve_of(energies: Reals, points: Sequence[tuple[float, float]], regions: ContrastRegions) -> XafsCurve:
    """The curve of points from `contrast_of`, sorted by energy; unknown points are left out."""
    order = np.argsort(energies, kind="stable")
    contrast, noise = np.array(points, dtype=np.float64).reshape(-1, 2).T[:, order]
    known, e = np.isfinite(contrast), energies[order]
    contrast, noises = contrast[known], None if np.isnan(noise[known]).any() else noise[known]
    if regions.thickness is None:
        return XafsCurve(e[known], contrast, contrast, noises, left_out=e[~known])
    return XafsCurve(e[known], contrast / regions.thickness, contrast, noises, "1/mm", e[~known])


def _level(frame: Reals, mask: Mask) -> tuple[float, float]:
    """Mean over the mask, and the noise of a pixel of it.

    The noise is the response of a filter that removes planes and products of lines (Immerkaer, Comput. Vis. Image
    Underst. 64, 300, 1996), scaled from its median over the pixels for a normal distribution, so that edges within the
    region have little influence. The region's rim is excluded where enough pixels are within it.
    """
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    # Only the region and its neighbouring pixels: frames may be far larger.
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


def local_parabolas(x: Reals, y: Reals, window: int) -> tuple[Reals, Reals]:
    """Value and slope at each x of the parabola through the nearest `window` points (for even spacing the filter of
    Savitzky & Golay, Anal. Chem. 36, 1627, 1964); both [n], of at least `window` points."""
    values, slopes = np.empty_like(y), np.empty_like(y)
    for i in range(y.size):
        first = min(max(i - window // 2, 0), y.size - window)
        part = slice(first, first + window)
        values[i], slopes[i], _ = np.polynomial.polynomial.polyfit(x[part] - x[i], y[part], 2)
    return values, slopes
