"""axis_from_ends: the rotation axis about which the last views of half a turn, mirrored, continue the first ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.base.views import spread
from recon.prep.axis_wedge import AxisEstimate, Floats, Search, few_rows, lowest, optimum, within

ENDS = "ends of half a turn"
_SIDE = 4  # views on each side of the join: they show how fast each structure moves
_NOISE = 0.01  # of the power, in the views' covariance: what the field cuts off is not in it
_FINER = 8  # candidates a column
_BLOCKS, _JOINS = 8, 8  # blocks of views, and joins within each, at most
_MOST_COLS = 1024  # enough for 0.1 px
_SURE = 0.3  # columns by which the median of these joins may be off

_Spectra = NDArray[np.complex128]


def axis_from_ends(projections: NDArray[np.floating], angles: Floats, search: Search = None) -> AxisEstimate:
    """Axis from the two ends of half a turn, also of a sample wider than the field.

    The last views mirrored about the axis are those before the first one. The 4 views on each side of this join count
    as samples of a random process, whose covariance over the angle all views tell, for each frequency. The curve is
    the likelihood of each candidate: a generalised cross-correlation (Knapp & Carter 1976, IEEE Trans. ASSP 24, 320) of
    several views, in which smooth matter counts little, and detail only as far as it stays alike from view to view.

    Neighbouring views within the scan join where they are. How far off such joins are found, by the covariance of the
    other views, tells how far off the axis may be.

    Args:
        projections: float32 [view, row, col], line integrals; a few rows are enough.
        angles: [view], radians; views up to half a turn after the first are used.
        search: (lowest, highest) column; None: the middle half.

    Returns:
        The curve is 0 where the ends fit as the median join within the scan does. The estimate is confident if the
        median of these joins is right to 0.3 columns: packed grains of 1.5 to 3 times the field's width are then found
        to 0.3 columns in 9 of 10 scans.

    Raises:
        ValueError: the views are not half a turn in even steps, or too few.
        AxisError: where the best axis lies at the edge of the search range or outside it.
    """
    order, times = _half_turn(np.asarray(angles, np.float64))
    data = few_rows(projections[order])
    bin_ = -(-data.shape[2] // _MOST_COLS)
    cols = data.shape[2] // bin_
    data = data[..., : cols * bin_].reshape(*data.shape[:2], cols, bin_).mean(axis=3)
    middle = (cols - 1) / 2
    for blocks in (0, 0, _BLOCKS):  # windows, each about the axis that the last one showed
        total = round(2 * min(max(middle, cols / 4), 3 * cols / 4 - 1))
        offsets, curve, errors = _join(data[..., max(0, total - cols + 1) : min(total, cols - 1) + 1], times, blocks)
        middle = total / 2 + lowest(offsets, curve)[0]
    candidates = (total / 2 + offsets) * bin_ + (bin_ - 1) / 2
    value, _ = optimum(candidates, curve, search)
    return AxisEstimate(value, *within(search, candidates, curve), bool(np.median(errors) * bin_ < _SURE), ENDS)


def _half_turn(theta: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Views of half a turn, in order, and the angles of the last (mirrored) and the first of them, in steps."""
    order = np.argsort(theta, kind="stable")
    turned = theta[order] - theta[order[0]]
    step = float(np.median(np.diff(turned)))
    order, turned = order[turned < np.pi + step / 2], turned[turned < np.pi + step / 2]
    if order.size < 4 * _SIDE or step <= 0 or max(np.diff(turned).max(), np.pi - turned[-1]) > 2 * step:
        raise ValueError(f"the views are not half a turn in {4 * _SIDE} even steps or more")
    return order, np.concatenate((turned[-_SIDE:] - np.pi, turned[:_SIDE])) / step


def _join(window: Floats, times: Floats, blocks: int) -> tuple[Floats, Floats, Floats]:
    """Columns [candidate] from the window's middle to the axis, their mismatch, and errors [join] within the scan.

    Args:
        window: [view, row, col]; `times` are those of its last and its first views.
        blocks: of views, whose joins set the scale of the mismatch; 0: none.
    """
    n, _, cols = window.shape
    mean, taper = window.mean(axis=0), np.hanning(cols + 2)[1:-1]
    seen = window - (mean + mean[:, ::-1]) / 2  # both ends share what is even, so that no seam is made
    seen = (seen - np.average(seen, axis=2, weights=taper)[..., None]) * taper
    length = fft.next_fast_len(2 * cols, real=True)
    spectra, late = (fft.rfft(each, length, axis=2)[..., 1:] for each in (seen, seen[-_SIDE:, :, ::-1]))
    steps = np.arange(-cols * _FINER // 4, cols * _FINER // 4 + 1)
    offsets = steps / _FINER
    overlap = np.correlate(taper, taper, "full")[cols - 1 :]
    fall = np.sqrt(np.interp(2 * np.abs(offsets), np.arange(cols), overlap / overlap[0]))

    def likelihood(late: _Spectra, early: _Spectra, weights: Floats) -> Floats:
        product = np.zeros(length * _FINER // 4 + 1, np.complex128)
        product[1 : spectra.shape[2] + 1] = np.einsum("irk,kij,jrk->k", late.conj(), weights, early)
        return fft.irfft(product, 2 * (product.size - 1))[steps] / fall

    joins = list[Floats]()
    for block in np.array_split(np.arange(n), min(blocks, n // (2 * _SIDE))) if blocks else ():
        others = np.delete(np.arange(n), block)
        weights, part = _weights(spectra, others, np.arange(2.0 * _SIDE)), spectra[block] - spectra[others].mean(axis=0)
        first = spread(np.arange(_SIDE, block.size - _SIDE + 1), _JOINS)
        joins += [likelihood(part[j - _SIDE : j], part[j : j + _SIDE], weights) for j in first]
    curve = likelihood(late, spectra[:_SIDE], _weights(spectra, np.arange(n), times))
    typical = float(np.median([each.max() for each in joins])) if joins else 1.0
    return offsets, 1 - curve / typical, np.array([abs(lowest(offsets, -each)[0]) for each in joins])


def _weights(spectra: _Spectra, used: NDArray[np.int64], times: Floats) -> Floats:
    """[frequency, late, early] of products of views at these `times` (steps), by the covariance of the views `used`."""
    n, lags, kept = len(spectra), np.arange(2 * _SIDE + 2), np.zeros(len(spectra), np.bool_)
    centred, kept[used] = np.zeros_like(spectra), True
    centred[used] = spectra[used] - spectra[used].mean(axis=0)
    power = np.stack(
        [
            np.einsum("vrk,vrk->k", centred[: n - lag].conj(), centred[lag:]).real
            / (kept[: n - lag] & kept[lag:]).sum()
            for lag in lags
        ]
    )
    apart = np.abs(times[:, None] - times)
    below = np.minimum(apart.astype(int), lags[-2])
    share = (apart - below)[..., None]
    covariance = np.moveaxis((1 - share) * power[below] + share * power[below + 1], 2, 0)
    size, axes = np.linalg.eigh(covariance)
    inverse = np.einsum("kij,kj,klj->kil", axes, 1 / (np.maximum(size, 0) + _NOISE * power[0][:, None]), axes)
    return -inverse[:, :_SIDE, _SIDE:]
