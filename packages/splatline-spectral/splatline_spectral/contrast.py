"""Contrast between a region of a radiograph and its surroundings, its curve over energies, and the edge in the
curve."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.special import stdtr

Reals = NDArray[np.float64]

NEARLY_BEST = 0.95
WINDOW = 7  # number of energies over which the noise is smoothed
ENOUGH = 50  # fewest pixels inside the rim from which the noise is estimated; with fewer, the rim is also used
FEWEST = 16  # fewest pixels for an estimate of the noise
DARK = 0.01  # largest share of dark pixels in a region
KNOWN = 0.5  # smallest share of pixels with a value in a region
_LIT, _LIT_SHARE = 0.5, 1e-3  # least intensity: counts above the dark level or, if this is less, fraction of the flat


@dataclass(frozen=True, eq=False)
class ContrastRegions:
    """The pixels that are compared.

    Attributes:
        inside: bool [row, col], pixels of the material.
        around: bool [row, col], pixels of its surroundings, disjoint from `inside`; None: no comparison.
        thickness: mean thickness of the material over `inside` in mm; None: not known.
    """

    inside: NDArray[np.bool_]
    around: NDArray[np.bool_] | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        for inside_or_around, mask in (("inside", self.inside), ("around", self.around)):
            if mask is not None and mask.sum() < 1:
                raise ValueError(f"the region {inside_or_around} the material has no pixels")


@dataclass(frozen=True, eq=False)
class Series:
    """Radiographs of a material at several energies.

    Attributes:
        title: what is scanned.
        n: number of energies.
        frames: (keV, line integrals [row, col]) at each energy, in any order. +inf: the pixel is dark. NaN: no value.
        regions: the pixels that are compared.
        elements: atomic numbers of the material; empty: not known.
    """

    title: str
    n: int
    frames: Iterable[tuple[float, Reals]]
    regions: ContrastRegions
    elements: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class XafsCurve:
    """Absorption over energies.

    Attributes:
        energies: keV, rising, [n].
        absorption: [n], absorption of the region minus that of its surroundings, in `unit`.
        contrast: [n], the same as a line integral; None: only the absorption is known.
        noise: [n], rms noise of the difference between a pixel inside and a pixel around, as a line integral; None:
            only
            the absorption is known, or the regions are too small.
        unit: "1/mm" if the thickness is known, else "line integral" or that of the file.
        left_out: keV, rising, energies with too little transmitted intensity or too few pixels with a value.
    """

    energies: Reals
    absorption: Reals
    contrast: Reals | None = None
    noise: Reals | None = None
    unit: str = "line integral"
    left_out: Reals = field(default_factory=lambda: np.zeros(0))

    @property
    def contrast_to_noise(self) -> Reals | None:
        """|contrast| divided by noise, [n]; None if either is unknown or the noise is 0.

        The noise estimated from a few hundred pixels is uncertain by 5 %, and scatters by 5 % from energy to energy. So
        the noise is smoothed over neighbouring energies.
        """
        if self.contrast is None or self.noise is None or not (self.noise > 0).all():
            return None
        smooth, _ = local_parabolas(self.energies, np.log(self.noise), min(WINDOW, self.noise.size))
        return np.abs(self.contrast) * np.exp(-smooth)

    @property
    def best(self) -> int:
        """Index of the energy with the highest contrast-to-noise ratio. If the noise is not known, that of the highest
        absorption."""
        by = self.contrast_to_noise
        return int(np.argmax(np.abs(self.absorption) if by is None else by))

    @property
    def nearly_best(self) -> tuple[float, float]:
        """Range in keV around the best energy with at least 95 % of the best contrast-to-noise."""
        by = self.contrast_to_noise
        values = np.abs(self.absorption) if by is None else by
        good = values >= NEARLY_BEST * values[self.best]
        first = last = self.best
        while first > 0 and good[first - 1]:
            first -= 1
        while last < good.size - 1 and good[last + 1]:
            last += 1
        return float(self.energies[first]), float(self.energies[last])


def line_integrals(signal: Reals, flat: Reals) -> Reals:
    """-log(signal / flat), [row, col], from counts above the dark level. +inf: nothing was transmitted. NaN: the flat
    is dark, too, or a value is not finite."""
    least_signal = np.minimum(_LIT, _LIT_SHARE * flat)
    out = np.full(np.broadcast_shapes(signal.shape, flat.shape), np.nan)
    known = np.isfinite(signal) & (flat > 0) & (flat < np.inf)
    np.log(
        np.divide(flat, signal, where=known & (signal > least_signal), out=out),
        where=known & (signal > least_signal),
        out=out,
    )
    out[known & (signal <= least_signal)] = np.inf
    return out


def contrast_of(frame: Reals, regions: ContrastRegions) -> tuple[float, float]:
    """Contrast in a radiograph of line integrals, and the noise of the difference of two of its pixels (NaN: too few
    pixels).

    Both are NaN if a region cannot be used: more than 1 % of its pixels are dark (+inf), or fewer than half of them
    have a value. The mean of the other pixels would then not be that of the region, and dark pixels have no noise.
    """
    inside, noise = _level(frame, regions.inside)
    if regions.around is None:
        return inside, noise
    around, noise_around = _level(frame, regions.around)
    return inside - around, float(np.hypot(noise, noise_around))


def curve_of(energies: Reals, points: Sequence[tuple[float, float]], regions: ContrastRegions) -> XafsCurve:
    """The curve through points from `contrast_of`, sorted by energy; unknown points are left out."""
    order = np.argsort(energies, kind="stable")
    contrast, noise = np.array(points, dtype=np.float64).reshape(-1, 2).T[:, order]
    known, e = np.isfinite(contrast), energies[order]
    contrast, noises = contrast[known], None if np.isnan(noise[known]).any() else noise[known]
    if regions.thickness is None:
        return XafsCurve(e[known], contrast, contrast, noises, left_out=e[~known])
    return XafsCurve(e[known], contrast / regions.thickness, contrast, noises, "1/mm", e[~known])


def _level(frame: Reals, mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean over the mask, and the noise of one of its pixels.

    The noise is the response of a filter that removes planes and products of lines (Immerkaer, Comput. Vis. Image
    Underst. 64, 300, 1996). It is computed from the median over the pixels, so that edges within the region have little
    influence. The rim of the region is left out if enough pixels remain.
    """
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    # Use only the region and its neighbouring pixels, because frames may be far larger.
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
    residual = curved[binary_erosion(mask, np.ones((3, 3)))]
    residual = residual[np.isfinite(residual)]
    if residual.size < ENOUGH:
        residual = curved[mask & np.isfinite(curved)]
    noise = float(np.median(np.abs(residual)) / 0.6745 / 6) if residual.size >= FEWEST else math.nan
    return float(values[known].mean()), noise


def local_parabolas(x: Reals, y: Reals, window: int) -> tuple[Reals, Reals]:
    """Value and slope at each x of the parabola fitted to the nearest `window` points (for even spacing the filter of
    Savitzky & Golay, Anal. Chem. 36, 1627, 1964). Both [n]; there must be at least `window` points."""
    values, slopes = np.empty_like(y), np.empty_like(y)
    for i in range(y.size):
        first = min(max(i - window // 2, 0), y.size - window)
        part = slice(first, first + window)
        values[i], slopes[i], _ = np.polynomial.polynomial.polyfit(x[part] - x[i], y[part], 2)
    return values, slopes


LEAST = 9  # fewest energies of a curve
NARROW = 5  # points for a local parabola
SURE = 5.0  # smallest ratio of the misfit of a smooth curve to the noise that shows an edge
FALSE_ALARM = 1e-6  # probability of an edge in a curve without one, for normal noise of any size
SMOOTH = 1e-3  # tolerated relative difference of a noise-free smooth curve from Victoreen's


@dataclass(frozen=True)
class AbsorptionEdge:
    """Absorption edge and white line of a curve."""

    found: bool  # there is an edge within the range
    reason: str  # why no edge was found, as a sentence
    energy: float | None  # keV of the steepest rise; None: no edge
    white_line: float | None  # keV of the maximum above the edge; None without a maximum within the range
    misfit: float  # rms difference from the best smooth curve, in units of the absorption
    noise: float  # rms noise of the curve, in units of the absorption


def find_edge(energies: Reals, absorption: Reals) -> AbsorptionEdge:
    """The edge of a curve.

    A curve without an edge follows Victoreen, a + b E^-3 + c E^-4 (J. Appl. Phys. 19, 855, 1948), within its noise.
    There is an edge if a step upwards at one of the energies improves the fit more than chance does in one of a million
    such curves. The test is Student's t of the step, times the number of possible positions. There is also an edge if
    the curve differs from Victoreen's by five times its noise, estimated from second differences. The edge is the
    maximum of the slope near that step (of parabolas through five points). The white line is the maximum above it, if
    it exceeds the noise and the extrapolation of the curve's far end.

    Args:
        energies: keV, rising, [n].
        absorption: [n], of any unit.

    Raises:
        ValueError: fewer than nine energies, or energies that do not rise.
    """
    if energies.size < LEAST or not (np.diff(energies) > 0).all():
        raise ValueError(f"to find an edge, at least {LEAST} energies in rising order are needed; got {energies.size}")
    noise = _noise(absorption)
    basis = np.linalg.qr(_victoreen(energies))[0]
    rest = absorption - basis @ (basis.T @ absorption)
    misfit = float(np.sqrt(np.mean(rest**2)))
    step, chance = _step(rest, basis)

    def none(reason: str) -> AbsorptionEdge:
        return AbsorptionEdge(False, reason, None, None, misfit, noise)

    stands_out = chance < FALSE_ALARM or misfit > SURE * noise
    if not stands_out or misfit <= SMOOTH * float(np.abs(absorption).mean()):
        return none("within the noise, the absorption curve is as smooth as a curve without an edge")
    _, slope = local_parabolas(energies, absorption, NARROW)
    first = max(step - max(NARROW, energies.size // 10), 0)
    steepest = first + int(np.argmax(slope[first : step + max(NARROW, energies.size // 10)]))
    if slope[steepest] <= 0:
        return none("the absorption does not rise at any energy")
    if steepest < 2 or steepest > energies.size - 3:
        return none("widen the range of energies: the curve is steepest at the end of the range")
    return AbsorptionEdge(
        True, "", _top(energies, slope, steepest, 1), _white_line(energies, absorption, steepest, noise), misfit, noise
    )


def _step(rest: Reals, basis: Reals) -> tuple[int, float]:
    """The step upwards that explains most of a residual: the index of the first energy above the step, and the
    probability (at most 1) that noise alone explains as much.

    Args:
        rest: [n], residual after the projection on `basis`.
        basis: orthonormal, [n, k].
    """
    candidates = np.arange(2, rest.size - 1)
    above, held = (np.cumsum(values[::-1], axis=0)[::-1][candidates] for values in (rest, basis))
    free = np.maximum(rest.size - candidates - (held**2).sum(axis=1), 1e-9)  # squared norm outside of the basis
    gain = np.where(above > 0, above**2 / free, 0.0)
    best, freedom = int(np.argmax(gain)), rest.size - basis.shape[1] - 1
    noise = max(float(rest @ rest) - float(gain[best]), 0.0) / freedom
    t = math.sqrt(float(gain[best]) / noise) if noise > 0 else math.inf
    return int(candidates[best]), min(float(stdtr(freedom, -t)) * candidates.size, 1.0)


def _white_line(energies: Reals, absorption: Reals, edge: int, noise: float) -> float | None:
    top = edge + int(np.argmax(absorption[edge:]))
    rises = float(absorption[top] - absorption[: edge + 1].min())
    far = energies > (energies[top] + energies[-1]) / 2
    if top > energies.size - 3 or far.sum() < 3:
        return None
    # Continue the far end as a + b E^-3, because over a long range the top of a bare step is above the end, too.
    basis = _victoreen(energies)[:, :2]
    of_far = np.linalg.pinv(basis[far]).T @ basis[top]
    height = float(absorption[top] - of_far @ absorption[far])
    if height <= max(SURE * noise * math.sqrt(1 + float(of_far @ of_far)), 0.05 * rises):
        return None
    return _top(energies, absorption, top, 2)


def _noise(values: Reals) -> float:
    """rms of white noise in smooth values, from second differences, whose variance is six times that of the noise."""
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6))


def _victoreen(energies: Reals) -> Reals:
    """1, E^-3 and E^-4, [n, 3]."""
    x = energies.mean() / energies
    return np.stack([np.ones_like(x), x**3, x**4], axis=1)


def _top(energies: Reals, values: Reals, index: int, reach: int) -> float:
    """The energy at which the parabola through the points around a maximum is highest, within a step of the maximum."""
    part = slice(max(index - reach, 0), index + reach + 1)
    _, slope, bend = np.polynomial.polynomial.polyfit(energies[part] - energies[index], values[part], 2)
    low, high = energies[max(index - 1, 0)], energies[min(index + 1, energies.size - 1)]
    vertex = energies[index] - slope / (2 * bend) if bend < 0 else energies[index]
    return float(np.clip(vertex, low, high))
