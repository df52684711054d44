"""Unmeasured pixels: which pixels of a view measured nothing, by its values; and whether the sample took their light.

Three kinds: what is not finite; what a shift or a turn of the image moved in, which has one value and holds a corner of
the frame; and something opaque that is not the sample, such as the post of a load frame, and reaches a border. Metal in
the sample is as dark. But it stays within the field, so that each row shows it in all views, or holds the same mass
where a view looks along it: a post comes and goes, and brings mass.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import F32, F64, I64, Mask, median_deviation
from recon.base.masks import areas, fill, plan_fill

NO_RUNS = np.zeros((0, 4), np.int64)
NO_RUNS.flags.writeable = False
DARK = 0.01  # transmission, below which a pixel has no light that counts
_BLOCK = np.ones((3, 3), np.bool_)
_RIM, _BEYOND = 4, 3  # pixels beside an area that interpolation or blur reach at most, and those that tell whether
_ALTERED, _SURE = 0.02, 3.0  # of the light, and standard errors, by which a rim differs from what lies beyond it
_FEWEST = 3  # dark pixels, at a border and in an area
_ONE_VALUE = 0.9  # of the pixels of an area are dark, and have one value, where it is not noise
_BELOW = 3.0  # standard deviations below the dark, as no camera reads
_CLEARLY = 0.5  # of the mass that comes and goes, so much may be left without the post


def unmeasured(values: NDArray[np.generic], light: F32, hidden: Mask, foreign: Mask | None) -> Mask | None:
    """Which pixels [row, col] of a view measured nothing; None: all did, or none.

    Args:
        values: as stored.
        light: transmission; NaN: not finite.
        hidden: areas that are masked in all views.
        foreign: bool [row], rows in which what is dark is not the sample, see `foreign_rows`; None: none.
    """
    if light.min() > DARK:  # never of NaN
        return None
    low = ~(light > DARK)
    unknown = low & ~np.isfinite(light) & ~hidden
    if not (_corners(low).any() or (foreign is not None and foreign.any()) or unknown.any()):
        return None
    labels, nothing_seen = _at_borders(low, hidden), np.zeros_like(low)
    for label in {*_corners(labels).flat} - {0}:
        part = (labels == label) & low & ~hidden & ~unknown
        solid = np.mean((low | hidden)[labels == label]) > _ONE_VALUE
        stored, seen = values[part], light[part].astype(np.float64)
        if (
            part.any()
            and solid
            and (np.mean(stored == np.median(stored)) > _ONE_VALUE or seen.mean() < -_BELOW * seen.std())
        ):
            nothing_seen |= labels == label
    if foreign is not None:
        nothing_seen |= (labels > 0) & foreign[:, None]
    nothing_seen = with_rim(nothing_seen & ~hidden, np.where(hidden, np.float32(np.nan), light)) | areas(unknown)
    nothing_seen &= ~hidden
    return nothing_seen if nothing_seen.any() and not (nothing_seen | hidden).all() else None


def with_rim(dark: Mask, light: F32) -> Mask:
    """Dark areas [row, col], and on each of their four sides the pixels beside them whose light is not their own.

    Blur, or interpolation by a shift, mixes the light of an edge: the pixels next to it on this side differ, in the
    median, from a straight line through the logarithms of the next three, and so on outwards. Rows that are not read,
    or a shift by whole pixels, leave the next pixel as it was.

    Args:
        light: transmission [row, col]; NaN: unknown.
    """
    found, at = dark.copy(), np.arange(1, _RIM + _BEYOND + 1)
    lines = np.pad(np.where(dark, np.nan, np.log(np.maximum(light, DARK))), at[-1], mode="edge")
    for turn in range(4):
        area, known = np.rot90(found, turn), np.rot90(lines, turn)
        row, col = np.nonzero(area[:, :-1] & ~area[:, 1:])
        beside, reach = known[at[-1] + row[:, None], at[-1] + col[:, None] + at], 0
        while row.size and reach < _RIM and _mixed(beside[:, reach : reach + 1 + _BEYOND]):
            reach += 1
            area[row, np.minimum(col + reach, area.shape[1] - 1)] = True
    return found


def _mixed(lines: F64) -> bool:
    """Whether the first of adjacent pixels [edge, pixel] lacks the light that the others extrapolate to; logarithms."""
    lines = lines[np.isfinite(lines).all(axis=1)]
    if not len(lines):
        return True
    others = lines[:, 1:]
    steps = (others[:, -1] - others[:, 0]) / (_BEYOND - 1)
    away = lines[:, 0] - others.mean(axis=1) + steps * (_BEYOND + 1) / 2
    middle = np.median(away)
    return bool(abs(middle) > max(_ALTERED, _SURE * median_deviation(away - middle) / np.sqrt(len(away))))


def foreign_rows(light: F32, angles: F64) -> Mask:
    """Rows [row] whose dark areas at borders come and go, and bring more matter than the other views show there.

    Args:
        light: transmission [view, row, col], finite, of views all around.
        angles: of these, radians.
    """
    lit = (light > DARK).any(axis=(1, 2))
    light, angles = light[lit], angles[lit]
    if not lit.any():
        return np.zeros(light.shape[1], np.bool_)
    dark: Mask = np.stack([_at_borders(view <= DARK, np.zeros(view.shape, np.bool_)) > 0 for view in light])
    has_dark: Mask = np.any(dark, axis=2)
    rows = has_dark.any(axis=0) & ~has_dark.all(axis=0)
    with_dark = has_dark[:, rows].any(axis=1)
    if with_dark.all() or not with_dark.any():
        return np.zeros_like(rows)
    lines = -np.log(np.maximum(light[:, rows], np.float32(DARK)))
    mass = lines.sum(axis=(1, 2), dtype=np.float64)
    for view in np.flatnonzero(with_dark):
        hidden = with_rim(dark[view], light[view])[rows]
        if hidden.all():
            lines[view] = 0
        else:
            fill(lines[view], plan_fill(hidden))
    free = np.flatnonzero(~with_dark)[np.argsort(angles[~with_dark])]
    usual = np.interp(angles[with_dark], angles[free], mass[free])
    brought, remaining = mass[with_dark] - usual, lines[with_dark].sum(axis=(1, 2), dtype=np.float64) - usual
    return rows & (brought.sum() > 0 and np.abs(remaining).sum() < _CLEARLY * np.abs(brought).sum())


def with_borders_filled(image: NDArray[Any]) -> NDArray[Any]:
    """An image of counts whose areas of exact zeros at its corners have the value of the nearest pixel beside them."""
    if (_corners(image) != 0).all():
        return image
    labels = _at_borders(image == 0, np.zeros(image.shape, np.bool_))
    blank = ndimage.binary_dilation(np.isin(labels, _corners(labels)) & (labels > 0), _BLOCK, 2)
    nearest = ndimage.distance_transform_edt(blank, return_distances=False, return_indices=True)
    return image if blank.all() else image[tuple(nearest)]


def runs_of(mask: Mask, view: int) -> I64:
    """Runs [run, 4] of the pixels [row, col] of a view: its number, row, first column, column after the last."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, first), end = np.nonzero(edges > 0), np.nonzero(edges < 0)[1]
    return np.stack([np.full(row.size, view), row, first, end], axis=1).astype(np.int64)


def _at_borders(low: Mask, hidden: Mask) -> NDArray[np.int32]:
    """Areas [row, col] of dark pixels that reach a border of the frame, or what is hidden there, by number; 0: none."""
    if sum(np.count_nonzero(side) for side in (low[0], low[-1], low[:, 0], low[:, -1])) < _FEWEST:
        return np.zeros(low.shape, np.int32)
    dark = np.pad(low | hidden, 3, mode="edge")  # the outer layer goes in closing
    solid = ndimage.binary_opening(ndimage.binary_closing(dark, _BLOCK), _BLOCK)[3:-3, 3:-3]
    labels, n = ndimage.label(solid | (low & (low.mean(axis=1) > _ONE_VALUE)[:, None]), _BLOCK)  # also single rows
    at_border = np.unique(np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1])))
    large = np.bincount(labels[low & ~hidden], minlength=n + 1) >= _FEWEST
    return np.where(np.isin(labels, at_border[at_border > 0]) & large[labels], labels, 0)


def _corners(image: NDArray[Any]) -> NDArray[Any]:
    return image[:: max(len(image) - 1, 1), :: max(image.shape[1] - 1, 1)]
