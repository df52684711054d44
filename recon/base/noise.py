"""Noise of a scan, measured from third and fourth differences along rows and columns; and the air level."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import scipy  # every scan imports this module, so scipy.ndimage is loaded only when it is first used
from numpy.typing import NDArray

from recon.base.arrays import F32, median_deviation, some_values
from recon.base.geometry import Geometry

NOISE_VIEWS = 16  # number of projections from which the noise is measured
_LOW_ORDER, _HIGH_ORDER = 3, 4  # orders of the differences; the higher order contains finer structure
_LARGEST_BLUR = 1.5  # largest width of a blur in pixels
_BOW_TIE_ROWS, _BOW_TIE_BINS, _LEAST_POWERS = 32, 16, 200
_ANGLE_TOLERANCE = 0.02  # tolerance of the angles, as a share of the step between projections
# number of values and of bins of a histogram; smallest height of a peak, as a share of the highest
_SAMPLED, _BINS, _PEAK = 2**20, 400, 0.1
_CLIPPING_SIGMAS, _ROUNDS = 4.0, 20  # clipping limit in standard deviations of air; largest number of rounds
_GROWTH = 4.0  # largest standard deviation of air, divided by that of the values below its most frequent value


def noise_level(images: F32) -> float:
    """Standard deviation of the noise in a typical pixel, for white noise or noise that was blurred afterwards.

    The sample changes slowly from pixel to pixel, noise does not. So differences of order n along both axes contain
    mostly noise. For white noise, the standard deviation of these differences is C(2n, n) times that of the noise.
    Noise that was blurred, by interpolation or in a scintillator, is weaker at high frequencies. So the fourth
    differences, divided by C(8, 4), are smaller than the third differences, divided by C(6, 3). Their ratio gives the
    width of the blur, which is assumed to be Gaussian. The width gives the noise at all frequencies. Constant offsets
    of a pixel (rings) do not count. [our own method; median of differences: Immerkær 1996, Comput. Vis. Image Underst.
    64, 300]

    On real samples, the result differs from the true value by at most a third for white noise, and by at most a half
    for noise blurred by up to 0.7 pixel (tests/recon/base/test_noise.py). In almost noiseless projections, fine texture
    counts as noise.

    Args:
        images: [view, a, b], line integrals; NaN marks pixels that do not count. An axis is used only if at least five
            successive pixels along it are not NaN. About 16 projections are read.

    Returns:
        The standard deviation; 0 if no axis is used.
    """
    sampled = images[:: max(1, len(images) // NOISE_VIEWS)][:NOISE_VIEWS]
    axes = _long_axes(sampled)
    low, high = _differences(sampled, axes, _LOW_ORDER), _differences(sampled, axes, _HIGH_ORDER)
    if low == 0:
        return 0.0
    ratios, gains = _blurs()
    by_chance = 2 / math.sqrt(sampled.size)  # tolerance: white noise has a ratio of 1 within this
    first = int(np.searchsorted(-ratios, -min((high / low + by_chance) ** (2 / len(axes)), 1.0)))
    return low * float(gains[min(first, gains.size - 1)]) ** (len(axes) / 2)


def deviation_between_neighbours(values: NDArray[np.floating[Any]], order: int = 1, axis: int = -1) -> float:
    """Standard deviation of the white noise that would have the same differences of this order along an axis; 0 if no
    difference is finite."""
    return median_deviation(np.diff(values, order, axis=axis)) / math.sqrt(math.comb(2 * order, order))


def deviation_between_frames(frames: NDArray[np.floating[Any]]) -> float:
    """Standard deviation of a pixel between successive frames [frame, row, col], without changes of the whole frame.

    Differences of successive frames contain no slow drift and no fixed pattern. If there is only one frame, its
    neighbouring pixels are compared instead.
    """
    if len(frames) == 1:
        return median_deviation(frames - np.nanmedian(frames))
    change = np.diff(frames, axis=0)
    return median_deviation(change - np.nanmedian(change, axis=(1, 2), keepdims=True)) / math.sqrt(2.0)


def noise_beside_structure(lines: F32, geometry: Geometry) -> float:
    """Noise of the projections: the smaller of `noise_level` and the noise measured at frequencies that the sample
    cannot have.

    If the stage turns by an angle, a point that is at most R pixels from the axis moves by at most R times this angle.
    So a sample has no harmonics of order k in the angle at column frequencies below k / R (the bow-tie of a sinogram:
    Rattey & Lindgren 1981, IEEE Trans. Acoust. 29, 994; of a fan: Mazin & Pelc 2010, Med. Phys. 37, 2674). Noise has
    these harmonics, so they measure the noise even if the sample has fine structure. The projections must be straight
    and evenly spread over 360°, or over 180° for a parallel beam. Their number must exceed about a third of the number
    of columns (half of that for 180°).

    Args:
        lines: [view, col, row]; rows with NaN are not used.
    """
    return min(noise_level(lines), _beyond_the_bow_tie(lines, geometry))


def _beyond_the_bow_tie(lines: F32, geometry: Geometry) -> float:
    """Standard deviation of the white noise that would have the same power at these frequencies; infinite if it cannot
    be measured."""
    order = _evenly_spread(geometry)
    cols, bins = geometry.detector_shape[1], np.arange(2, 2 + _BOW_TIE_BINS)
    axis = geometry.axis_col + geometry.shifts[:, 0]
    half = int(min(axis.min(), cols - 1 - axis.max()))
    rows = np.flatnonzero(np.isfinite(lines).all(axis=(0, 1)))
    if order is None or not geometry.is_straight or geometry.skew or half <= bins[-1] or not rows.size:
        return math.inf
    rows = rows[:: -(-rows.size // _BOW_TIE_ROWS)]
    middle = round(float(axis.mean()))
    chosen = np.arange(max(0, middle - half), min(cols, middle + half + 1))
    window = np.hanning(chosen.size + 2)[1:-1]
    omega = 2 * np.pi * bins / chosen.size
    waves = window[:, None] * np.exp(-1j * omega * (chosen[:, None] - middle))
    spectrum = np.einsum("vcr,cm->vmr", lines[order][:, chosen][:, :, rows], waves, optimize=True)
    spectrum *= np.exp(1j * omega * (axis[order, None] - middle))[:, :, None]
    theta = np.unwrap(geometry.angles[order])
    if np.ptp(theta) < 1.01 * np.pi:  # the projections of the other 180° are the mirror images of these
        spectrum = np.concatenate((spectrum, spectrum.conj()))
    count = len(spectrum)
    power = np.abs(np.fft.fft(spectrum, axis=0)) ** 2 / (count * (window**2).sum())
    reach = half + 0.5 + float(np.ptp(axis))
    reach_ratio = reach * geometry.sample_pitch / geometry.sod
    bound = (
        reach / (1 - reach_ratio) * (omega + 4 * np.pi / chosen.size) + 2
        if reach_ratio < 1
        else np.full(bins.size, np.inf)
    )
    free = np.abs(np.fft.fftfreq(count) * count)[:, None] > bound
    sampled = power[free]
    return math.sqrt(float(sampled.mean())) if sampled.size >= _LEAST_POWERS else math.inf


def _evenly_spread(geometry: Geometry) -> NDArray[np.intp] | None:
    """Projections in the order of their angles, if these are evenly spread over 360°, or 180° for a parallel beam."""
    theta = np.mod(geometry.angles, 2 * np.pi)
    order = np.argsort(theta, kind="stable")
    gaps = np.diff(theta[order], append=theta[order[0]] + 2 * np.pi)
    order = np.roll(order, -1 - int(np.argmax(gaps)))  # start after the widest gap
    steps = np.mod(np.diff(theta[order]), 2 * np.pi)
    if steps.size < 3 or np.ptp(steps) > _ANGLE_TOLERANCE * steps.mean():
        return None
    for period in (2 * np.pi,) if geometry.is_cone else (np.pi, 2 * np.pi):
        for views in (order.size, order.size - 1):  # the last projection of the turn may repeat the first one
            if abs(views * steps.mean() - period) < _ANGLE_TOLERANCE * period / views:
                return order[:views]
    return None


def air_level(values: F32) -> tuple[float, float]:
    """The air level of a volume and its standard deviation.

    The search starts at the lowest value that many voxels have. It then repeatedly takes the median of the values
    within four standard deviations of the level. If air is uneven, its standard deviation is limited to four times that
    of the values below the first level.
    """
    values = some_values(values, _SAMPLED)
    low, high = np.percentile(values, (0.05, 99.95))
    if not high > low:
        return float(low), 0.0
    counts, edges = np.histogram(values, _BINS, (low, high))
    smooth = np.concatenate(([0], scipy.ndimage.gaussian_filter(counts.astype(np.float64), 2), [0]))
    least = _PEAK * smooth.max()
    first_peak = _first_peak(smooth, least, least / 2)
    level = float(edges[first_peak - 1] + edges[first_peak]) / 2
    depths = level - values[values < level]
    first = noise = median_deviation(depths)
    for _ in range(_ROUNDS):
        near_level = values[np.abs(values - level) <= _CLIPPING_SIGMAS * noise]
        if not near_level.size:  # all lower values are equal
            break
        last_values, level = (level, noise), float(np.median(near_level))
        noise = min(median_deviation(near_level - level), _GROWTH * first)
        if (level, noise) == last_values:
            break
    return level, noise


def _first_peak(curve: NDArray[np.float64], height: float, prominence: float) -> int:
    """Index of the first maximum with this height and prominence (the middle of a plateau), as scipy's `find_peaks`.

    A curve that begins and ends at its minimum has such a maximum. scipy.signal is not used, because it takes a second
    to load.
    """
    # first and last index of runs of equal values
    bounds = np.flatnonzero(np.diff(curve, prepend=np.nan, append=np.nan))
    for first, last in zip(bounds[:-1], bounds[1:] - 1, strict=True):
        top = curve[first]
        if top < height or first == 0 or last == curve.size - 1 or max(curve[first - 1], curve[last + 1]) > top:
            continue
        before, after = curve[:first][::-1], curve[last + 1 :]
        valleys = [
            side[: np.argmax(higher) if (higher := side > top).any() else None].min() for side in (before, after)
        ]
        if top - max(valleys) >= prominence:
            return int(first + last) // 2
    raise ValueError(
        f"the curve has no peak with a height of at least {height:.3g} and a prominence of at least {prominence:.3g}"
    )


def _long_axes(images: F32) -> list[int]:
    """Axes along which five successive pixels are valid, even after differences were taken along the previous axes."""
    field, axes = images, list[int]()
    for axis in (1, 2):
        further = np.diff(field, _HIGH_ORDER, axis=axis)
        if np.isfinite(further).any():
            field = further
            axes.append(axis)
    return axes


def _differences(images: F32, axes: list[int], order: int) -> float:
    """Standard deviation of the white noise that would have the same differences of this order; NaN marks pixels that
    do not count."""
    if not axes:
        return 0.0
    field: NDArray[np.floating[Any]] = images
    n = len(images)
    for axis in axes:
        field = np.diff(field, order, axis=axis)
    if n >= NOISE_VIEWS // 2:
        field = (field - np.nan_to_num(field).mean(axis=0)) * math.sqrt(n / (n - 1))
    return median_deviation(field) / math.comb(2 * order, order) ** (len(axes) / 2)


@cache
def _blurs() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """For Gaussian blurs of rising width: the variance of differences of order `_HIGH_ORDER`, and the variance of the
    pixels themselves, each divided by the variance of differences of order `_LOW_ORDER`.
    """
    widths = np.linspace(0, _LARGEST_BLUR, 301)
    f = (np.arange(4096) + 0.5) / 8192  # cycles a pixel
    passed = np.exp(-((2 * np.pi * widths[:, None] * f) ** 2))
    low, high = (
        (passed * (2 * np.sin(np.pi * f)) ** (2 * n)).mean(axis=1) / math.comb(2 * n, n)
        for n in (_LOW_ORDER, _HIGH_ORDER)
    )
    return high / low, passed.mean(axis=1) / low
