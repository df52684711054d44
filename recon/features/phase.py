"""Phase: turns the bright rims of a propagated wave into contrast, by the filter for a single distance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft

from recon.base.arrays import F32
from recon.base.units import HC

_REACH = 4.0  # lengths: beyond, a pixel's influence is below exp(-4)


@dataclass(frozen=True)
class Paganin:
    """Line integrals of a sample of one material, from its intensity at one distance behind it.

    The transmission's transform is divided by 1 + (2 pi f length)², f in cycles a pixel (Paganin et al. 2002, J.
    Microsc. 206, 33, equation 12). The frame's edges are mirrors. It lowers the noise most if absorption is weak;
    detail finer than its length is lost to noise.

    Attributes:
        length: sqrt(distance delta / mu), in pixels, see `length_of`.
        unsharp: (sigma in pixels, weight) of a mask that restores fine detail: it adds weight times the difference of
        the transmission and its Gaussian blur. None: no mask.
    """

    length: float
    unsharp: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.length < math.inf:
            raise ValueError(f"length is in pixels, finite and 0 or more, got {self.length}")
        if self.unsharp is not None and not (self.unsharp[0] > 0 and 0 <= self.unsharp[1] < math.inf):
            raise ValueError(f"unsharp is a sigma > 0 and a weight >= 0, got {self.unsharp}")

    @property
    def reach(self) -> int:
        """Distance in pixels up to which others influence a pixel."""
        return math.ceil(_REACH * max(self.length, 0.0 if self.unsharp is None else self.unsharp[0]))

    def retrieve(self, views: F32, floor: float) -> None:
        """Replace measured line integrals [view, row, col] by those of the sample, in place; `floor`: least light."""
        from numba import config

        along = [(np.arange(n) / (2 * n)) ** 2 for n in views.shape[1:]]  # of the cosines of a mirrored frame
        f2 = along[0][:, None] + along[1]
        gain = 1 / (1 + (2 * math.pi * self.length) ** 2 * f2)
        if self.unsharp is not None:
            sigma, weight = self.unsharp
            gain *= 1 + weight * (1 - np.exp(-2 * (math.pi * sigma) ** 2 * f2))
        gain, threads = gain.astype(np.float32), config.NUMBA_NUM_THREADS
        for view in views:
            spectrum = fft.dctn(np.exp(-view), norm="ortho", overwrite_x=True, workers=threads)
            spectrum *= gain
            light = fft.idctn(spectrum, norm="ortho", overwrite_x=True, workers=threads)
            np.negative(np.log(np.maximum(light, floor, out=light), out=light), out=view)


def length_of(delta_beta: float, distance_mm: float, energy_kev: float, pitch_mm: float) -> float:
    """`Paganin.length` in pixels of `pitch_mm` at the sample.

    Args:
        delta_beta: ratio of the decrement delta of the refractive index to its absorption beta; mu = 4 pi beta /
            wavelength.
        distance_mm: from the sample to the detector; behind a source at sod, z sod / (sod + z) of a distance z (Fresnel
            scaling: Paganin 2006, Coherent X-Ray Optics, appendix B).
    """
    return math.sqrt(HC / energy_kev * distance_mm * delta_beta / (4 * math.pi)) / pitch_mm
