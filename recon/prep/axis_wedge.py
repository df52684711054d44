"""axis_from_sinogram: the rotation axis from all projections, and the search over candidates for all methods."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Floats = NDArray[np.float64]

MOST_ROWS = 16  # this many rows are enough for an accuracy of 0.1 px
FEWEST_COLS = 8  # fewest columns from which an axis can be found
FEWEST_BANDS = 4  # fewest bands of rows from which its tilt can be found
AGREE = 1.0  # two independent estimates that differ by no more than this (px) count as the same axis


class AxisError(ValueError):
    """There is no estimate of the axis, because the best one is at the edge of the candidates or outside them."""


@dataclass(frozen=True, eq=False)
class AxisEstimate:
    """Estimate of the rotation axis.

    Attributes:
        value: axis_col in pixels, counted from 0 at the centre of the first column.
        candidates: float64 [n], the columns tested.
        curve: float64 [n], mismatch at each candidate: 0 means perfect agreement, about 1 means no agreement.
        confident: False if the minimum of the curve is shallow, or if parts of the data give different axes.
        method: "pair", "opposite views", "double wedge", "centre of mass", "ends of half a turn", "views held out".
    """

    value: float
    candidates: Floats
    curve: Floats
    confident: bool
    method: str

    def __str__(self) -> str:
        sure = "confident" if self.confident else "not confident"
        return f"column {self.value:.2f} by {self.method}, {sure} ({len(self.candidates)} candidates)"


def few_rows(data: NDArray[np.floating]) -> Floats:
    """At most 16 rows, each the mean of up to 4 rows to reduce noise (a sum of slices is again a slice)."""
    rows = data.shape[1]
    if rows <= MOST_ROWS:
        return np.asarray(data, np.float64)
    group = min(4, rows // MOST_ROWS)
    chosen = np.linspace(0, rows - 1, MOST_ROWS * group).astype(int)
    return data[:, chosen].reshape(len(data), MOST_ROWS, group, -1).mean(axis=2, dtype=np.float64)


def lowest(candidates: Floats, curve: Floats) -> tuple[float, int]:
    """Position of the minimum of a curve (by a parabola through three points), and the index of the lowest point."""
    i = int(curve.argmin())
    if not 0 < i < curve.size - 1:
        return float(candidates[i]), i
    below, here, above = curve[i - 1 : i + 2]
    curvature = below - 2 * here + above
    shift = 0.5 * (below - above) / curvature if curvature > 0 else 0.0
    return float(candidates[i] + shift * (candidates[1] - candidates[0])), i


def axis_error(value: float, candidates: Floats, place: str) -> AxisError:
    return AxisError(
        f"found no rotation axis in columns {candidates[0]:g} to {candidates[-1]:g}: the best column is {value:.2f}, "
        f"{place}. State the axis"
    )


def optimum(candidates: Floats, curve: Floats) -> tuple[float, float]:
    """The minimum of a curve, and its depth: from 0 (no better than a typical candidate) to 1 (perfect agreement).

    Raises:
        AxisError: the minimum lies at an end of the curve.
    """
    value, i = lowest(candidates, curve)
    if i in (0, candidates.size - 1):
        raise axis_error(value, candidates, "at the edge of the search range")
    typical = float(np.median(curve))
    return value, (typical - float(curve[i])) / typical if typical > 0 else 0.0


_MOST_VIEWS, _MOST_COLS = 256, 1024  # enough for an accuracy of 0.1 px
_STEP = 0.25  # px between candidates
# smallest number of projections. With 5 projections of samples wider than the field, 45 of 46 confident axes were
# wrong; of other samples, some
_FEWEST = 12
_ROUNDING = 1e-10  # share of a vector's length
_WIDEST_GAP = np.deg2rad(20)  # radians; if the 180° have a wider gap, the double wedge does not determine the axis


def axis_from_sinogram(sinogram: NDArray[np.floating], angles: Floats) -> AxisEstimate:
    """The rotation axis from all projections together. No opposite pair is needed, so the method is suitable for
    uneven, sparse and noisy scans, for sectors and for 360° scans.

    For scans of about 180° or more, the function uses the double wedge: if a sample has the radius r, the Fourier
    transform of a sinogram along the columns has, at the frequency ω, only angular harmonics |n| <= ω r (Edholm, Lewitt
    & Lindholm 1986; used for the axis by Vo et al. 2014, Opt. Express 22, 19078). If the columns are counted from the
    right axis, the projection at θ + π is the mirrored projection at θ. So the real part has only even harmonics, and
    the imaginary part only odd ones. The curve is the residual of a least-squares fit of these harmonics to the
    projections. Angles may have any spacing. The residual is a sum of cosines of the axis, so nothing is interpolated.

    If the scan covers less than 180°, or if the estimate of the double wedge is not confident, the function uses the
    centre of mass: axis + a cos θ + b sin θ is fitted to the centres of mass of the projections (the first of the
    Helgason-Ludwig conditions).

    Args:
        sinogram: float32 [view, col] or [view, row, col], line integrals; a few rows are enough.
        angles: [view], radians, any order and range.

    Raises:
        ValueError: shapes do not match, there are fewer than 4 projections, or values are not finite.
        AxisError: the best axis is at the edge of the detector or outside it.
    """
    theta = np.asarray(angles, np.float64)
    if sinogram.ndim not in (2, 3) or theta.shape != sinogram.shape[:1]:
        raise ValueError(
            "the sinogram must be [view, col] or [view, row, col] with one angle for each projection, got shapes "
            f"{sinogram.shape} and {theta.shape}"
        )
    data = few_rows(sinogram[:, None] if sinogram.ndim == 2 else sinogram)
    if len(theta) < 4 or data.shape[2] < FEWEST_COLS:
        raise ValueError(
            f"too few data to find an axis: {len(theta)} projections of {data.shape[2]} columns; at least 4 "
            f"projections of {FEWEST_COLS} columns are needed"
        )
    if not (np.isfinite(data).all() and np.isfinite(theta).all()):
        raise ValueError("sinogram or angles contain NaN or infinite values; correct them first")
    if not _covers_half_a_turn(theta):
        return _axis_from_mass(data, theta)
    wedge = _axis_from_wedge(data, theta)
    if wedge.confident:
        return wedge
    with suppress(AxisError):
        mass = _axis_from_mass(data, theta)
        return mass if mass.confident and abs(mass.value - wedge.value) < AGREE else wedge
    return wedge


def _axis_from_mass(data: Floats, theta: Floats) -> AxisEstimate:
    cols = data.shape[2]
    order = np.argsort(theta)
    theta, profile = theta[order], data[order].mean(axis=1)
    mass = profile.sum(axis=1)
    if not (mass > 0).all():
        raise AxisError(
            "cannot find the axis, because some projections have no absorption at all; check the dark and flat "
            "correction"
        )
    basis = np.stack([np.ones_like(theta), np.cos(theta), np.sin(theta)], axis=1)
    centre = profile @ np.arange(cols) / mass
    covariance = np.linalg.pinv(basis.T @ basis)
    solution = covariance @ (basis.T @ centre)
    residual = centre - basis @ solution
    value, residual_squares = float(solution[0]), float(residual @ residual)
    # An error of the axis adds this much per px² to the sum of squares; the curve is in units of a quarter of the
    # field.
    rise = 1 / covariance[0, 0]
    candidates = np.arange(0, cols - 1 + _STEP / 2, _STEP)
    curve = (residual_squares + rise * (candidates - value) ** 2) / (rise * (cols / 4) ** 2)
    if not candidates[0] < value < candidates[-1]:
        raise axis_error(value, candidates, "outside them")
    # Residuals of neighbouring projections are correlated. An air level that is not zero shifts the estimate without
    # adding scatter.
    correlation = float(np.clip(residual[1:] @ residual[:-1] / max(residual_squares, 1e-30), 0, 0.99))
    error = np.sqrt(residual_squares / max(len(theta) - 3, 1) / rise * (1 + correlation) / (1 - correlation))
    edge = max(2, cols // 40)
    left, right = float(profile[:, :edge].mean()), float(profile[:, -edge:].mean())
    bias = abs(left - right) / 2 * cols**2 / 6 + abs(left + right) / 2 * cols * abs(value - (cols - 1) / 2)
    sample_inside = max(abs(left), abs(right)) < 0.05 * profile.max() and mass.std() < 0.03 * mass.mean()
    confident = sample_inside and 2 * error + bias / mass.mean() < AGREE
    return AxisEstimate(value, candidates, curve, bool(confident), "centre of mass")


def wedge_curves(data: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """Candidates [n] for the axis, and the double-wedge mismatch [row, n] of each row of [view, row, col].

    Raises:
        ValueError: the projections leave a gap in the 180°.
    """
    if not _covers_half_a_turn(theta):
        raise ValueError("the projections are not evenly spread over 180°")
    wedge = _Wedge.of(data, theta)
    return wedge.columns, np.stack([wedge.curve(fit, wedge.power) for fit in np.moveaxis(wedge.fits, 1, 0)])


def _covers_half_a_turn(theta: Floats) -> bool:
    half_turn = np.sort(np.mod(theta, np.pi))
    gap = np.diff(half_turn, append=half_turn[0] + np.pi).max()
    return bool(gap <= max(_WIDEST_GAP, 4 * np.pi / len(theta)))


def is_cut_off(lines: NDArray[np.floating]) -> bool:
    """Whether the sample is truncated: the first or last columns of line integrals [view, row, col] are not air."""
    rim = np.abs(lines[:, :, [0, 1, -2, -1]].mean(axis=(0, 1))).max()
    return bool(rim > 0.05 * lines.mean(axis=(0, 1)).max())


@dataclass(frozen=True, eq=False)
class _Wedge:
    """Residuals of the fit of harmonics to some projections.

    Attributes:
        columns: [n], candidates for the axis.
        bin: number of columns that were averaged.
        basis: [3, n, frequency], 1, cosine and sine of a candidate.
        omega: [frequency]. fits: [3, row, frequency], coefficients, see `_wedge_residuals`.
        power: exponent of the frequency in the weight of a frequency; low frequencies are less reliable if the sample
            is wider than the field of view.
    """

    columns: Floats
    bin: int
    basis: Floats
    omega: Floats
    fits: Floats
    power: int

    @classmethod
    def of(cls, data: Floats, theta: Floats) -> _Wedge:
        """The residuals, computed from only as many projections and columns as are necessary."""
        chosen_views = np.argsort(np.mod(theta, np.pi), kind="stable")[:: -(-len(theta) // _MOST_VIEWS)]
        bin_ = -(-data.shape[2] // _MOST_COLS)
        cols = data.shape[2] // bin_
        binned = data[chosen_views, :, : cols * bin_].reshape(len(chosen_views), -1, cols, bin_).mean(axis=3)
        omega, fits = _wedge_residuals(binned, theta[chosen_views])
        candidates = np.arange(0, cols - 1 + _STEP / 2, _STEP)
        phase = 2 * np.outer(candidates, omega)
        basis = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)])
        return cls(candidates * bin_ + (bin_ - 1) / 2, bin_, basis, omega, fits, 2 if is_cut_off(binned) else 1)

    def curve(self, fit: Floats, power: int) -> Floats:
        """Mismatch [n] from coefficients [3, frequency]."""
        weighted = fit * self.omega**power
        return np.einsum("knw,kw->n", self.basis, weighted) / max(float(weighted[0].sum()), 1e-30)


def _axis_from_wedge(data: Floats, theta: Floats) -> AxisEstimate:
    wedge = _Wedge.of(data, theta)
    # With one harmonic more, and with one less, the axis must be the same.
    fewer, curve, more = (wedge.curve(wedge.fits.sum(axis=1), wedge.power + change) for change in (-1, 0, 1))
    value, depth = optimum(wedge.columns, curve)
    disagreement = abs(lowest(wedge.columns, fewer)[0] - lowest(wedge.columns, more)[0])
    confident = len(theta) >= _FEWEST and depth > 0.5 and disagreement < AGREE * wedge.bin
    return AxisEstimate(value, wedge.columns, curve, confident, "double wedge")


def _orthonormal(vectors: Floats) -> tuple[Floats, Floats]:
    """Orthonormal vectors [i, k], and how much each given vector adds. The first m vectors span the first m given
    vectors.

    There are at most as many vectors as components. A given vector that adds nothing becomes zeros. The method is
    Gram-Schmidt, applied twice because of rounding errors (Giraud et al. 2005). LAPACK is not used, because its threads
    would take 20 times as long while other programs use the cores.
    """
    q = vectors[: vectors.shape[1]].copy()
    lengths = np.zeros(len(q))
    for i, vector in enumerate(q):
        given_length = math.sqrt(float(np.einsum("k,k->", vector, vector)))
        for second_pass in (False, True):
            vector -= np.einsum("j,jk->k", np.einsum("jk,k->j", q[:i], vector), q[:i])
            length = math.sqrt(float(np.einsum("k,k->", vector, vector)))
            if not second_pass:
                lengths[i] = length
            if length <= _ROUNDING * given_length:
                vector[:] = 0
                break
            vector /= length
    return q, lengths


def _wedge_residuals(data: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """Frequencies ω [k]; coefficients [3, row, k] of each row's residual α + β cos 2ωa + γ sin 2ωa about an axis a."""
    views, rows, cols = data.shape
    # Subtract an air level that is not zero: it is a box fixed to the detector, symmetric about its middle.
    edge = max(2, cols // 40)
    left, right = (np.median(part, axis=2)[..., None] for part in (data[:, :, :edge], data[:, :, -edge:]))
    data = data - (left + (right - left) * np.linspace(0, 1, cols))
    n = fft.next_fast_len(2 * cols, real=True)
    radius = cols / 2
    highest = min(np.pi / 2, 0.7 * views / radius)  # limited so that there are more projections than harmonics
    k = np.arange(1, max(3, int(highest * n / (2 * np.pi))) + 1)
    omega = 2 * np.pi * k / n
    harmonics = np.ceil(omega * radius + 2)
    spectrum = fft.rfft(data, n, axis=2)[:, :, k].reshape(views, -1)
    re, im = spectrum.real.copy(), spectrum.imag.copy()

    def residual_power(first: int) -> list[Floats]:
        """[row, k] re·re, im·im and re·im after the fit of harmonics first, first + 2 ... up to a frequency's limit."""
        order = np.repeat(np.arange(first, harmonics[-1] + 1, 2), 2)
        columns = np.where(np.arange(order.size) % 2, np.sin(np.outer(theta, order)), np.cos(np.outer(theta, order)))
        if first == 0:  # sin 0
            columns, order = np.delete(columns, 1, 1), np.delete(order, 1)
        # Nested: the first m rows of q span the first m harmonics.
        q, lengths = _orthonormal(columns.T)
        independent = lengths > 0.05 * np.sqrt(views)
        q, order = q[independent], order[: len(independent)][independent]
        allowed = order[:, None] <= harmonics
        in_re, in_im = ((q @ part).reshape(-1, rows, k.size) for part in (re, im))
        return [
            (x * y).reshape(views, rows, -1).sum(axis=0) - (u * v * allowed[:, None]).sum(axis=0)
            for x, y, u, v in ((re, re, in_re, in_re), (im, im, in_im, in_im), (re, im, in_re, in_im))
        ]

    # About an axis a the transform is (re + i im) e^{iωa}: even harmonics in its real part, odd in its imaginary part.
    even, odd = residual_power(0), residual_power(1)
    cosine2, sine2, mixed = even[0] + odd[1], even[1] + odd[0], odd[2] - even[2]
    return omega, np.stack([(cosine2 + sine2) / 2, (cosine2 - sine2) / 2, mixed])
