"""axis_from_ends: the rotation axis about which the last views of half a turn, mirrored, continue the first ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.prep.axis_wedge import AxisEstimate, Floats, few_rows, lowest, optimum

ENDS = "ends of half a turn"
_SIDE = 4  # views on each side of the join: they show how fast each structure moves
_FEWEST = 8 * _SIDE  # views that tell their covariance without those of a join
_NOISE = 0.01  # of the power, in the views' covariance: what the field cuts off is not in it
_FINER, _BLOCKS = 8, 8  # candidates a column; blocks of views, at most
_SURE = 0.3  # columns by which the median of the joins within the scan may be off
_CLEAR, _RIVAL = 0.4, 24  # less mismatch than of axes a 24th of the field away; right ones had 0.48, wrong ones to 0.3


def axis_from_ends(projections: NDArray[np.floating], angles: Floats) -> AxisEstimate:
    """Axis from the two ends of half a turn, also of a sample wider than the field.

    The last views mirrored about the axis are those before the first one. The 4 views on each side of this join count
    as samples of a random process, whose covariance over the angle all views tell, for each frequency. The curve is
    the likelihood of each candidate: a generalised cross-correlation (Knapp & Carter 1976, IEEE Trans. ASSP 24, 320) of
    several views. Views within the scan join where they are; how far off that is found, by the covariance of the other
    views, tells how far off the axis may be.

    Args:
        projections: float32 [view, row, col], line integrals; a few rows are enough.
        angles: [view], radians; views up to half a turn after the first are used.

    Returns:
        The curve is 0 where the ends fit as the median join within the scan does, with what all views share: this may
        be matter, or noise of the flats. Confident if the median of the joins, without it, is right to 0.3 columns: 9
        in 10 axes of packed grains in 1.5 to 3 times the field then were.

    Raises:
        ValueError: the views are not half a turn in even steps, or too few.
        AxisError: the best axis lies at the edge of the middle half.
    """
    order, times = _half_turn(np.asarray(angles, np.float64))
    data = few_rows(projections[order])
    cols = data.shape[2]
    curve, error = np.full(_FINER * cols, np.inf), 0.0
    totals = {round(2 * share * cols) for share in (0.4, 0.5, 0.6)}  # windows; those about the axes that they show:
    for total in {round(2 * lowest(*_join(data, each, times)[:2])[0]) for each in totals}:
        candidates, values, errors = _join(data, total, times)
        at = np.round(_FINER * candidates).astype(int)
        error = float(np.median(errors)) if values.min() < curve.min() else error
        curve[at] = np.minimum(curve[at], values)
    candidates, curve = np.flatnonzero(np.isfinite(curve)) / _FINER, curve[np.isfinite(curve)]
    value, _ = optimum(candidates, curve)
    rivals = curve[np.abs(candidates - candidates[curve.argmin()]) > cols / _RIVAL]
    confident = bool(error < _SURE and rivals.min() - curve.min() > _CLEAR)
    return AxisEstimate(value, candidates, curve, confident, ENDS)


def _half_turn(theta: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Views of half a turn, in order, and the angles of the last (mirrored) and the first of them, in steps."""
    order = np.argsort(theta, kind="stable")
    turned = theta[order] - theta[order[0]]
    step = float(np.median(np.diff(turned)))
    order, turned = order[turned < np.pi + step / 2], turned[turned < np.pi + step / 2]
    if order.size < _FEWEST or max(np.diff(turned).max(), np.pi - turned[-1]) > 2.5 * step:  # some of many: uneven
        raise ValueError(f"the views are not half a turn in {_FEWEST} even steps or more")
    return order, np.concatenate((turned[-_SIDE:] - np.pi, turned[:_SIDE])) / step


def _join(data: Floats, total: int, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Candidate columns for the axis, their mismatch, and errors [join] in columns at joins within the scan.

    Args:
        data: [view, row, col]; `times` are those of its last and its first views.
        total: twice the column about which the window lies.
    """
    n, _, cols = data.shape
    total = min(max(total, cols // 2), 3 * cols // 2)
    window = data[..., max(0, total - cols + 1) : min(total, cols - 1) + 1]
    cols = window.shape[2]
    mean, taper = window.mean(axis=0), np.hanning(cols + 2)[1:-1]
    seen = window - (mean + mean[:, ::-1]) / 2  # both ends share what is even, so that no seam is made
    seen = (seen - np.average(seen, axis=2, weights=taper)[..., None]) * taper
    length = fft.next_fast_len(2 * cols, real=True)
    spectra, late = (fft.rfft(each, length, axis=2)[..., 1:] for each in (seen, seen[-_SIDE:, :, ::-1]))
    offsets = np.arange(-cols * _FINER // 4, cols * _FINER // 4 + 1)

    def likelihood(late: NDArray[np.complex128], early: NDArray[np.complex128], weights: Floats) -> Floats:
        product = np.zeros(length * _FINER // 4 + 1, np.complex128)
        product[1 : spectra.shape[2] + 1] = np.einsum("irk,kij,jrk->k", late.conj(), weights, early)
        return fft.irfft(product, 2 * (product.size - 1))[offsets]

    centred = spectra - spectra.mean(axis=0)
    pairs = [(centred[: n - lag].conj() * centred[lag:]).real.sum(axis=1) for lag in range(2 * _SIDE + 2)]
    joins, whole = list[Floats](), list[float]()
    for block in np.array_split(np.arange(n), min(_BLOCKS, n // (2 * _SIDE))):
        used = np.isin(np.arange(n), block, invert=True)
        weights, mean = _weights(pairs, used, np.arange(2.0 * _SIDE)), spectra[used].mean(axis=0)
        for j in range(_SIDE, block.size - _SIDE + 1, 1 + block.size // 20):
            before, after = spectra[block[j - _SIDE : j]], spectra[block[j : j + _SIDE]]
            joins.append(likelihood(before - mean, after - mean, weights))
            whole.append(float(likelihood(before, after, weights).max()))
    curve = likelihood(late, spectra[:_SIDE], _weights(pairs, np.ones(n, np.bool_), times))
    errors = np.array([abs(lowest(offsets / _FINER, -each)[0]) for each in joins])
    return total / 2 + offsets / _FINER, 1 - curve / np.median(whole), errors


def _weights(pairs: list[Floats], used: NDArray[np.bool_], times: Floats) -> Floats:
    """[frequency, late, early] of products of views at these `times` (steps), by the covariance of the views `used`.

    Args:
        pairs: [lag] of [view, frequency], products of a view with the one so many steps later.
    """
    power = np.stack([each[used[: len(each)] & used[used.size - len(each) :]].mean(axis=0) for each in pairs])
    apart = np.abs(times[:, None] - times)
    below = np.minimum(apart.astype(int), len(pairs) - 2)
    share = (apart - below)[..., None]
    size, axes = np.linalg.eigh(np.moveaxis((1 - share) * power[below] + share * power[below + 1], 2, 0))
    inverse = np.einsum("kij,kj,klj->kil", axes, 1 / (np.maximum(size, 0) + _NOISE * power[0][:, None]), axes)
    return -inverse[:, :_SIDE, _SIDE:]
