"""Moments of parallel views: errors of their axis, heights and angles, whatever the sample is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64

_ORDERS = 4  # of moments that tell angles: those above follow edges, rings and noise
_BANDS = 16  # of rows, whose moments are taken
_MATTER = 0.2  # of the fullest row, or of the densest column: with less, moments are mostly noise
_RIM = 0.05  # of the densest column: below it there is air
_KNOTS, _VIEWS_A_KNOT, _LEAST_KNOTS, _ROUNDS = 12, 6, 4, 3  # of the errors of angles along a scan
_LEAST_ROWS = 8  # fewer have no profile along the axis; each half of the rows has one, too
_ROUNDING = 1e-6  # of a band's mass: what float32 line integrals do to a moment, and a little more
_UPSIDE_DOWN = 16.0  # squared distance to the first view's profile over that to the same profile turned over


@dataclass(frozen=True, eq=False)
class ViewMoments:
    """Errors that the moments of views show, with standard deviations; NaN where rows or views are too few.

    Attributes:
        axis_col: the rotation axis, in columns.
        across: float64 [view], by how many columns the centre of mass leaves its way about the axis.
        mass: float64 [view], over its median, less 1.
        down: float64 [view], by how many rows the matter is lower than in the mean view.
        flipped: bool [view], views whose rows are those of the first view from the last to the first.
        stretch: the angle by which the views turned, over the one stated, less 1.
        turned: float64 [view], rad by which each view is turned beside its angle, less the mean; 0 where few tell.
        turned_left: the variance that moments have beside the laws at these angles, over that at those stated.
    """

    axis_col: float
    axis_sigma: float
    across: F64
    across_sigma: float
    mass: F64
    down: F64
    down_sigma: float
    flipped: NDArray[np.bool_]
    stretch: float
    stretch_sigma: float
    turned: F64
    turned_sigma: float
    turned_left: float


def moments_of(views: Iterable[F32], angles: NDArray[np.floating], axis_col: float) -> ViewMoments:
    """The moments of line integrals of a sample within the field, in a parallel beam.

    The moment of order k of a row, over the columns, is a polynomial of degree k in the cosine and sine of the angle
    (Helgason 1965; Ludwig 1966, Comm. Pure Appl. Math. 19, 49). So each row has one mass in all views, and its centre
    goes along a sinusoid about the axis. Orders up to 4 tell whether all angles are too large by one factor: its
    effect on the polynomials is fitted to what they leave.

    Args:
        views: float32 [row, col] each, which are taken one after the other.
        angles: [view] in radians.
        axis_col: about which moments are taken that tell angles; a wrong one spoils these.
    """
    turned: F64 = np.asarray(angles, np.float64)
    mass, bands = _sums(views)
    down, down_sigma = _down(mass)
    axis, axis_sigma, across, across_sigma = _centres(bands, turned)
    stretch, stretch_sigma = _stretch(bands, turned, axis_col)
    of_views = mass.sum(axis=1)
    middle = float(np.median(of_views))
    of_views = of_views / middle - 1 if middle > 0 else np.full_like(of_views, np.nan)
    return ViewMoments(
        axis, axis_sigma, across, across_sigma, of_views, down, down_sigma, _upside_down(mass), stretch, stretch_sigma,
        *_turned(bands, turned, axis_col),
    )  # fmt: skip


def _sums(views: Iterable[F32]) -> tuple[F64, F64]:
    """Mass [view, row], and means [view, band, col] of bands of rows that hold matter."""
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
    """Rows by which each view stands lower than the mean of all, and their standard deviation.

    The profile of masses along the axis moves with the sample; a weaker beam scales it, and adds to it. Both halves of
    the rows must agree: what drifts or hardens changes a profile, too.
    """
    rows = mass.shape[1]
    down, sigma = _moved(mass)
    above, below = (_moved(half)[0] for half in (mass[:, : rows // 2], mass[:, rows // 2 :]))
    return down, float(np.hypot(sigma, np.sqrt(np.mean((above - below) ** 2)) / 2))


def _moved(mass: F64) -> tuple[F64, float]:
    """`_down` by some rows; NaN where they do not determine it."""
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


def _upside_down(mass: F64) -> NDArray[np.bool_]:
    if mass.shape[1] < _LEAST_ROWS:
        return np.zeros(len(mass), np.bool_)
    upright, turned = (((profile - mass[0]) ** 2).sum(axis=1) for profile in (mass, mass[:, ::-1]))
    usual = float(np.median(np.minimum(upright, turned)))
    return np.asarray(upright > _UPSIDE_DOWN * np.maximum(turned, usual), np.bool_)


def _centres(bands: F64, angles: F64) -> tuple[float, float, F64, float]:
    """The column about which the centre of each band goes along a sinusoid, and by how much all of them leave it."""
    mass, unknown = bands.sum(axis=2), np.full(len(angles), np.nan)
    parts = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
    if len(angles) <= 3 or not bands.size or (mass <= 0).any() or np.linalg.matrix_rank(parts) < 3:
        return np.nan, np.nan, unknown, np.nan
    centres = bands @ np.arange(bands.shape[2]) / mass
    shares = np.linalg.lstsq(parts, centres, rcond=None)[0]
    rest = centres - parts @ shares
    weight = mass.mean(axis=0) ** 2
    weight /= weight.sum()
    variance = float(((rest**2).sum(axis=0) / (len(angles) - 3)) @ weight)
    across = rest @ weight
    alone = (rest - across[:, None]) ** 2 @ weight**2
    axis_sigma = float(np.sqrt(variance * np.linalg.inv(parts.T @ parts)[0, 0]))
    return float(shares[0] @ weight), axis_sigma, across, float(np.sqrt(np.median(alone)))


@dataclass(frozen=True, eq=False)
class _Orders:
    """Moments of orders 1 to 4 of bands of rows, by Chebyshev's polynomials about an axis.

    Attributes:
        moments: [view, band] of each order.
        of_axis: their change for a column of the axis, likewise.
        rounding: [band], least variance.
    """

    moments: list[F64]
    of_axis: list[F64]
    rounding: F64

    @classmethod
    def of(cls, bands: F64, axis_col: float) -> _Orders:
        across = np.arange(bands.shape[2]) - axis_col
        profile = np.abs(bands).mean(axis=(0, 1))
        radius = np.abs(across[profile > _RIM * profile.max()]).max() + 1.0
        inside = np.abs(across) <= radius
        seen, places, quarter = bands[:, :, inside], across[inside] / (radius + 0.5), 0.25 / (radius + 0.5)
        moments, of_axis = [], []
        for order in range(1, _ORDERS + 1):
            moments.append(seen @ _chebyshev(order, places))
            of_axis.append(2 * (seen @ (_chebyshev(order, places + quarter) - _chebyshev(order, places - quarter))))
        return cls(moments, of_axis, (_ROUNDING * np.abs(seen).sum(axis=2).mean(axis=0)) ** 2)

    def errors(self, angles: F64, basis: F64, every: int, alike: bool = False) -> tuple[F64, F64, float]:
        """Errors of the angles as shares of a basis [view, share], their standard deviations, and the variance that the
        moments have beside the polynomials of these angles, as a sum over orders and bands of shares of their own.

        Args:
            every: 2 for the multiples of the angle of the order's parity, 1 for all.
            alike: how much orders disagree is uncertainty, too, and bands that err alike, as by their air, count less.
        """
        n, bands = basis.shape[1] + 1, self.rounding.size
        normal, right, variances = np.zeros((_ORDERS, bands, n, n)), np.zeros((_ORDERS, bands, n)), 0.0
        shared = 0.0
        for order, (moment, of_column) in enumerate(zip(self.moments, self.of_axis, strict=True), 1):
            multiples = np.arange(order % every, order + 1, every)[:, None]
            cosines, sines = np.cos(multiples * angles), np.sin(multiples * angles)
            turning = multiples[:, 0] > 0
            parts = np.concatenate([cosines, sines[turning]]).T
            change = np.concatenate([-multiples * sines, (multiples * cosines)[turning]]).T
            shares = np.linalg.lstsq(parts, moment, rcond=None)[0]
            effects = np.concatenate([basis.T[:, :, None] * (change @ shares), of_column[None]])
            effects -= np.stack([parts @ np.linalg.lstsq(parts, each, rcond=None)[0] for each in effects])
            rest = moment - parts @ shares
            variance = np.maximum((rest**2).sum(axis=0) / (len(angles) - parts.shape[1]), self.rounding)
            normal[order - 1] = np.einsum("avb,cvb,b->bac", effects, effects, 1 / variance)
            right[order - 1] = np.einsum("avb,vb,b->ba", effects, rest, 1 / variance)
            shared += bands * float(((rest / np.sqrt(variance)).mean(axis=1) ** 2).mean()) / _ORDERS
            variances += float(variance.sum() / max(float((moment**2).mean(axis=0).sum()), 1e-30))
        total, of_all = normal.sum(axis=(0, 1)), right.sum(axis=(0, 1))
        if np.linalg.matrix_rank(total) < n:
            return np.full(n - 1, np.nan), np.full(n - 1, np.nan), variances
        found, sigma = np.linalg.solve(total, of_all)[:-1], np.sqrt(np.diag(np.linalg.inv(total))[:-1])
        for axis, count in ((0, bands), (1, len(normal) if alike else 0)):
            if count > 2:  # without each in turn: bands disagree where the sample moves, orders where it hardens
                without = np.linalg.solve(total - normal.sum(axis), (of_all - right.sum(axis))[..., None])[:, :-1, 0]
                sigma = np.maximum(sigma, np.sqrt((count - 1) * without.var(axis=0)))
        return found, sigma * np.sqrt(max(shared, 1.0)) if alike else sigma, variances


def _stretch(bands: F64, angles: F64, axis_col: float) -> tuple[float, float]:
    """Relative excess of the turn over the stated one, and its standard deviation.

    A small error of the axis is fitted beside it. Of what is nearly a body of revolution that does not suffice: what
    pixels and the axis do to its moments looks like an error of the angles. So a second fit has all multiples of the
    angle up to the order, which hold whatever the axis is, and the two have to agree.
    """
    if len(angles) <= 2 * _ORDERS + 1 or not bands.size:
        return np.nan, np.nan
    orders, basis = _Orders.of(bands, axis_col), (angles - angles.mean())[:, None]
    (stretch,), (sigma,), _ = orders.errors(angles, basis, 2)
    (other,), (other_sigma,), _ = orders.errors(angles, basis, 1)
    return float(stretch), float(max(sigma, other_sigma, abs(stretch - other)))


def _turned(bands: F64, angles: F64, axis_col: float) -> tuple[F64, float, float]:
    """By how much each view is turned beside its angle, the standard deviation, and the variance that the moments have
    at these angles, over that at those stated.

    The errors are a line from knot to knot of the scan. All views turned alike are the same sample.
    """
    knots, n = min(_KNOTS, len(angles) // _VIEWS_A_KNOT), len(angles)
    turned = np.zeros(n)
    if knots < _LEAST_KNOTS or not bands.size:
        return turned, np.nan, 1.0
    orders = _Orders.of(bands, axis_col)
    at = np.linspace(0, n - 1, knots)
    basis = np.stack([np.interp(np.arange(n), at, knot) for knot in np.eye(knots)[1:]], axis=1)
    basis -= basis.mean(axis=0)
    sigma, before = np.full(knots - 1, np.nan), np.nan
    for _ in range(_ROUNDS):
        found, sigma, variances = orders.errors(angles + turned, basis, 2, alike=True)
        before = variances if np.isnan(before) else before
        if not np.isfinite(found).all():
            return np.zeros(n), np.nan, 1.0
        turned = turned + basis @ found
    after = orders.errors(angles + turned, basis, 2)[2]
    return turned, float(np.median(sigma)), after / before


def _chebyshev(order: int, places: F64) -> F64:
    """Chebyshev's polynomial of the second kind at places between -1 and 1."""
    turn = np.arccos(places)
    return np.sin((order + 1) * turn) / np.sin(turn)
