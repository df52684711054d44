"""Phase: turns the bright rims of a propagated wave into contrast, by the filter for a single distance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.units import HC
from recon.base.volume import Grid
from recon.voxels.held_out import beyond_chance, predicted_views, preferred_strength
from recon.voxels.methods import FistaTv

_REACH = 4.0  # lengths: beyond, a pixel's influence is below exp(-4)
LONGEST = 8.0
"""Length in pixels up to which it is sought by views."""
TRIAL_ROWS, FEWEST_VIEWS = 8, 16
"""Rows that the search looks at, and views that it needs."""
_FIRST, _ONE_IN, _SWEEPS, _TV_WEIGHT = (
    0.5,
    8,
    12,
    5e-4,
)  # square of the first length; views held out; iterations of a trial
_RAYS, _VOLUMES = 6, 8  # float32 copies of the views and of the volume
_ERRORS = 4.0  # standard errors by which a filter must predict better than none


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
        f2 = _squared_frequencies(views)
        gain = 1 / (1 + (2 * math.pi * self.length) ** 2 * f2)
        if self.unsharp is not None:
            sigma, weight = self.unsharp
            gain *= 1 + weight * (1 - np.exp(-2 * (math.pi * sigma) ** 2 * f2))
        for view in views:
            light = _filtered_light(view, gain.astype(np.float32))
            np.negative(np.log(np.maximum(light, floor, out=light), out=light), out=view)


def _squared_frequencies(views: F32) -> F64:
    """[row, col] of the cosines of a mirrored frame, in cycles a pixel, squared."""
    along = [(np.arange(n) / (2 * n)) ** 2 for n in views.shape[1:]]
    return along[0][:, None] + along[1]


def _filtered_light(view: F32, gain: F32) -> F32:
    """The transmission of line integrals [row, col], its cosine transform times `gain`."""
    from numba import config

    spectrum = fft.dctn(np.exp(-view), norm="ortho", overwrite_x=True, workers=config.NUMBA_NUM_THREADS)
    spectrum *= gain
    return np.asarray(fft.idctn(spectrum, norm="ortho", overwrite_x=True, workers=config.NUMBA_NUM_THREADS))


def length_of(delta_beta: float, distance_mm: float, energy_kev: float, pitch_mm: float) -> float:
    """`Paganin.length` in pixels of `pitch_mm` at the sample.

    Args:
        delta_beta: ratio of the decrement delta of the refractive index to its absorption beta; mu = 4 pi beta /
            wavelength.
        distance_mm: from the sample to the detector; behind a source at sod, z sod / (sod + z) of a distance z (Fresnel
            scaling: Paganin 2006, Coherent X-Ray Optics, appendix B).
    """
    return math.sqrt(HC / energy_kev * distance_mm * delta_beta / (4 * math.pi)) / pitch_mm


@dataclass(frozen=True)
class FringesSeen:
    """The filter's length that predicts views held out best.

    Attributes:
        length: in pixels.
        factor: by which its square may be larger or smaller, by how views held out disagree; one standard error.
        gain: share of the residual of these views that the filter takes, beside none.
    """

    length: float
    factor: float
    gain: float


def search_memory(geometry: Geometry) -> int:
    """Bytes that `fringes_seen` takes at most, with some rows of such views."""
    rows, cols = min(TRIAL_ROWS, geometry.detector_shape[0]), geometry.detector_shape[1]
    return 4 * rows * cols * (_RAYS * geometry.n_views + _VOLUMES * cols)


def fringes_seen(views: F32, geometry: Geometry, floor: float, known: NDArray[np.bool_] | None) -> FringesSeen | None:
    """The length of Paganin's filter by views held out; None where no filter predicts them as well, or too few views.

    A volume of the other views, filtered, is projected, and its transmission T gets the fringes back, as
    T - length² laplace T. So views as measured are the yardstick of every length. Filtered ones are not, since a longer
    filter makes any views smoother.

    Args:
        views: line integrals [view, row, col]; some rows are enough, and take less time.
        floor: least light.
        known: [row, col] pixels that were measured; None: all.
    """
    if geometry.n_views < FEWEST_VIEWS:
        return None
    residuals: dict[float, F64] = {}

    def residuals_of(square: float) -> F64:
        if square not in residuals:
            filtered = views.copy()
            Paganin(math.sqrt(square)).retrieve(filtered, floor)
            unseen, images = predicted_views(
                FistaTv(_SWEEPS, _TV_WEIGHT), filtered, geometry, Grid.matching(geometry), known, _ONE_IN
            )
            gain = (1 + (2 * math.pi) ** 2 * square * _squared_frequencies(views)).astype(np.float32)
            left = [_filtered_light(image, gain) - np.exp(-views[n]) for n, image in zip(unseen, images, strict=True)]
            rays = np.ones(views.shape[1:], np.bool_) if known is None else known
            residuals[square] = np.array([np.sqrt(np.mean(np.square(each[rays], dtype=np.float64))) for each in left])
        return residuals[square]

    best = preferred_strength(residuals_of, _FIRST)
    if best is None or best.strength > LONGEST**2:
        return None
    none = residuals_of(0.0)
    if not beyond_chance(none - best.residuals, _ERRORS):
        return None
    at = next(square for square, each in residuals.items() if each is best.residuals)
    beside = (residuals_of(at * factor) - best.residuals for factor in (0.5, 2.0))
    return FringesSeen(math.sqrt(best.strength), _factor(*beside), 1 - float(best.residuals.mean() / none.mean()))


def _factor(weaker: F64, stronger: F64) -> float:
    """2 to the standard error of the vertex of a parabola through residuals [view] an octave apart, less the least."""
    slope, bend = (weaker - stronger) / 2, float((weaker + stronger).mean())
    return 2.0 ** (float(slope.std(ddof=1)) / (math.sqrt(slope.size) * bend)) if bend > 0 else math.inf
