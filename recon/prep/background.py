"""Background of the beam: the smooth surface that each projection shows in air (rays that miss the sample).

The open beam may change its shape, move or fade between the flats and the projections. The line integrals then contain
a smooth surface in addition to the sample. A volume without negative densities cannot represent the negative part of
this surface, and loses weakly absorbing material instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter

from recon.base.arrays import F32, F64, Mask, median_deviation
from recon.base.noise import air_level

HIGHEST = 3  # highest order of the polynomials in column and row

LEAST_SIZE = 0.005  # root mean square of the surfaces, in line integrals, above which they are subtracted by default

_SMOOTH = 1.5  # voxels; smoothing raises weakly absorbing material above the noise
# limit for material in standard deviations of the smoothed air; number of voxels around material that also count as
# material
_SIGMAS, _MARGIN = 5.0, 4
_CLIPPED = 4.0  # limit in standard deviations
_BLOCK = 8  # pixels per side of a block; every second block of air is predicted from the other blocks
# smallest share of rays in air that a projection needs; smallest share of such projections
_LEAST_AIR, _LEAST_VIEWS = 0.03, 0.9
_WINDOWS = (45, 15, 5, 1)  # numbers of projections that share a surface
# a smaller window, or a higher order, is used only if it lowers the mean square to this share
_BETTER_WINDOW, _BETTER_ORDER = 0.95, 0.75
_BETTER = 0.99  # a surface is used only if it lowers the mean square to this share
_MOST_RESIDUAL = 2.0  # multiple of the noise; if the residual is larger, the rays do not show air
# largest variance of a surface, divided by that of a constant; a larger variance means that the surface extrapolates
_MOST_EXTRAPOLATION = 1000.0
_ROWS_A_POWER = 4


@dataclass(frozen=True, eq=False)
class Background:
    """The background of the beam: a polynomial in column and row for each projection.

    Attributes:
        coefficients: float64 [view, term], in the order of `powers`.
        size: root mean square of the surfaces.
        lowest, highest: lowest and highest value of the mean surface.
        before, after: root mean square of binned line integrals in air before and after the correction, in blocks that
            were not used for the fit.
        air: share of the rays that miss the sample.
        level: mean line integral of these rays before the correction.
    """

    order: int
    coefficients: F64
    shape: tuple[int, int]
    size: float
    lowest: float
    highest: float
    before: float
    after: float
    air: float
    level: float

    def confirmed(self, noise: float) -> bool:
        """Whether the correction should be applied: the surface is significant, and the residual in air that was not
        used for the fit is little more than noise."""
        improves = self.after**2 < _BETTER * self.before**2
        return self.size >= LEAST_SIZE and improves and self.after < _MOST_RESIDUAL * noise + LEAST_SIZE

    def remove(self, views: F32, factor: int = 1) -> None:
        """Subtract the surfaces in place from projections [view, row, col] whose pixels are binned by `factor`."""
        for view, terms in zip(views, self.coefficients, strict=True):
            view -= surface(terms, self.shape, factor)


def surface(terms: F64, shape: tuple[int, int], factor: int = 1) -> F32:
    """A polynomial [row, col] on a detector of this shape, binned by `factor`. Its terms [term] are in the order of
    `powers`."""
    v, u = (coordinate(n, factor) for n in shape)
    across = np.zeros((HIGHEST + 1, u.size))  # for each power of the row
    for c, (i, j) in zip(terms, powers(HIGHEST), strict=True):
        across[j] += c * u**i
    return (np.vander(v, HIGHEST + 1, increasing=True) @ across).astype(np.float32)


def coordinate(n: int, factor: int = 1) -> F64:
    """Coordinates of the bin centres, from -1 to 1 across n pixels."""
    return (2 * np.arange(n // factor) * factor + factor - n) / n


def powers(order: int) -> list[tuple[int, int]]:
    """(power of the column, power of the row) of each term, lowest order first."""
    return [(total - j, j) for total in range(order + 1) for j in range(total + 1)]


def near_material(volume: F32, inside: Mask) -> Mask:
    """Voxels near material, bool [z, y, x]. A voxel is material if its smoothed value exceeds the air level by five
    standard deviations.

    Args:
        inside: bool [y, x], voxels in the circle that all projections see, without the rim of the circle.
    """
    smooth = gaussian_filter(volume, [min(_SMOOTH, n / 8) for n in volume.shape], mode="nearest")
    level, noise = air_level(smooth[:, inside])
    return np.asarray(binary_dilation((smooth - level > _SIGMAS * noise) & inside, iterations=_MARGIN))


class AirSums:
    """Sums over rays in air, from which polynomials of any order can be fitted."""

    def __init__(self, shape: tuple[int, int], factor: int) -> None:
        """Start the sums for projections of a detector (rows, cols), binned by `factor`."""
        rows, cols = shape[0] // factor, shape[1] // factor
        v, u = coordinate(shape[0], factor), coordinate(shape[1], factor)
        second_half = (np.arange(rows)[:, None] // _BLOCK + np.arange(cols) // _BLOCK) % 2
        self._shape, self._half = shape, second_half.astype(bool)
        self._terms = np.stack([np.outer(v**j, u**i) for i, j in powers(HIGHEST)], -1)
        self._squares: list[list[F64]] = []  # [view][half] of [term, term]
        self._products: list[list[F64]] = []  # [view][half] of [term]
        self._totals: list[list[tuple[float, float, float]]] = []  # [view][half]: rays, sum and sum of squares

    def add(self, view: F32, air: Mask) -> None:
        """Add a binned projection [row, col], with a mask of its rays that miss the sample."""
        air = self._without_outliers(view, air)
        parts = []
        for half in (self._half, ~self._half):
            terms, values = self._terms[air & half], view[air & half].astype(np.float64)
            parts.append(
                (terms.T @ terms, terms.T @ values, (float(values.size), float(values.sum()), float(values @ values)))
            )
        squares, products, totals = zip(*parts, strict=True)
        self._squares.append([*squares])
        self._products.append([*products])
        self._totals.append([*totals])

    def fit(self, order: int | None = None) -> Background | None:
        """The surfaces that best predict those blocks of air that were not used for the fit; None if there is too
        little air.

        Neighbouring projections share a surface as long as the shared surface predicts equally well. A higher order is
        used only if it predicts better.

        Args:
            order: order of the polynomials; None: up to 3, as long as the order predicts better and extrapolates
                little.
        """
        squares, products, totals = (np.array(x) for x in (self._squares, self._products, self._totals))
        rays, n_views = totals[..., 0], len(totals)
        share = rays.sum(axis=1) / self._half.size
        if (share >= _LEAST_AIR).mean() < _LEAST_VIEWS:
            return None
        count = rays.sum()
        before = totals[..., 2].sum() / count
        best: tuple[float, int, F64] | None = None
        for candidate_order in range(HIGHEST + 1) if order is None else (order,):
            term_indices = [
                k
                for k, (i, j) in enumerate(powers(HIGHEST))
                if i + j <= candidate_order and j * _ROWS_A_POWER <= len(self._half)
            ]
            g, b = squares[..., term_indices, :][..., term_indices], products[..., term_indices]
            if order is None and self._extrapolation(g.sum(axis=1), term_indices) > _MOST_EXTRAPOLATION:
                break
            for width in (w for w in _WINDOWS if w <= max(n_views, 1)):
                wide_g, wide_b = _sums_around(g, width), _sums_around(b, width)
                c = _least_squares(
                    wide_g[:, ::-1], wide_b[:, ::-1]
                )  # errors of each half, from the surface of the other half
                residual = np.einsum("...i,...ij,...j", c, g, c) - 2 * np.einsum("...i,...i", c, b) + totals[..., 2]
                error = float(residual.sum() / count)
                if best is None or error < best[0] * (_BETTER_WINDOW if candidate_order == best[1] else _BETTER_ORDER):
                    coefficients = np.zeros((n_views, len(powers(HIGHEST))))
                    coefficients[:, term_indices] = _least_squares(wide_g.sum(axis=1), wide_b.sum(axis=1))
                    best = error, candidate_order, coefficients
        if best is None:
            return None
        error, candidate_order, coefficients = best
        terms = self._terms.reshape(-1, self._terms.shape[-1])
        squares = np.einsum("vi,ij,vj", coefficients, terms.T @ terms, coefficients, optimize=True)
        size, mean = float(np.sqrt(squares / (len(terms) * n_views))), terms @ coefficients.mean(axis=0)
        return Background(
            order=candidate_order, coefficients=coefficients, shape=self._shape, size=size, lowest=float(mean.min()),
            highest=float(mean.max()), before=float(before) ** 0.5, after=max(error, 0.0) ** 0.5,
            air=float(share.mean()), level=float(totals[..., 1].sum() / count),
        )  # fmt: skip

    def _extrapolation(self, squares: F64, term_indices: list[int]) -> float:
        """Largest variance of a surface with these terms in a typical projection, divided by the variance of a
        constant."""
        g = np.median(squares, axis=0)
        terms = self._terms.reshape(-1, self._terms.shape[-1])[:, term_indices]
        return float(np.einsum("ri,ij,rj->r", terms, np.linalg.pinv(g, hermitian=True), terms).max() * g[0, 0])

    def _without_outliers(self, view: F32, air: Mask) -> Mask:
        """The air mask without rays that deviate from a surface of second order."""
        terms, values = self._terms[air][:, :6], view[air].astype(np.float64)
        if values.size < 2 * terms.shape[1]:
            return air
        residual = view - self._terms[..., :6] @ _least_squares(terms.T @ terms, terms.T @ values)
        spread = median_deviation(residual[air])
        return np.asarray(air & (np.abs(residual) <= _CLIPPED * max(spread, 1e-12)))


def _sums_around(values: F64, width: int) -> F64:
    """Sums over the `width` projections around each projection [view, ...]. At both ends, the sums are over the first,
    or the last, `width` projections."""
    total = np.concatenate((np.zeros_like(values[:1]), np.cumsum(values, axis=0)))
    first = np.clip(np.arange(len(values)) - width // 2, 0, len(values) - width)
    return np.asarray(total[first + width] - total[first])


def _least_squares(squares: F64, products: F64) -> F64:
    """Least-squares solution [..., term]. Terms that no ray determines are 0."""
    return np.asarray(np.einsum("...ij,...j", np.linalg.pinv(squares, hermitian=True), products))
