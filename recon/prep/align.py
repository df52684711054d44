"""find_axis: the rotation axis from the data, with the curve of each estimate and whether it is reliable.

Four methods with different weaknesses: the pair needs two views half a turn apart, and an axis near the middle.
Opposite views need a full turn. The double wedge needs views over about half a turn. The centre of mass takes any
sector, but needs the whole sample in the field and air at zero.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d

from recon.base.units import warn_of_degrees

Floats = NDArray[np.float64]

_MOST_VIEWS, _MOST_ROWS, _MOST_COLS = 256, 16, 1024  # enough for 0.1 px
_STEP = 0.25  # px between candidates
_WIDEST_GAP = np.deg2rad(20)  # share of a half turn; with a wider gap the double wedge does not determine the axis
_FEWEST_PAIRS, _MOST_PAIRS = 8, 64
_EDGE = 25  # one column in so many, at each edge, is too near to it for an axis
_AGREE = 1.0  # px by which independent estimates may differ and still count as equal


class AxisError(ValueError):
    """The best axis lies at or outside the edge of the search range, so there is no estimate."""


@dataclass(frozen=True, eq=False)
class AxisEstimate:
    """Estimate of the rotation axis.

    Attributes:
        value: axis_col in pixels, 0 at the centre of the first column.
        candidates: float64 [n], the columns tested.
        curve: float64 [n], mismatch at each candidate: 0 is perfect agreement, about 1 no agreement.
        confident: False if the minimum of the curve is shallow, or parts of the data disagree.
        method: "pair", "opposite views", "double wedge", "centre of mass" or "views held out".
    """

    value: float
    candidates: Floats
    curve: Floats
    confident: bool
    method: str


def axis_from_pair(
    p0: NDArray[np.floating], p180: NDArray[np.floating], search: tuple[float, float] | None = None
) -> AxisEstimate:
    """Axis from two views half a turn apart: p180 is p0 mirrored about the axis.

    The normalised correlation of p0 with the mirrored p180 is taken at every half column, then a parabola through the
    peak. A mirror about a half column maps pixels on pixels, so nothing is interpolated. Samples wider than the field
    are allowed: only columns that both views see are compared.

    Args:
        p0, p180: float32 [row, col], line integrals.
        search: (lowest, highest) column; None: the middle three quarters.

    Raises:
        ValueError: for shapes that differ or values that are not finite.
        AxisError: where the best match lies at the edge of the search range or outside it.
    """
    a, b = np.atleast_2d(p0).astype(np.float64), np.atleast_2d(p180).astype(np.float64)
    if a.shape != b.shape:
        raise ValueError(f"the two views have shapes {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("the two views hold NaN or infinite values; correct them first")
    cols = a.shape[1]
    rows = np.unique(np.linspace(0, len(a) - 1, min(len(a), 4 * _MOST_ROWS)).astype(int))
    candidates = np.arange(cols // 8 * 2, 2 * cols - 1 - cols // 8 * 2) / 2
    curve = _mirror_mismatch(a[rows], b[rows], candidates)
    value, depth = _optimum(candidates, curve, search)
    confident = depth > 0.5
    if confident and rows.size >= 8:
        halves = [_mirror_mismatch(a[part], b[part], candidates) for part in (rows[::2], rows[1::2])]
        confident = max(abs(_lowest(candidates, half)[0] - value) for half in halves) < _AGREE
    return AxisEstimate(value, *_within(search, candidates, curve), confident, "pair")


def axis_from_opposites(
    projections: NDArray[np.floating], angles: Floats, search: tuple[float, float] | None = None
) -> AxisEstimate:
    """Axis from all pairs of opposite views of a full turn, also where it stands near an edge of the detector.

    As `axis_from_pair`, but from the views' slopes along the columns, which share no trend if the overlap is narrow.
    The sum is over up to 64 pairs and over rows (the overlap of wide-field scans: Vo et al. 2021, Opt. Express
    29, 17849).

    Args:
        projections: float32 [view, row, col], line integrals.
        angles: [view], radians.
        search: (lowest, highest) column; None: all but a 25th at each edge.

    Raises:
        ValueError: fewer than 8 pairs of opposite views, or values that are not finite.
        AxisError: where the best match lies at the edge of the search range or outside it.
    """
    a, b = _opposites(projections, angles)
    candidates = _opposite_candidates(projections.shape[2])
    curve = _mirror_mismatch(_rows_of(a), _rows_of(b), candidates - 0.5)
    value, depth = _optimum(candidates, curve, search)
    halves = [_mirror_mismatch(_rows_of(a[i::2]), _rows_of(b[i::2]), candidates - 0.5) for i in (0, 1)]
    apart = max(abs(_lowest(candidates, half)[0] - value) for half in halves)
    return AxisEstimate(value, *_within(search, candidates, curve), depth > 0.5 and apart < _AGREE, "opposite views")


def _opposite_candidates(cols: int) -> Floats:
    return np.arange(2 * cols // _EDGE, 2 * (cols - 1) - 2 * cols // _EDGE) / 2


def _opposites(projections: NDArray[np.floating], angles: Floats) -> tuple[Floats, Floats]:
    """Slopes along the columns [pair, row, col - 1] of some rows of views, and of opposite views, negated."""
    theta, cols = np.mod(np.asarray(angles, np.float64), 2 * np.pi), projections.shape[2]
    away = np.abs(np.mod(theta[:, None] - theta + np.pi, 2 * np.pi) - np.pi)
    opposite = away.argmax(axis=1)
    exact = np.pi - away[np.arange(theta.size), opposite] < max(2 / cols, 1e-9)
    first = np.flatnonzero(exact & (theta < theta[opposite]))
    if first.size < _FEWEST_PAIRS:
        raise ValueError(f"{first.size} pairs of views half a turn apart; {_FEWEST_PAIRS} are needed")
    first = first[np.unique(np.linspace(0, first.size - 1, min(first.size, _MOST_PAIRS)).astype(int))]
    data = _few_rows(projections[np.concatenate((first, opposite[first]))])
    if not np.isfinite(data).all():
        raise ValueError("the views hold NaN or infinite values; correct them first")
    slopes = np.diff(uniform_filter1d(data, 3, axis=2), axis=2)
    return slopes[: first.size], -slopes[first.size :]


def _rows_of(views: Floats) -> Floats:
    return views.reshape(-1, views.shape[2])


def _mirror_mismatch(a: Floats, b: Floats, candidates: Floats) -> Floats:
    """1 - normalised correlation of a[i] with b[2 axis - i], over the columns that both have and over all rows.

    It is 1 if these columns hold too little of the views' variance: air alone always matches.
    """
    rows, cols = a.shape
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    total = (2 * candidates).astype(int)  # i + j of the pixels compared
    n = fft.next_fast_len(2 * cols, real=True)
    product = fft.irfft(fft.rfft(a, n) * fft.rfft(b, n), n)[:, total]
    first, last = np.maximum(total - cols + 1, 0), np.minimum(total, cols - 1) + 1

    def sums(x: Floats) -> Floats:
        cumulative = np.concatenate([np.zeros((rows, 1)), np.cumsum(x, axis=1)], axis=1)
        return cumulative[:, last] - cumulative[:, first]

    count, sum_a, sum_b = last - first, sums(a), sums(b)
    covariance = (product - sum_a * sum_b / count).sum(axis=0)
    variance = (sums(a * a) - sum_a**2 / count).sum(axis=0) * (sums(b * b) - sum_b**2 / count).sum(axis=0)
    usable = variance > 1e-6 * (a * a).sum() * (b * b).sum()
    return np.where(usable, 1 - covariance / np.sqrt(np.where(usable, variance, 1)), 1)


def axis_from_sinogram(
    sinogram: NDArray[np.floating], angles: Floats, search: tuple[float, float] | None = None
) -> AxisEstimate:
    """Axis from all views, without a pair: for uneven, sparse and noisy scans, sectors and full turns.

    About half a turn or more: the double wedge. The Fourier transform of a sinogram along the columns holds, at
    frequency ω, only the angular harmonics |n| <= ω r of a sample of radius r. (Edholm, Lewitt & Lindholm 1986; used
    for the axis by Vo et al. 2014, Opt. Express 22, 19078). About the right axis the view at θ + π is the mirrored view
    at θ. So the real part has even harmonics only and the imaginary part odd ones. The curve is the residual of a
    least-squares fit of these harmonics to the views. It takes angles in any spacing and is a sum of cosines of the
    axis, so nothing is interpolated.

    Less than half a turn, or a wedge that is not confident: the centre of mass of the views, fitted by
    axis + a cos θ + b sin θ (the first of the Helgason-Ludwig conditions).

    Args:
        sinogram: float32 [view, col] or [view, row, col], line integrals; a few rows are enough.
        angles: [view], radians, any order and range.
        search: (lowest, highest) column; None: the whole detector.

    Raises:
        ValueError: for shapes that do not fit, fewer than 4 views, or values that are not finite.
        AxisError: where the best axis lies at the edge of the search range or outside it.
    """
    theta = np.asarray(angles, np.float64)
    if sinogram.ndim not in (2, 3) or theta.shape != sinogram.shape[:1]:
        raise ValueError(f"sinogram {sinogram.shape} must be [view, col] or [view, row, col] for angles {theta.shape}")
    data = _few_rows(sinogram[:, None] if sinogram.ndim == 2 else sinogram)
    if len(theta) < 4 or data.shape[2] < 8:
        raise ValueError(
            f"{len(theta)} views of {data.shape[2]} columns are too few to find an axis; 4 of 8 are needed"
        )
    if not (np.isfinite(data).all() and np.isfinite(theta).all()):
        raise ValueError("sinogram or angles hold NaN or infinite values; correct them first")
    if not _covers_half_a_turn(theta):
        return _axis_from_mass(data, theta, search)
    wedge = _axis_from_wedge(data, theta, search)
    if wedge.confident:
        return wedge
    with suppress(AxisError):
        mass = _axis_from_mass(data, theta, search)
        return mass if mass.confident and abs(mass.value - wedge.value) < _AGREE else wedge
    return wedge


def _axis_from_mass(data: Floats, theta: Floats, search: tuple[float, float] | None) -> AxisEstimate:
    cols = data.shape[2]
    order = np.argsort(theta)
    theta, profile = theta[order], data[order].mean(axis=1)
    mass = profile.sum(axis=1)
    if not (mass > 0).all():
        raise AxisError("some views hold no mass to find an axis from; check the dark and flat correction")
    basis = np.stack([np.ones_like(theta), np.cos(theta), np.sin(theta)], axis=1)
    centre = profile @ np.arange(cols) / mass
    covariance = np.linalg.pinv(basis.T @ basis)
    solution = covariance @ (basis.T @ centre)
    residual = centre - basis @ solution
    value, left_over = float(solution[0]), float(residual @ residual)
    # An error of the axis adds this much a px² to the sum of squares; the curve is in units of a quarter of the field.
    rise = 1 / covariance[0, 0]
    candidates = np.arange(0, cols - 1 + _STEP / 2, _STEP)
    curve = (left_over + rise * (candidates - value) ** 2) / (rise * (cols / 4) ** 2)
    low, high = (candidates[0], candidates[-1]) if search is None else search
    if not low < value < high:
        raise _axis_error(value, search, candidates, "outside it")
    # Correlated neighbouring residuals are not independent; air that is not at zero biases the axis without scatter.
    correlation = float(np.clip(residual[1:] @ residual[:-1] / max(left_over, 1e-30), 0, 0.99))
    error = np.sqrt(left_over / max(len(theta) - 3, 1) / rise * (1 + correlation) / (1 - correlation))
    edge = max(2, cols // 40)
    left, right = float(profile[:, :edge].mean()), float(profile[:, -edge:].mean())
    bias = abs(left - right) / 2 * cols**2 / 6 + abs(left + right) / 2 * cols * abs(value - (cols - 1) / 2)
    whole = max(abs(left), abs(right)) < 0.05 * profile.max() and mass.std() < 0.03 * mass.mean()
    confident = whole and 2 * error + bias / mass.mean() < _AGREE
    return AxisEstimate(value, *_within(search, candidates, curve), bool(confident), "centre of mass")


def wedge_curves(data: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """Candidates [n] for the axis, and the mismatch [row, n] of each row of [view, row, col] by the double wedge.

    Raises:
        ValueError: the views leave a gap in the half turn.
    """
    if not _covers_half_a_turn(theta):
        raise ValueError("the views do not go round half a turn evenly")
    part, theta, bin_ = _for_wedge(data, theta)
    omega, fits = _wedge_residuals(part, theta)
    candidates = np.arange(0, part.shape[2] - 1 + _STEP / 2, _STEP)
    phase = 2 * np.outer(candidates, omega)
    fits = fits * omega ** _power(part)
    curves = fits[0].sum(axis=1)[:, None] + fits[1] @ np.cos(phase).T + fits[2] @ np.sin(phase).T
    return candidates * bin_ + (bin_ - 1) / 2, curves / np.maximum(fits[0].sum(axis=1), 1e-30)[:, None]


def opposite_curves(data: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """As `wedge_curves`, by pairs of opposite views.

    Raises:
        ValueError: see `axis_from_opposites`.
    """
    a, b = _opposites(data, theta)
    candidates = _opposite_candidates(data.shape[2])
    rows = range(data.shape[1])
    return candidates, np.stack([_mirror_mismatch(a[:, row], b[:, row], candidates - 0.5) for row in rows])


def _covers_half_a_turn(theta: Floats) -> bool:
    half_turn = np.sort(np.mod(theta, np.pi))
    gap = np.diff(half_turn, append=half_turn[0] + np.pi).max()
    return bool(gap <= max(_WIDEST_GAP, 4 * np.pi / len(theta)))


def _for_wedge(data: Floats, theta: Floats) -> tuple[Floats, Floats, int]:
    """The necessary views and columns, their angles, and the number of columns that were averaged."""
    views = np.argsort(np.mod(theta, np.pi), kind="stable")[:: -(-len(theta) // _MOST_VIEWS)]
    bin_ = -(-data.shape[2] // _MOST_COLS)
    cols = data.shape[2] // bin_
    part = data[views, :, : cols * bin_].reshape(len(views), -1, cols, bin_).mean(axis=3)
    return part, theta[views], bin_


def _power(part: Floats) -> int:
    """Exponent of the frequency that weighs residuals: 2 if the rim is not air (bad low frequencies), otherwise 1."""
    rim = np.abs(part[:, :, [0, 1, -2, -1]].mean(axis=(0, 1))).max()
    return 2 if rim > 0.05 * part.mean(axis=(0, 1)).max() else 1


def _axis_from_wedge(data: Floats, theta: Floats, search: tuple[float, float] | None) -> AxisEstimate:
    part, theta, bin_ = _for_wedge(data, theta)
    cols = part.shape[2]
    omega, fits = _wedge_residuals(part, theta)
    fit = fits.sum(axis=1)
    candidates = np.arange(0, cols - 1 + _STEP / 2, _STEP)
    phase = 2 * np.outer(candidates, omega)
    basis = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)])

    def curve_for(power: int) -> Floats:
        weighted = fit * omega**power
        return np.einsum("knw,kw->n", basis, weighted) / max(float(weighted[0].sum()), 1e-30)

    power = _power(part)  # one harmonic more and one less must give the same axis
    curve = curve_for(power)
    full = candidates * bin_ + (bin_ - 1) / 2
    value, depth = _optimum(full, curve, search)
    bands = abs(_lowest(full, curve_for(power - 1))[0] - _lowest(full, curve_for(power + 1))[0])
    return AxisEstimate(value, *_within(search, full, curve), depth > 0.5 and bands < _AGREE * bin_, "double wedge")


def _wedge_residuals(data: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """Frequencies ω [k], coefficients [3, row, k] of each row's residual α + β cos 2ωa + γ sin 2ωa about an axis a."""
    views, rows, cols = data.shape
    # Subtract air that is not at zero: it is a box fixed to the detector, symmetric about its middle.
    edge = max(2, cols // 40)
    left, right = (np.median(part, axis=2)[..., None] for part in (data[:, :, :edge], data[:, :, -edge:]))
    data = data - (left + (right - left) * np.linspace(0, 1, cols))
    n = fft.next_fast_len(2 * cols, real=True)
    radius = cols / 2
    highest = min(np.pi / 2, 0.7 * views / radius)  # so that there are more views than harmonics
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
        # Nested: the first m columns of q span the first m harmonics. With torch: NumPy's threads
        # spin, which takes seconds where other processes use the cores.
        q, r = (part.numpy() for part in torch.linalg.qr(torch.from_numpy(columns)))
        independent = np.abs(np.diag(r)) > 0.05 * np.sqrt(views)
        q, order = torch.from_numpy(q[:, independent]), order[: len(independent)][independent]
        allowed = order[:, None] <= harmonics
        in_re, in_im = ((q.T @ torch.from_numpy(part)).numpy().reshape(-1, rows, k.size) for part in (re, im))
        return [
            (x * y).reshape(views, rows, -1).sum(axis=0) - (u * v * allowed[:, None]).sum(axis=0)
            for x, y, u, v in ((re, re, in_re, in_re), (im, im, in_im, in_im), (re, im, in_re, in_im))
        ]

    # About an axis a the transform is (re + i im) e^{iωa}: even harmonics in its real part, odd in its imaginary part.
    even, odd = residual_power(0), residual_power(1)
    cosine2, sine2, mixed = even[0] + odd[1], even[1] + odd[0], odd[2] - even[2]
    return omega, np.stack([(cosine2 + sine2) / 2, (cosine2 - sine2) / 2, mixed])


def find_axis(
    projections: NDArray[np.floating], angles: Floats, search: tuple[float, float] | None = None
) -> AxisEstimate:
    """The rotation axis of a scan from all views, checked against a pair half a turn apart if there is one.

    If all views together give no axis, and they cover the full turn, pairs of opposite views do. The axis of a wide
    field stands near an edge of the detector.

    Args:
        projections: float32 [view, row, col], line integrals.
        angles: [view], radians.
        search: (lowest, highest) column; None: the whole detector.

    Returns:
        The estimate from all views, or from opposite views or the pair if only these are confident. It is not
        confident if they disagree.

    Raises:
        ValueError, AxisError: as `axis_from_sinogram`.

    Warns:
        UserWarning: where angles look like degrees.
    """
    theta = np.asarray(angles, np.float64)
    if projections.ndim != 3:
        raise ValueError(f"projections must be [view, row, col], got shape {projections.shape}")
    warn_of_degrees(theta)
    try:
        from_all = axis_from_sinogram(projections, theta, search)
    except AxisError:
        if (from_opposites := _confident_opposites(projections, theta, search)) is not None:
            return from_opposites
        raise
    if not from_all.confident and (from_opposites := _confident_opposites(projections, theta, search)) is not None:
        return from_opposites
    pair = _closest_pair(theta, tolerance=2 / projections.shape[2])
    if pair is None:
        return from_all
    try:
        from_pair = axis_from_pair(projections[pair[0]], projections[pair[1]], search)
    except AxisError:  # these two views do not show the axis, but all views together do
        return from_all
    if not from_pair.confident:
        return from_all
    if abs(from_all.value - from_pair.value) > _AGREE:
        return replace(from_all, confident=False)
    return from_all if from_all.confident else from_pair


def _confident_opposites(
    projections: NDArray[np.floating], theta: Floats, search: tuple[float, float] | None
) -> AxisEstimate | None:
    with suppress(ValueError):  # an AxisError is a ValueError, too
        estimate = axis_from_opposites(projections, theta, search)
        return estimate if estimate.confident else None
    return None


def _closest_pair(theta: Floats, tolerance: float) -> tuple[int, int] | None:
    """The two views nearest to half a turn apart; None if no pair is within the tolerance (radians)."""
    order = np.argsort(np.mod(theta, 2 * np.pi))
    turned = np.mod(theta[order], 2 * np.pi)
    extended = np.concatenate([turned, turned + 2 * np.pi])
    at = np.searchsorted(extended, turned + np.pi)
    options = np.stack([np.clip(at - 1, 0, None), np.clip(at, None, extended.size - 1)])
    miss = np.abs(extended[options] - turned - np.pi)
    side, first = np.unravel_index(int(miss.argmin()), miss.shape)
    if miss[side, first] > tolerance:
        return None
    return int(order[first]), int(order[options[side, first] % order.size])


def _few_rows(data: NDArray[np.floating]) -> Floats:
    """At most 16 rows, each the mean of up to 4, which has less noise: the sum of slices is again a slice."""
    rows = data.shape[1]
    if rows <= _MOST_ROWS:
        return np.asarray(data, np.float64)
    group = min(4, rows // _MOST_ROWS)
    chosen = np.linspace(0, rows - 1, _MOST_ROWS * group).astype(int)
    return data[:, chosen].reshape(len(data), _MOST_ROWS, group, -1).mean(axis=2, dtype=np.float64)


def _lowest(candidates: Floats, curve: Floats) -> tuple[float, int]:
    """Position of the minimum, by a parabola through three points, and its index."""
    i = int(curve.argmin())
    if not 0 < i < curve.size - 1:
        return float(candidates[i]), i
    below, here, above = curve[i - 1 : i + 2]
    bend = below - 2 * here + above
    shift = 0.5 * (below - above) / bend if bend > 0 else 0.0
    return float(candidates[i] + shift * (candidates[1] - candidates[0])), i


def _within(search: tuple[float, float] | None, candidates: Floats, curve: Floats) -> tuple[Floats, Floats]:
    if search is None:
        return candidates, curve
    inside = (candidates >= search[0]) & (candidates <= search[1])
    return candidates[inside], curve[inside]


def _axis_error(value: float, search: tuple[float, float] | None, candidates: Floats, where: str) -> AxisError:
    low, high = (candidates[0], candidates[-1]) if search is None else search
    return AxisError(
        f"no rotation axis in the search range {low:g} to {high:g}: the best column is {value:.2f}, {where}; "
        "widen the range, or give the axis"
    )


def _optimum(candidates: Floats, curve: Floats, search: tuple[float, float] | None) -> tuple[float, float]:
    """The minimum inside the search range and its depth, 0 (as bad as the typical candidate) to 1 (perfect agreement).

    A minimum at the edge of the range, or clearly worse than one outside, raises AxisError: a range without the axis
    also has a minimum.
    """
    part, values = _within(search, candidates, curve)
    if part.size < 3:
        low, high = (candidates[0], candidates[-1]) if search is None else search
        raise ValueError(
            f"search range {low:g} to {high:g} holds {part.size} candidates; the axis is looked for in columns "
            f"{candidates[0]:g} to {candidates[-1]:g}"
        )
    value, i = _lowest(part, values)
    if i in (0, part.size - 1):
        raise _axis_error(value, search, candidates, "at its edge")
    typical = float(np.median(curve))
    depth, deepest = typical - float(values[i]), typical - float(curve.min())
    if depth < 0.8 * deepest:
        raise _axis_error(_lowest(candidates, curve)[0], search, candidates, "outside it")
    return value, depth / typical if typical > 0 else 0.0
