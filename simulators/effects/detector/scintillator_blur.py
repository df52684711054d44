"""Scintillator blur: scintillator and optics blur the light, and spread a little of it far away as glare."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from recon.base.jit import njit
from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import BelowOne, NotNegative, Positive
from simulators.frame.shot import CannotExposeError, Image, Shot
from simulators.pixels.bands import share_rows
from simulators.pixels.broad_blur import add_enlarged, broad_blur, exponential, lorentzian

TAILS = MappingProxyType({"exponential": exponential, "lorentzian": lorentzian})
NEGLIGIBLE = 1e-9
"""Share of a kernel's light beyond its last tap; the taps are normalised to a sum of 1."""
MAX_CORE = 64.0
"""Largest sigma of the core in pixels; the work grows with it."""


@dataclass(frozen=True)
class ScintillatorBlur(ImageEffect):
    """Point spread (1 - tail_share) Gaussian + tail_share tail, of integral 1; the frame's edges are mirrors.

    The core's taps go as exp(-b n²) with the b that gives the Gaussian's variance, however narrow (the discrete normal
    law, Kemp 1997, J. Stat. Plan. Inference 63:223); from 1 pixel of sigma on that is the Gaussian, with the transfer
    exp(-2 (pi f sigma)²). No tap is negative. Name it before the effects behind the optics.

    Attributes:
        fwhm_um: full width at half maximum of the core, um at the sample.
        tail_share: of the light that goes into the tail, 0 ... 1 (excluded).
        tail_um: width w of the tail, um at the sample.
        tail: "exponential", exp(-r/w) / 2πw² with the transfer (1 + (2πfw)²)^-1.5; or "lorentzian",
            w / 2π(r² + w²)^1.5 with the transfer exp(-2πfw), which reaches much farther.
    """

    fwhm_um: NotNegative
    tail_share: BelowOne = 0.0
    tail_um: Positive = 100.0
    tail: Literal["exponential", "lorentzian"] = "exponential"

    def apply(self, image: Image, shot: Shot) -> Image:
        """Raises CannotExposeError if the core is wider than MAX_CORE pixels: the units are probably wrong."""
        pixel_um = shot.detector.pitch * 1e3
        sigma = self.fwhm_um / pixel_um / math.sqrt(8 * math.log(2))
        if sigma > MAX_CORE:
            raise CannotExposeError(
                f"scintillator_blur: a core of {self.fwhm_um:g} um FWHM is {sigma:.0f} pixels (sigma) of "
                f"{pixel_um:g} um, above the limit of {MAX_CORE:g}; give a wide blur as the tail"
            )
        blurred = np.empty_like(image)
        taps = discrete_gaussian(sigma**2)
        share_rows(lambda first, end: _blur(first, end, image, taps, 1 - self.tail_share, blurred), image.shape)
        if self.tail_share > 0:
            add_enlarged(blurred, broad_blur(image, self.tail_um / pixel_um, TAILS[self.tail]), self.tail_share)
        return blurred


def discrete_gaussian(variance: float) -> NDArray[np.float64]:
    """Taps 0 ... r of the discrete normal law with this variance in pixels², float64 [tap]; both sides sum to 1."""
    if variance < NEGLIGIBLE:
        return np.ones(1)
    offsets = np.arange(2 + math.ceil(8 * math.sqrt(variance)), dtype=np.float64)

    def taps(steepness: float) -> NDArray[np.float64]:
        unscaled = np.exp(-steepness * offsets**2)
        return unscaled / (2 * unscaled.sum() - 1)

    steepness = 0.5 / variance
    if variance < 1:  # narrower than the sampling: a steeper law, because the continuous one would lose variance
        steepness = brentq(lambda b: 2 * float(offsets**2 @ taps(b)) - variance, 0.4, 1 + math.log(2 / variance))
    kept = taps(steepness)
    beyond = 2 * np.cumsum(kept[::-1])[::-1]  # light at this tap and beyond
    kept = kept[beyond >= NEGLIGIBLE]
    return kept / (2 * kept.sum() - kept[0])


@njit(cache=True, nogil=True)
def _blur(begin: int, end: int, image: Image, taps: NDArray[np.float64], weight: float, out: Image) -> None:
    """out = weight x image convolved with the symmetric taps along rows and columns, in rows begin ... end; the edges
    are mirrors."""
    rows, cols = image.shape
    reach = taps.size - 1
    for j in range(begin, end):
        line = np.zeros(cols + 2 * reach)
        middle = line[reach : reach + cols]
        for k in range(-reach, reach + 1):
            source = image[_mirrored(j + k, rows)]
            tap = weight * taps[abs(k)]
            for i in range(cols):
                middle[i] += tap * source[i]
        for i in range(reach):
            line[reach - 1 - i] = middle[_mirrored(-1 - i, cols)]
            line[reach + cols + i] = middle[_mirrored(cols + i, cols)]
        into = out[j]
        into[:] = 0.0
        for k in range(2 * reach + 1):
            tap = taps[abs(k - reach)]
            for i in range(cols):
                into[i] += tap * line[i + k]


@njit(cache=True, nogil=True)
def _mirrored(index: int, n: int) -> int:
    """Index in 0 ... n - 1 of a line of n pixels that is mirrored periodically at both ends."""
    within = index % (2 * n)
    return within if within < n else 2 * n - 1 - within
