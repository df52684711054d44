"""Scintillator and optics: blur, glare, afterglow, dust and scratches."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from drivers.orca_quest import SENSOR_SHAPE
from recon.base.jit import njit
from recon.base.setting import setting
from simulators.effects.chain import ImageEffect, SamplingEffect
from simulators.frame.mapping import BelowOne, NotNegative, Positive, Whole
from simulators.frame.shot import CannotExposeError, Image, Moments, Shot, fixed_rng
from simulators.pixels.bands import share_rows
from simulators.pixels.broad_blur import add_enlarged, broad_blur, exponential, lorentzian

TAILS = MappingProxyType({"exponential": exponential, "lorentzian": lorentzian})
NEGLIGIBLE = 1e-9
"""Share of the intensity of a kernel beyond its last tap; the taps are normalised to a sum of 1."""
MAX_CORE = 64.0
"""Largest sigma of the core in pixels, because the work grows with sigma."""


@dataclass(frozen=True)
class ScintillatorBlur(ImageEffect):
    """The point spread is (1 - tail_share) Gaussian + tail_share tail, with integral 1; the edges of the frame are
    mirrors.

    The core's taps go as exp(-b n²) with the b that gives the Gaussian's variance, however narrow (the discrete normal
    law, Kemp 1997, J. Stat. Plan. Inference 63:223); from a sigma of 1 pixel on this law is the Gaussian, with the
    transfer exp(-2 (pi f sigma)²). No tap is negative. Name this effect before the effects behind the optics.

    Attributes:
        fwhm_um: full width at half maximum of the core, um at the sample. tail_share: share of the intensity in the
            tail, 0 ... 1 (excluded).
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
    if variance < 1:  # narrower than the sampling; a steeper law, because the continuous one would lose variance
        steepness = brentq(lambda b: 2 * float(offsets**2 @ taps(b)) - variance, 0.4, 1 + math.log(2 / variance))
    weights = taps(steepness)
    beyond = 2 * np.cumsum(weights[::-1])[::-1]  # intensity at this tap and beyond
    weights = weights[beyond >= NEGLIGIBLE]
    return weights / (2 * weights.sum() - weights[0])


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


Reals = NDArray[np.float64]
REACH = 4.0  # a Gaussian is drawn up to this number of sigmas; less than 4e-4 of its depth is beyond


@dataclass(frozen=True)
class FlatStructure(ImageEffect):
    """Each speck and scratch multiplies the intensity by 1 - depth x Gaussian.

    A flat corrects them, unless the beam has moved (beam_profile) or the image is blurred after them. Name dust on the
    scintillator before scintillator_blur, dust on the camera's window after it. Specks and scratches are computed for
    sensor pixels and averaged over binned pixels, so that they are the same for any ROI and binning.

    Attributes:
        specks: number of specks on the whole sensor.
        radius_um: mean of their radii (sigmas; half to one and a half times this), um at the sample.
        depth: mean share of the intensity that is lost in the middle of a speck; a speck has between 0 and twice this.
        scratches: number of straight scratches on the whole sensor.
        scratch_length_um: mean of their lengths (exponentially distributed), um at the sample.
        scratch_width_um: sigma across them, um at the sample.
        scratch_depth: mean share of the intensity that is lost along a scratch; a scratch has between 0 and twice this.
            seed: seed of places, sizes and depths.
    """

    specks: int = setting(200, ge=0, le=100_000)
    radius_um: Positive = 10.0
    depth: float = setting(0.1, ge=0, le=0.5)
    scratches: int = setting(5, ge=0, le=1000)
    scratch_length_um: Positive = 2000.0
    scratch_width_um: Positive = 3.0
    scratch_depth: float = setting(0.05, ge=0, le=0.5)
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        image *= self.transmission(shot)
        return image

    def transmission(self, shot: Shot) -> Image:
        """Share of the intensity that remains, float64 [row, col]."""
        pixel_um = shot.detector.pitch / shot.binning * 1e3
        row0, col0, rows, cols = shot.roi
        transmission = np.ones((rows, cols))
        rng = fixed_rng(self.name, self.seed)
        for row, col, radius, depth in self._specks(rng, pixel_um):
            _draw_speck(transmission, row - row0, col - col0, radius, depth)
        for row, col, angle, length, depth in self._scratches(rng, pixel_um):
            _draw_scratch(transmission, row - row0, col - col0, angle, length, self.scratch_width_um / pixel_um, depth)
        n = shot.binning
        return transmission if n == 1 else transmission.reshape(rows // n, n, cols // n, n).mean(axis=(1, 3))

    def _specks(self, rng: np.random.Generator, pixel_um: float) -> Reals:
        """Sensor row and column, radius in sensor pixels and depth; float64 [speck, 4]."""
        draw = rng.random((self.specks, 4))
        draw[:, 2] += 0.5
        return draw * (*SENSOR_SHAPE, self.radius_um / pixel_um, 2 * self.depth)

    def _scratches(self, rng: np.random.Generator, pixel_um: float) -> Reals:
        """Sensor row and column of the middle, angle, length in sensor pixels and depth; float64 [scratch, 5]."""
        draw = rng.random((self.scratches, 5))
        draw[:, 3] = -np.log1p(-draw[:, 3])
        return draw * (*SENSOR_SHAPE, np.pi, self.scratch_length_um / pixel_um, 2 * self.scratch_depth)


def _draw_speck(transmission: Reals, row: float, col: float, radius: float, depth: float) -> None:
    """Multiply a round Gaussian into `transmission`; row and column may lie outside."""
    rows = _window(row, REACH * radius, transmission.shape[0])
    cols = _window(col, REACH * radius, transmission.shape[1])
    if rows.size and cols.size:
        down, across = (
            np.exp(-0.5 * ((positions - middle) / radius) ** 2) for positions, middle in ((rows, row), (cols, col))
        )
        transmission[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] *= 1 - depth * down[:, None] * across


def _draw_scratch(
    transmission: Reals, row: float, col: float, angle: float, length: float, width: float, depth: float
) -> None:
    """Multiply a straight line with a Gaussian across it and at its ends into `transmission`, at pixels near it only.

    The line is followed along the axis that it is closer to, and drawn across that axis at each of its pixels.
    """
    if abs(np.sin(angle)) < abs(np.cos(angle)):
        transmission, row, col, angle = transmission.T, col, row, np.pi / 2 - angle
    along, across = np.sin(angle), np.cos(angle)
    steps = _window(row, abs(along) * length / 2 + REACH * width, transmission.shape[0])
    # Along the axis, an inclined line of width w has the width w / cos, at most √2 w.
    reach = int(np.ceil(REACH * width * np.sqrt(2)))
    middle = np.rint(col + (steps - row) * across / along).astype(np.int64)
    whole = 2 * reach >= transmission.shape[1]  # a line wider than the frame covers each column of the frame once
    columns = (
        np.arange(transmission.shape[1]) + 0 * middle[:, None]
        if whole
        else middle[:, None] + np.arange(-reach, reach + 1)
    )
    dy, dx = (steps - row)[:, None], columns - col
    t, s = dy * along + dx * across, dx * along - dy * across  # pixels along the line and across
    beyond = np.maximum(np.abs(t) - length / 2, 0.0)
    loss = depth * np.exp(-0.5 * (s**2 + beyond**2) / width**2)
    inside = (columns >= 0) & (columns < transmission.shape[1])
    transmission[np.broadcast_to(steps[:, None], columns.shape)[inside], columns[inside]] *= 1 - loss[inside]


def _window(middle: float, reach: float, extent: int) -> NDArray[np.int64]:
    """Indices 0 ... extent - 1 within reach of the middle."""
    return np.arange(max(0, int(np.ceil(middle - reach))), min(extent, int(np.floor(middle + reach)) + 1))


@dataclass(frozen=True)
class Afterglow(SamplingEffect):
    """The prompt share of the light is 1 - sum of shares; a share p comes later, after an exponentially distributed
    time.

    The delays of all components and the moments of earlier effects (name it after motion_blur) form one distribution of
    times. A Gauss rule of `samples` moments replaces it, exact for its powers up to 2 x samples - 1 (Golub & Welsch
    1969). So only `samples` line integrals are added. An edge that moves by many pixels within a decay time appears as
    `samples` separate edges instead of a trail.

    Shutter, sample and beam are assumed unchanged over the delays. Not simulated are the light that is missing just
    after the shutter opens, and the light in a dark just after it closes. The weights sum to 1.

    Figures: a maker's table (Crytur, scintillation materials) gives the light 6 ms after the X-rays. It is below 2 %
    for CsI:Tl and below 0.005 % for YAG:Ce. Decay constants of the prompt light are 900 ns and 70 ns (LuAG:Ce: 70 ns,
    no afterglow stated). It depends on dose and temperature: measure.

    Attributes:
        shares: of the light, one for each component; their sum below 1.
        decay_times: times in s to fall to 1/e, one for each component. samples: number of moments in the past, for all
            components together.
    """

    shares: tuple[NotNegative, ...]
    decay_times: tuple[Positive, ...]
    samples: int = setting(3, ge=1, le=32)

    def __post_init__(self) -> None:
        if not self.shares or len(self.shares) != len(self.decay_times):
            raise ValueError(f"each component needs a share and a decay time, got {self}")
        if not 0 < sum(self.shares) < 1:
            raise ValueError(f"the sum of the shares must lie in 0 ... 1 (both excluded), got {sum(self.shares)}")

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        """The given times with smaller weights, and times in the past.

        The times of the rows must differ only by shifts, as after blur and rolling shutter."""
        share = sum(self.shares)
        middle = moments.weights @ moments.times  # [row]
        spread = moments.times[:, 0] - middle[0]
        age, chance = np.polynomial.laguerre.laggauss(self.samples)  # moments of the exponential law with decay time 1
        ages = np.concatenate([decay * age for decay in self.decay_times])
        chances = np.concatenate([part / share * chance for part in self.shares])
        past, weights = gauss_rule(
            np.subtract.outer(spread, ages).reshape(-1), np.outer(moments.weights, chances).reshape(-1), self.samples
        )
        return Moments(
            np.concatenate([moments.times, middle + past[:, None]]),
            np.concatenate([(1 - share) * moments.weights, share * weights]),
        )


def gauss_rule(points: Reals, weights: Reals, n: int) -> tuple[Reals, Reals]:
    """n points and weights (or fewer, if these suffice) with the same moments up to order 2n - 1 as the given ones.

    By Lanczos' recursion (Golub & Welsch 1969, Math. Comp. 23:221; Gautschi 2004)."""
    scale = float(np.abs(points).max()) or 1.0
    basis = [np.sqrt(weights / weights.sum())]
    diagonal, off_diagonal = [], []
    for _ in range(min(n, points.size)):
        following = points / scale * basis[-1]
        diagonal.append(float(basis[-1] @ following))
        for _ in range(2):  # twice is enough (Parlett 1980)
            for vector in basis:
                following = following - (vector @ following) * vector
        off_diagonal.append(float(np.linalg.norm(following)))
        if off_diagonal[-1] < 1e-12:
            break
        basis.append(following / off_diagonal[-1])
    size = len(diagonal)
    jacobi = np.diag(diagonal) + np.diag(off_diagonal[: size - 1], 1) + np.diag(off_diagonal[: size - 1], -1)
    nodes, vectors = np.linalg.eigh(jacobi)
    return nodes * scale, vectors[0] ** 2 * weights.sum()
