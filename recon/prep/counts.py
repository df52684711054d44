"""Counts: photon counts behind a sample. Their likelihood is converted to line integrals with weights, which every
method can use.

The logarithm of few counts is biased (E log n < log E n), and a zero count has no logarithm. The likelihood has neither
problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from recon.base.arrays import F32, F64
from recon.base.declared_types import check_settings

# Standard deviation, in pixels, of the smoothing of the counts around which the likelihood is expanded. Chosen from 1,
# 1.5, 2 and 3 by the error of the expansion on three samples at 10 to 10 000 photons. The next two values were chosen
# in the same way.
_SIGMA, _SPREAD = 1.5, 2.0
# variance of the counts, divided by the variance of counting noise; a larger ratio means detail of the sample
_DETAIL = 1.5
_FEWEST = 0.25  # smallest expected number of photons of a ray


@dataclass(frozen=True)
class Photons:
    """Gain and noise of a detector that counts photons, see `photon_transfer`.

    Attributes:
        gain: camera gain, counts per photon.
        variance: variance of a pixel in one dark frame, counts².
    """

    gain: float
    variance: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.gain < np.inf:
            raise ValueError(f"gain (counts per photon) must be finite and above 0, got {self.gain}")
        if not 0 <= self.variance < np.inf:
            raise ValueError(f"variance must be finite and 0 or more, got {self.variance}")


@dataclass(frozen=True, eq=False)
class Counts:
    """Detector counts with the sample, without the sample (flat), and without the beam (dark).

    The model of a pixel (shifted Poisson: Snyder, Hammoud & White 1993, JOSA A 10, 1014; Yavuz & Fessler 1998): (counts
    - dark) / gain + v is Poisson with mean (flat - dark) / gain x e^(-line integral) + v, where v is variance / gain².
    The model assumes that flat and dark have no noise, because they are means of many frames.

    Attributes:
        counts: [view, row, col], any real type.
        flat: counts with the beam and without the sample, [row, col] or [view, row, col].
        dark: counts without the beam, a number or [row, col].
        gain: camera gain, counts per photon, see `photon_transfer`.
        variance: variance of a pixel in one dark frame, counts², a number or [row, col]. It is the noise of the
            readout, and of photons that carry no information about the sample.
    """

    counts: ArrayLike
    flat: ArrayLike
    dark: ArrayLike = 0.0
    gain: float = 1.0
    variance: ArrayLike = 0.0

    def __post_init__(self) -> None:
        check_settings(self)
        shape = np.shape(self.counts)
        if len(shape) != 3 or 0 in shape:
            raise ValueError(f"counts must be [view, row, col] with at least one pixel, got shape {shape}")
        for name, allowed in (
            ("flat", (shape, shape[1:])), ("dark", ((), shape[1:])), ("variance", ((), shape[1:]))
        ):  # fmt: skip
            given = np.shape(getattr(self, name))
            if given not in allowed:
                raise ValueError(
                    f"{name} has shape {given}; for counts of shape {shape} it must be {' or '.join(map(str, allowed))}"
                )
        if not 0 < self.gain < np.inf:
            raise ValueError(f"gain (counts per photon) must be finite and above 0, got {self.gain}")
        if not np.asarray(self.variance).min() >= 0:
            raise ValueError(f"variance must be 0 or more, got {np.asarray(self.variance).min()}")
        if not (np.asarray(self.flat) > np.asarray(self.dark)).any():
            raise ValueError(
                "no pixel of the flat is brighter than the dark: the beam was off, or dark and flat are exchanged"
            )

    def photons(self, view: int) -> tuple[F64, F64, F64]:
        """Three images [row, col] of a projection: the counted photons, the photons without the sample, and the
        variance v of a dark frame in photons² (see `Counts`).

        Read noise can make the counted photons negative; values below -v are replaced by -v. The counted photons of a
        pixel are NaN if the counts of the pixel are NaN. If the flat of a pixel is not above the dark, the photons
        without the sample are 0.
        """
        dark = np.asarray(self.dark, np.float64)
        flat = np.asarray(self.flat)
        flat_of_view = np.asarray(flat if flat.ndim == 2 else flat[view], np.float64)
        counted = (np.asarray(np.asarray(self.counts)[view], np.float64) - dark) / self.gain
        beam = np.maximum((flat_of_view - dark) / self.gain, 0.0)
        dark_variance = np.broadcast_to(np.asarray(self.variance, np.float64) / self.gain**2, counted.shape)
        return np.maximum(counted, -dark_variance), beam, dark_variance


def expanded(photons: F64, beam: F64, dark_variance: F64, around: F64) -> tuple[F64, F64]:
    """Line integrals and weights for each pixel. Their weighted squares equal the likelihood to second order.

    With λ = beam e^(-p0) + v expected at p0 = `around` and n = photons + v counted, the negative log-likelihood is
    Σ λ - n ln λ, where v is `dark_variance`. At p0 the gradient of this function equals the gradient of ½ w (p - p~)²,
    and the curvature of that square is Fisher's information. p~ = p0 - (n - λ) / (λ - v), w = (λ - v)² / λ (iteratively
    reweighted least squares: McCullagh & Nelder 1989, section 2.5). Counts of zero need no special treatment.
    """
    transmitted = beam * np.exp(-around)
    return (
        around - (photons - transmitted) / transmitted,
        transmitted * transmitted / (transmitted + dark_variance),
    )


def line_integrals(counts: Counts) -> tuple[F32, F32]:
    """Line integrals and weights [view, row, col]. With them, every method uses the likelihood of the counts.

    The likelihood of a projection is expanded around its counts, which are smoothed where they show only counting noise
    (Lee 1980, IEEE Trans. Pattern Anal. Mach. Intell. 2, 165). If the counts are large, the result is the logarithm.
    The weights are the inverse variances of the line integrals, computed from the smoothed counts. Pixels that are not
    finite or have no beam get NaN and weight 0.
    """
    shape = np.shape(counts.counts)
    data, weights = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for view in range(shape[0]):
        data[view], weights[view] = of_view(*counts.photons(view))
    if not weights.any():
        raise ValueError(
            "nothing can be reconstructed: expected at least one pixel with a finite count and with beam in the flat"
        )
    return data, weights


def of_view(photons: F64, beam: F64, dark_variance: F64) -> tuple[F64, F64]:
    """Line integrals and weights of one projection [row, col], from the images of `Counts.photons`."""
    usable = np.isfinite(photons) & (beam > 0)
    open_beam = np.where(usable, beam, 1.0)
    expected, smooth = _expected(
        np.where(usable, photons, 0), np.where(usable, beam, 0), np.where(usable, dark_variance, 0)
    )
    lines, _ = expanded(np.where(usable, photons, expected), open_beam, dark_variance, -np.log(expected / open_beam))
    # Weights that follow the noise of a single ray would hide this noise from methods that whiten with the weights.
    _, weights = expanded(smooth, open_beam, dark_variance, -np.log(smooth / open_beam))
    return np.where(usable, lines, np.nan), np.where(usable, weights, 0)


def photon_transfer(flats: ArrayLike, darks: ArrayLike | None = None) -> tuple[float, float]:
    """Counts per photon, and variance of a pixel in a dark frame (counts²), from repeated frames [frame, row, col].

    The variance of the counts grows with their mean, with slope `gain` (photon transfer: Janesick 2007). Differences of
    successive frames, scaled to equal means, contain no fixed pattern and no drift of the beam. Medians over the pixels
    are not affected by defects. If the image is blurred after the photons are counted (scintillator afterglow,
    resampling), the variance is lower. The gain is then too small, and the number of photons too large.

    Args:
        darks: dark frames. None: the detector is assumed to give 0 without beam, and to add no noise.

    Raises:
        ValueError: there are fewer than two frames, or the variance of the flats does not grow with the intensity.
    """
    flat, flat_variance = _mean_and_variance(flats, "flats", scaled=True)
    dark, dark_variance = (
        (np.zeros(1), np.zeros(1)) if darks is None else _mean_and_variance(darks, "darks", scaled=False)
    )
    signal, noise = flat - dark, flat_variance - dark_variance
    exposed = signal > 0.1 * np.median(signal)
    # Ratio of sums over the pixels in the beam, without the 1 % with the largest variances (hot pixels).
    exposed &= flat_variance <= np.percentile(flat_variance, 99)
    gain = float(noise[exposed].sum() / signal[exposed].sum()) if exposed.any() else 0.0
    if not gain > 0:
        raise ValueError(
            "the gain cannot be measured here, because the variance of the flats does not grow with their intensity "
            f"(gain {gain:.3g} counts per photon); state the gain"
        )
    return gain, float(np.median(dark_variance))


def _expected(photons: F64, beam: F64, dark_variance: F64) -> tuple[F64, F64]:
    """Photons expected in each pixel [row, col], above 0. They are the counts, smoothed everywhere or only where they
    show no detail."""
    mean = _smooth(photons, _SIGMA) / np.maximum(_smooth(beam, _SIGMA), 1e-12) * beam
    # share of the variance of white noise in n - mean: 1 - 2 / 2πσ² + 1 / 4πσ²
    noise_share = 1 - 0.75 / (np.pi * _SIGMA**2)
    variance = _smooth((photons - mean) ** 2, _SPREAD) / noise_share
    counting = _smooth(photons + dark_variance, _SPREAD)
    detail = np.clip(1 - _DETAIL * counting / np.maximum(variance, 1e-12), 0, 1)
    return np.maximum(mean + detail * (photons - mean), _FEWEST), np.maximum(mean, _FEWEST)


def _smooth(image: F64, sigma: float) -> F64:
    return np.asarray(ndimage.gaussian_filter(image, sigma, mode="nearest"))


def _mean_and_variance(frames: ArrayLike, name: str, *, scaled: bool) -> tuple[F64, F64]:
    """Mean and variance of each pixel over the frames; the variance is from differences of successive frames."""
    stack = np.asarray(frames)
    if stack.ndim != 3 or len(stack) < 2:
        raise ValueError(f"{name} must be [frame, row, col] with at least two frames, got shape {stack.shape}")
    mean, total = stack.mean(axis=0, dtype=np.float64), np.zeros(stack.shape[1:])
    level = stack.mean(axis=(1, 2), dtype=np.float64)
    factors = level.mean() / level if scaled and level.min() > 0 else np.ones(len(stack))
    for a, b, fa, fb in zip(stack[:-1], stack[1:], factors[:-1], factors[1:], strict=True):
        total += (a * fa - b * fb) ** 2
    return mean, total / (2 * (len(stack) - 1))
