"""Moments of parallel projections: they show errors of the axis, heights and angles, for any sample."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64

_ORDERS = 4  # moments up to this order are used for the angles; higher ones follow edges, rings and noise
_BANDS = 16  # bands of rows whose moments are computed
# a row or column with less material than this share of the fullest one is not used, because its moments are mostly
# noise
_MATTER = 0.2
_RIM = 0.05  # columns below this share of the densest column count as air
_LEAST_ROWS = 8  # fewer rows give no profile along the axis; each half of the rows must give a profile, too
_ROUNDING = 1e-6  # share of the total absorption of a band; slightly above the effect of float32 rounding on a moment


@dataclass(frozen=True, eq=False)
class ViewMoments:
    """Errors of a scan that moments show, each with its standard deviation. NaN: there are too few rows or projections.

    Attributes:
        axis_col: column of the rotation axis.
        across: float64 [view], columns by which the centre of mass deviates from its sine curve about the axis.
        mass: float64 [view], total absorption divided by its median, minus 1.
        down: float64 [view], rows by which the sample is lower than in the mean projection.
        stretch: actual rotation divided by the stated one, minus 1.
    """

    axis_col: float
    across: F64
    across_sigma: float
    mass: F64
    down: F64
    down_sigma: float
    stretch: float
    stretch_sigma: float


def moments_of(views: Iterable[F32], angles: NDArray[np.floating], axis_col: float) -> ViewMoments:
    """The moments of line integrals of a sample within the field of view, in a parallel beam.

    The moment of order k of a row, over the columns, is a polynomial of degree k in the cosine and sine of the angle
    (Helgason 1965; Ludwig 1966, Comm. Pure Appl. Math. 19, 49). So the total absorption of a row is the same in all
    projections, and its centre of mass follows a sine curve about the axis. Moments up to order 4 show whether all
    angles are too large by a common factor: the effect of this factor is fitted to the residual of the polynomials.

    Args:
        views: projections, float32 [row, col] each, read one after the other.
        angles: [view] in radians.
        axis_col: column about which the moments for the angles are computed. It must be the right axis.
    """
    turned: F64 = np.asarray(angles, np.float64)
    mass, bands = _sums(views)
    of_views = mass.sum(axis=1)
    middle = float(np.median(of_views))
    of_views = of_views / middle - 1 if middle > 0 else np.full_like(of_views, np.nan)
    axis, across, across_sigma = _centres(bands, turned)
    return ViewMoments(axis, across, across_sigma, of_views, *_down(mass), *_stretch(bands, turned, axis_col))


def _sums(views: Iterable[F32]) -> tuple[F64, F64]:
    """Total absorption [view, row], and means [view, band, col] of bands of rows that contain material."""
    mass, bands = [], []
    for view in views:
        rows = len(view)
        starts = np.unique(np.linspace(0, rows, min(rows, _BANDS) + 1).astype(int))
        mass.append(view.sum(axis=1, dtype=np.float64))
        bands.append(np.add.reduceat(view, starts[:-1], axis=0, dtype=np.float64) / np.diff(starts)[:, None])
    whole = np.stack(bands)
    of_bands = whole.sum(axis=2).mean(axis=0)
    return np.stack(mass), whole[:, of_bands > _MATTER * of_bands.max()]


def _down(mass: F64) -> tuple[F64, float]:
    """Rows by which the sample is lower in each projection than in the mean of all, and the standard deviation.

    The profile of total absorption along the axis moves with the sample. A weaker beam scales this profile and adds to
    it. Both halves of the rows must agree, because drift and beam hardening change the profile, too.
    """
    rows = mass.shape[1]
    down, sigma = _moved(mass)
    above, below = (_moved(half)[0] for half in (mass[:, : rows // 2], mass[:, rows // 2 :]))
    return down, float(np.hypot(sigma, np.sqrt(np.mean((above - below) ** 2)) / 2))


def _moved(mass: F64) -> tuple[F64, float]:
    """`_down` from some rows; NaN if these rows do not determine it."""
    views, rows = mass.shape
    unknown = np.full(views, np.nan), np.nan
    if rows < _LEAST_ROWS:
        return unknown
    mean = mass.mean(axis=0)
    parts = np.column_stack([np.gradient(mean), mean, np.ones(rows)])
    if np.linalg.matrix_rank(parts) < parts.shape[1]:
        return unknown
    change = mass - mean
    shares = np.linalg.lstsq(parts, change.T, rcond=None)[0]
    variance = ((change - (parts @ shares).T) ** 2).sum(axis=1) / (rows - parts.shape[1])
    return -shares[0], float(np.sqrt(np.median(variance) * np.linalg.inv(parts.T @ parts)[0, 0]))


def _centres(bands: F64, angles: F64) -> tuple[float, F64, float]:
    """The column about which the centre of mass of each band follows a sine curve, and the deviations of all bands from
    their curves."""
    mass = bands.sum(axis=2)
    parts = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
    if len(angles) <= 3 or not bands.size or (mass <= 0).any() or np.linalg.matrix_rank(parts) < 3:
        return np.nan, np.full(len(angles), np.nan), np.nan
    centres = bands @ np.arange(bands.shape[2]) / mass
    shares = np.linalg.lstsq(parts, centres, rcond=None)[0]
    rest = centres - parts @ shares
    weight = mass.mean(axis=0) ** 2
    weight /= weight.sum()
    across = rest @ weight
    alone = (rest - across[:, None]) ** 2 @ weight**2
    return float(shares[0] @ weight), across, float(np.sqrt(np.median(alone)))


def _stretch(bands: F64, angles: F64, axis_col: float) -> tuple[float, float]:
    """Actual rotation divided by the stated rotation, minus 1, and the standard deviation of this value.

    A small error of the axis is fitted at the same time. This is not enough for a sample that is nearly a body of
    revolution, because the effects of pixels and of the axis on its moments look like an error of the angles. So a
    second fit uses all multiples of the angle up to the order, which are valid for any axis. The two fits must agree.
    """
    if len(angles) <= 2 * _ORDERS + 1 or not bands.size:
        return np.nan, np.nan
    across = np.arange(bands.shape[2]) - axis_col
    profile = np.abs(bands).mean(axis=(0, 1))
    radius = np.abs(across[profile > _RIM * profile.max()]).max() + 1.0
    inside = np.abs(across) <= radius
    seen, places = bands[:, :, inside], across[inside] / (radius + 0.5)
    (stretch, sigma), (other, other_sigma) = (
        _fitted(seen, places, 1 / (radius + 0.5), angles, every) for every in (2, 1)
    )
    return stretch, max(sigma, other_sigma, abs(stretch - other))


def _fitted(bands: F64, places: F64, column: float, angles: F64, every: int) -> tuple[float, float]:
    """The stretch of the angles from Chebyshev moments, and its standard deviation.

    Args:
        bands: [view, band, col], the columns with material.
        places: [col], positions from -1 to 1; `column`: their step.
        every: 2: only multiples of the angle with the parity of the order; 1: all.
    """
    rounding = (_ROUNDING * np.abs(bands).sum(axis=2).mean(axis=0)) ** 2
    normal, right = np.zeros((rounding.size, 2, 2)), np.zeros((rounding.size, 2))
    for order in range(1, _ORDERS + 1):
        moment = bands @ _chebyshev(order, places)
        of_column = 2 * (bands @ (_chebyshev(order, places + column / 4) - _chebyshev(order, places - column / 4)))
        multiples = np.arange(order % every, order + 1, every)[:, None]
        waves = np.exp(1j * multiples * angles)[multiples[:, 0] > 0]
        parts = np.concatenate([waves.real, waves.imag, np.ones((int(multiples[0, 0] == 0), angles.size))]).T
        shares = np.linalg.lstsq(parts, moment, rcond=None)[0]
        steps = multiples[multiples > 0][:, None]
        change = np.concatenate([-steps * waves.imag, steps * waves.real]).T @ shares[: 2 * steps.size]
        effects = np.stack([(angles - angles.mean())[:, None] * change, of_column])
        effects -= np.stack([parts @ np.linalg.lstsq(parts, effect, rcond=None)[0] for effect in effects])
        rest = moment - parts @ shares
        variance = np.maximum((rest**2).sum(axis=0) / (len(angles) - parts.shape[1]), rounding)
        normal += np.einsum("avb,cvb,b->bac", effects, effects, 1 / variance)
        right += np.einsum("avb,vb,b->ba", effects, rest, 1 / variance)
    total, of_all = normal.sum(axis=0), right.sum(axis=0)
    if np.linalg.matrix_rank(total) < 2:
        return np.nan, np.nan
    sigma = float(np.sqrt(np.linalg.inv(total)[0, 0]))
    if (
        count := rounding.size
    ) > 2:  # the error is a jackknife over the bands, because bands disagree if the sample moves
        without = np.linalg.solve(total - normal, (of_all - right)[..., None])[:, 0, 0]
        sigma = max(sigma, float(np.sqrt((count - 1) * without.var())))
    return float(np.linalg.solve(total, of_all)[0]), sigma


def _chebyshev(order: int, places: F64) -> F64:
    """Chebyshev polynomial of the second kind at positions from -1 to 1."""
    turn = np.arccos(places)
    return np.sin((order + 1) * turn) / np.sin(turn)
