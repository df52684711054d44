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
_LEAST_MATERIAL = 0.2
_RIM = 0.05  # columns below this share of the densest column count as air
_LEAST_ROWS = 8  # fewer rows give no profile along the axis; each half of the rows must give a profile, too
_ROUNDING = 1e-6  # share of the total absorption of a band; slightly above the effect of float32 rounding on a moment


@dataclass(frozen=True, eq=False)
class ViewMoments:
    """Errors of a scan that moments show, each with its standard deviation. NaN: there are too few rows or projections.

    Attributes:
        axis_col: column of the rotation axis.
        col_shift: float64 [view], horizontal error of the projection in columns. The centre of mass of a rotating
            sample follows a sine curve; this is its distance from that curve.
        mass: float64 [view], total absorption divided by its median, minus 1.
        row_shift: float64 [view], vertical error of the projection in rows: how far the sample lies below its mean
            height in all projections.
        stretch: actual rotation divided by the stated one, minus 1.
    """

    axis_col: float
    col_shift: F64
    col_shift_sigma: float
    mass: F64
    row_shift: F64
    row_shift_sigma: float
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
    relative_mass = mass.sum(axis=1)
    middle = float(np.median(relative_mass))
    relative_mass = relative_mass / middle - 1 if middle > 0 else np.full_like(relative_mass, np.nan)
    axis, col_shift, col_shift_sigma = _centres(bands, turned)
    return ViewMoments(
        axis, col_shift, col_shift_sigma, relative_mass, *_row_shift(mass), *_stretch(bands, turned, axis_col)
    )


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
    return np.stack(mass), whole[:, of_bands > _LEAST_MATERIAL * of_bands.max()]


def _row_shift(mass: F64) -> tuple[F64, float]:
    """Rows by which the sample is lower in each projection than in the mean of all, and the standard deviation.

    The profile of total absorption along the axis moves with the sample. A weaker beam scales this profile and adds to
    it. Both halves of the rows must agree, because drift and beam hardening change the profile, too.
    """
    rows = mass.shape[1]
    row_shift, sigma = _row_shift_of(mass)
    above, below = (_row_shift_of(half)[0] for half in (mass[:, : rows // 2], mass[:, rows // 2 :]))
    return row_shift, float(np.hypot(sigma, np.sqrt(np.mean((above - below) ** 2)) / 2))


def _row_shift_of(mass: F64) -> tuple[F64, float]:
    """`_row_shift` from some rows; NaN if these rows do not determine it."""
    views, rows = mass.shape
    unknown = np.full(views, np.nan), np.nan
    if rows < _LEAST_ROWS:
        return unknown
    mean = mass.mean(axis=0)
    basis = np.column_stack([np.gradient(mean), mean, np.ones(rows)])
    if np.linalg.matrix_rank(basis) < basis.shape[1]:
        return unknown
    change = mass - mean
    coefficients = np.linalg.lstsq(basis, change.T, rcond=None)[0]
    variance = ((change - (basis @ coefficients).T) ** 2).sum(axis=1) / (rows - basis.shape[1])
    return -coefficients[0], float(np.sqrt(np.median(variance) * np.linalg.inv(basis.T @ basis)[0, 0]))


def _centres(bands: F64, angles: F64) -> tuple[float, F64, float]:
    """The column about which the centre of mass of each band follows a sine curve, and the deviations of all bands from
    their curves."""
    mass = bands.sum(axis=2)
    basis = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
    if len(angles) <= 3 or not bands.size or (mass <= 0).any() or np.linalg.matrix_rank(basis) < 3:
        return np.nan, np.full(len(angles), np.nan), np.nan
    centres = bands @ np.arange(bands.shape[2]) / mass
    coefficients = np.linalg.lstsq(basis, centres, rcond=None)[0]
    residual = centres - basis @ coefficients
    weight = mass.mean(axis=0) ** 2
    weight /= weight.sum()
    col_shift = residual @ weight
    variance = (residual - col_shift[:, None]) ** 2 @ weight**2
    return float(coefficients[0] @ weight), col_shift, float(np.sqrt(np.median(variance)))


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
    inner_bands, positions = bands[:, :, inside], across[inside] / (radius + 0.5)
    (stretch, sigma), (stretch_any_axis, sigma_any_axis) = (
        _fitted(inner_bands, positions, 1 / (radius + 0.5), angles, multiple_step) for multiple_step in (2, 1)
    )
    return stretch, max(sigma, sigma_any_axis, abs(stretch - stretch_any_axis))


def _fitted(bands: F64, positions: F64, column_step: float, angles: F64, multiple_step: int) -> tuple[float, float]:
    """The stretch of the angles from Chebyshev moments, and its standard deviation.

    Args:
        bands: [view, band, col], the columns with material.
        positions: [col], from -1 to 1; `column_step`: their step.
        multiple_step: 2: only multiples of the angle with the parity of the order; 1: all.
    """
    rounding = (_ROUNDING * np.abs(bands).sum(axis=2).mean(axis=0)) ** 2
    normal, right = np.zeros((rounding.size, 2, 2)), np.zeros((rounding.size, 2))
    for order in range(1, _ORDERS + 1):
        moment = bands @ _chebyshev(order, positions)
        axis_effect = 2 * (
            bands @ (_chebyshev(order, positions + column_step / 4) - _chebyshev(order, positions - column_step / 4))
        )
        multiples = np.arange(order % multiple_step, order + 1, multiple_step)[:, None]
        waves = np.exp(1j * multiples * angles)[multiples[:, 0] > 0]
        basis = np.concatenate([waves.real, waves.imag, np.ones((int(multiples[0, 0] == 0), angles.size))]).T
        coefficients = np.linalg.lstsq(basis, moment, rcond=None)[0]
        steps = multiples[multiples > 0][:, None]
        angle_effect = np.concatenate([-steps * waves.imag, steps * waves.real]).T @ coefficients[: 2 * steps.size]
        effects = np.stack([(angles - angles.mean())[:, None] * angle_effect, axis_effect])
        effects -= np.stack([basis @ np.linalg.lstsq(basis, effect, rcond=None)[0] for effect in effects])
        residual = moment - basis @ coefficients
        variance = np.maximum((residual**2).sum(axis=0) / (len(angles) - basis.shape[1]), rounding)
        normal += np.einsum("avb,cvb,b->bac", effects, effects, 1 / variance)
        right += np.einsum("avb,vb,b->ba", effects, residual, 1 / variance)
    total_normal, total_right = normal.sum(axis=0), right.sum(axis=0)
    if np.linalg.matrix_rank(total_normal) < 2:
        return np.nan, np.nan
    sigma = float(np.sqrt(np.linalg.inv(total_normal)[0, 0]))
    if (
        count := rounding.size
    ) > 2:  # the error is a jackknife over the bands, because bands disagree if the sample moves
        without = np.linalg.solve(total_normal - normal, (total_right - right)[..., None])[:, 0, 0]
        sigma = max(sigma, float(np.sqrt((count - 1) * without.var())))
    return float(np.linalg.solve(total_normal, total_right)[0]), sigma


def _chebyshev(order: int, positions: F64) -> F64:
    """Chebyshev polynomial of the second kind at positions from -1 to 1."""
    angle = np.arccos(positions)
    return np.sin((order + 1) * angle) / np.sin(angle)
