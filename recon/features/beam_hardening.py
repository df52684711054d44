"""Beam-hardening correction for a sample of one material: the corrected line integral is the thickness times the
attenuation of a thin layer.

A beam of several energies loses the low energies first, so line integrals grow more slowly than thickness. In the
volume, bodies are darker inside (cupping), and there are streaks between dense parts. For one material, the relation
between thickness and line integral is a curve, and the correction inverts it (Herman 1979, Phys. Med. Biol. 24, 81).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import F32, F64

_NODES = 2048
_FEWEST_RAYS, _MOST_RAYS = 100, 5000
# in a sample of one material, the thickness explains at least this share of the variance of line integrals
_LEAST_EXPLAINED = 0.9


class NoCurveError(ValueError):
    """No hardening curve can be determined from the line integrals. The message gives the reason."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve that gives the corrected line integral for each measured one.

    Attributes:
        measured: float64 [node], ascending from 0.
        corrected: float64 [node], ascending from 0. Below 0, the curve continues along its first segment; beyond its
            end, along its last segment.
    """

    measured: F64
    corrected: F64

    def __post_init__(self) -> None:
        rising = (np.diff(self.measured) > 0).all() and (np.diff(self.corrected) > 0).all()
        if self.measured.shape != self.corrected.shape or self.measured.size < 2 or not rising:
            raise ValueError(
                "a beam-hardening curve needs at least two nodes, with ascending measured and corrected values"
            )

    def linearise(self, views: F32, weights: F32 | None = None) -> None:
        """Replace line integrals of any shape, and their inverse variances, by corrected ones, in place."""
        slopes = np.diff(self.corrected) / np.diff(self.measured)
        for n, view in enumerate(views):
            piece = np.clip(np.searchsorted(self.measured, view) - 1, 0, slopes.size - 1)
            slope = slopes[piece]
            view[...] = self.corrected[piece] + slope * (view - self.measured[piece])
            if weights is not None:
                weights[n] /= slope**2


def curve_of_spectrum(attenuations: ArrayLike, weights: ArrayLike, highest: float) -> Curve:
    """The hardening curve of a material whose attenuation is `attenuations`, in any unit, at the energies of a beam.

    Args:
        weights: relative intensities detected at these energies (not normalised).
        highest: the curve reaches at least this measured line integral.
    """
    mu, w = np.asarray(attenuations, np.float64), np.asarray(weights, np.float64)
    mu = mu / (mu @ w / w.sum())
    corrected = np.linspace(0, 1, _NODES) ** 2 * max(highest, 0.1) / mu[w > 0].min()
    measured = mu[w > 0].min() * corrected - np.log(np.exp(-np.outer(corrected, mu - mu[w > 0].min())) @ (w / w.sum()))
    return Curve(measured, corrected)


def curve_of_paths(measured: ArrayLike, paths: ArrayLike, highest: float) -> tuple[Curve, float]:
    """The two-energy curve that fits best to line integrals as a function of the path lengths in the material.

    (Van de Casteele et al. 2002, Phys. Med. Biol. 47, 4181.) The curve always rises, with a falling slope.

    Args:
        measured: line integrals.
        paths: lengths of the rays inside the material, in any unit; 0 for rays that miss it, which must be air.
        highest: as in `curve_of_spectrum`.

    Returns:
        The curve, and the share of the line integrals' variance that it explains.

    Raises:
        NoCurveError: there are too few rays, or the sample has several materials.
    """
    p, length = np.ravel(np.asarray(measured, np.float64)), np.ravel(np.asarray(paths, np.float64))
    every_nth = slice(None, None, max(1, p.size // _MOST_RAYS))
    p, length = p[every_nth], length[every_nth]
    if (n_inside := np.count_nonzero(length)) < _FEWEST_RAYS:
        raise NoCurveError(
            f"too few rays go through the material: {n_inside} rays, but at least {_FEWEST_RAYS} are needed"
        )
    slope = float(p @ length / (length @ length))

    def curve_points(soft: float, hard: float, share: float) -> F64:
        return hard * length - np.log(share * np.exp(-(soft - hard) * length) + 1 - share)

    def residuals(x: F64) -> F64:
        return np.asarray(curve_points(x[0] + x[1], x[0], x[2]) - p)

    from scipy.optimize import least_squares  # loading takes half a second

    bounds = (1e-6 * slope, 0, 0.01), (np.inf, np.inf, 0.99)
    solution = least_squares(residuals, (0.8 * slope, 0.8 * slope, 0.4), bounds=bounds, x_scale=(slope, slope, 1.0))
    hard, excess, share = solution.x
    explained = 1 - float(np.mean(solution.fun**2) / p.var())
    if explained < _LEAST_EXPLAINED:
        raise NoCurveError(
            f"the sample seems to have several materials: its thickness explains only {max(explained, 0):.0%} of "
            "the variance of the line integrals, and the thickness of a sample of one material explains at least "
            f"{_LEAST_EXPLAINED:.0%}"
        )
    return curve_of_spectrum((hard + excess, hard), (share, 1 - share), highest), explained
