"""Phase fringes: the wave interferes with itself between sample and detector, which gives edges bright rims."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.base.jit import njit, thread_count
from recon.base.setting import setting
from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Positive
from simulators.frame.shot import CannotExposeError, Detector, Image, Shot
from simulators.pixels.bands import share_rows
from simulators.pixels.broad_blur import add_enlarged

HC = 1.239841984e-6
"""keV mm: wavelength in mm times photon energy (CODATA 2018)."""
DARKEST = 1e-30
"""Smallest transmission, so that the depth is finite."""
STEEPEST = math.pi / 2
"""Largest phase step in radians between neighbouring pixels of the wave. The square of the wave has twice the
bandwidth, and must not alias either."""


@dataclass(frozen=True)
class PhaseFringes(ImageEffect):
    """Fresnel propagation of the wave exp(-d/2 (1 + i delta/beta)) behind an object of one material.

    With the refractive index 1 - delta + i beta and mu = 4 pi beta / wavelength, the depth d = mu t gives amplitude and
    phase. The wave's cosine transform is multiplied by exp(-i pi wavelength z f²) (Paganin 2006, Coherent X-Ray Optics,
    ch. 1.4; f cycles/mm). The square of the result is the intensity. It is never negative and has the same sum. The
    edges of the frame are mirrors. To first order in z it is T - (z delta / mu) laplace T (Paganin et al. 2002, J.
    Microsc. 206:33). The transforms are single precision: intensities are right to 1e-5 of the open beam.

    In a cone the frame is that of a plane wave at the distance z / M, M = 1 + z / sod, at the sample's scale (Fresnel
    scaling theorem, Paganin 2006, appendix B). Here the pitch of the detector is in this scale. Source and detector
    blur the fringes; for this blur, name scintillator_blur, too.

    Edges of solids turn the phase by many radians a pixel, which a wave sampled on the pixels cannot represent. If the
    Fresnel number of a pixel is 1 or more, fringes are finer than pixels: use "transport". This method moves photons
    between neighbouring pixels, to first order in z, and no pixel gives more photons than it has.

    Attributes:
        delta_beta: ratio of delta to beta of the material at the energy.
        distance: mm from the sample to the detector; in a cone sdd - sod. energy: photon energy in keV. oversampling:
            pixels of the wave per pixel and axis, 1 ... 8. The depth is interpolated linearly between pixels, and the
            intensity is averaged over each pixel. This adds a blur with a variance of 1/4 pixel². Work and memory grow
            as the square of the oversampling. Only the method "wave" uses it.
        method: "wave" or, near the sample, "transport".
    """

    delta_beta: NotNegative
    distance: NotNegative
    energy: Positive
    oversampling: int = setting(1, ge=1, le=8)
    method: Literal["wave", "transport"] = "wave"

    def __post_init__(self) -> None:
        if self.method == "transport" and self.oversampling != 1:
            raise ValueError(f"oversampling is for the method wave only; omit it, got {self.oversampling}")

    @property
    def wavelength(self) -> float:
        """mm."""
        return HC / self.energy

    def apply(self, image: Image, shot: Shot) -> Image:
        """Raises CannotExposeError if the method does not hold; the message says what would help."""
        z = self.distance / (1 + self.distance / shot.detector.sod)
        area = self.wavelength * z / shot.detector.pitch**2
        if self.method == "transport":
            self._check_transport(area)
            np.exp(np.negative(image, out=image), out=image)
            image = _transported(image, area * self.delta_beta / (4 * math.pi))
        else:
            self._check_propagator(z, shot.detector)
            self._check_wave(image, area)
            image[:] = self._wave_intensity(image, area)
        np.log(np.maximum(image, DARKEST, out=image), out=image)
        return np.negative(image, out=image)

    def _wave_intensity(self, depth: Image, area: float) -> NDArray[np.float32]:
        n = self.oversampling
        if n == 1:
            return _propagated(depth, self.delta_beta, area)
        rows, cols = depth.shape
        fine = np.zeros((rows * n, cols * n))
        add_enlarged(fine, depth, 1.0)
        return _propagated(fine, self.delta_beta, area * n**2).reshape(rows, n, cols, n).mean(axis=(1, 3))

    def _check_transport(self, area: float) -> None:
        if area > 1:
            raise CannotExposeError(
                f"phase_fringes: a pixel's Fresnel number is {1 / area:.2g}, but the method transport "
                "needs 1 or more, because fringes must be wider than pixels. Give at most "
                f"{self.distance / area:.3g} mm of distance, or method wave"
            )

    def _check_propagator(self, z: float, detector: Detector) -> None:
        """Critical sampling of N (finer) pixels p: wavelength z <= N p² (Voelz & Roggemann 2009, Appl. Opt. 48:6132).

        At that limit the finest fringes travel wavelength z / 2p, half the frame, and meet their mirror images.
        """
        n, pitch = min(detector.shape), detector.pitch
        farthest = n * pitch**2 / self.oversampling / self.wavelength
        if z > farthest:
            raise CannotExposeError(
                f"phase_fringes: the propagator would alias over {z:g} mm (effective) at {self.energy:g} keV. Pixels "
                f"of {pitch * 1e3:g} um have a Fresnel number of {pitch**2 / (self.wavelength * z):.2g}, and {n} of "
                f"them with oversampling {self.oversampling} need {self.oversampling / n:.2g} or more. Give at most "
                f"{farthest:.3g} mm, larger pixels or a larger frame"
            )

    def _check_wave(self, depth: Image, area: float) -> None:
        single = depth.astype(np.float32)
        step = max(float(np.abs(np.diff(single, axis=axis)).max(initial=0.0)) for axis in (0, 1))
        turn = step * self.delta_beta / 2
        if turn > STEEPEST * self.oversampling:
            wanted = math.ceil(turn / STEEPEST)
            advice = f"oversampling {wanted}, smaller pixels" if wanted <= 8 else "smaller pixels"
            raise CannotExposeError(
                f"phase_fringes: the wave would alias, because with delta_beta {self.delta_beta:g} its "
                f"phase changes by {turn:.3g} rad between pixels, and oversampling {self.oversampling} "
                f"allows {STEEPEST * self.oversampling:.3g}. Give {advice} or a smaller delta_beta"
                + (", or method transport" if area <= 1 else "")
            )


def _propagated(depth: Image, delta_beta: float, area: float) -> NDArray[np.float32]:
    """Intensity float32 [row, col]; `area` is wavelength x distance over the pixel's area. `depth` is not changed."""
    turns = depth * (-delta_beta / (4 * math.pi))
    turns -= np.rint(turns)  # whole turns removed: single precision cannot hold thousands of radians
    phase = (2 * math.pi * turns).astype(np.float32)
    amplitude = np.exp(-0.5 * depth.astype(np.float32))
    rows, cols = (np.exp(-0.25j * np.pi * area * (np.arange(n) / n) ** 2).astype(np.complex64) for n in depth.shape)
    threads = thread_count()
    wave = np.empty(depth.shape, np.complex64)
    for part, wanted in ((wave.real, np.cos), (wave.imag, np.sin)):
        part[:] = fft.dctn(amplitude * wanted(phase), norm="ortho", overwrite_x=True, workers=threads)
    wave *= rows[:, None]
    wave *= cols
    intensity = np.zeros(depth.shape, np.float32)
    for part in (wave.real, wave.imag):
        field = fft.idctn(np.ascontiguousarray(part), norm="ortho", overwrite_x=True, workers=threads)
        intensity += np.square(field, out=field)
    return intensity


def _transported(intensity: Image, share: float) -> Image:
    """light - share x its Laplacian (in pixels, edges are mirrors): each pixel moves light to its brighter neighbours.

    A pixel that would give more light than it has gives all of it, in the same proportions."""
    kept, out = np.empty_like(intensity), np.empty_like(intensity)
    share_rows(lambda first, end: _keep(first, end, intensity, share, kept), intensity.shape)
    share_rows(lambda first, end: _give(first, end, intensity, share, kept, out), intensity.shape)
    return out


@njit(cache=True, nogil=True)
def _keep(begin: int, end: int, intensity: Image, share: float, kept: Image) -> None:
    """Limits the photons that pixels of rows begin ... end give to the photons that they have: writes a factor for each
    pixel to `kept`."""
    rows, cols = intensity.shape
    for j in range(begin, end):
        above, below = intensity[max(j - 1, 0)], intensity[min(j + 1, rows - 1)]
        for i in range(cols):
            own = intensity[j, i]
            left, right = intensity[j, max(i - 1, 0)], intensity[j, min(i + 1, cols - 1)]
            given = share * (
                max(above[i] - own, 0.0) + max(below[i] - own, 0.0) + max(left - own, 0.0) + max(right - own, 0.0)
            )
            kept[j, i] = own / given if given > own else 1.0


@njit(cache=True, nogil=True)
def _give(begin: int, end: int, intensity: Image, share: float, kept: Image, out: Image) -> None:
    """The photons in the pixels of rows begin ... end after the exchange."""
    rows, cols = intensity.shape
    for j in range(begin, end):
        above, below = max(j - 1, 0), min(j + 1, rows - 1)
        for i in range(cols):
            left, right = max(i - 1, 0), min(i + 1, cols - 1)
            gain = (
                _gain(intensity, kept, j, i, above, i)
                + _gain(intensity, kept, j, i, below, i)
                + _gain(intensity, kept, j, i, j, left)
                + _gain(intensity, kept, j, i, j, right)
            )
            out[j, i] = max(intensity[j, i] + share * gain, 0.0)  # negative by rounding only


@njit(cache=True, nogil=True)
def _gain(intensity: Image, kept: Image, j: int, i: int, k: int, m: int) -> float:
    """Photons that pixel (j, i) gets from its neighbour (k, m) for a share of 1; negative if it gives photons."""
    more = intensity[j, i] - intensity[k, m]
    return more * (kept[k, m] if more > 0 else kept[j, i])
