"""Unmeasured pixels: which pixels of a view measured nothing, by its values; and whether the sample took their light.

Three kinds reach a border of the frame, or are not finite: what a shift or a turn of the image moved in, which has one
value; something opaque in the beam that is not the sample, such as the post of a load frame; and rows without beam.
Metal in the sample is as dark. But it stays within the field, so that each row shows it in all views, or holds the same
mass where a view looks along it: a post comes and goes, and its mass comes and goes with it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import F32, F64, I64, Mask
from recon.base.masks import areas, fill, plan_fill

DARK = 0.01  # transmission, below which a pixel has no light that counts
_BLOCK, _RIM = np.ones((3, 3), np.bool_), np.ones((5, 5), np.bool_)  # two pixels: interpolation, blur of an edge
_FEWEST = 3  # pixels of a border
_ONE_VALUE = 0.9  # of the pixels of an area, where it is not noise
_BELOW = 3.0  # standard deviations below the dark, as no camera reads
_NEGATIVE = 0.01  # of line integrals: air with noise, which is exactly 0 nowhere
_CLEARLY = 0.5  # of the mass that comes and goes, so much may be left without the post


def of_light(values: NDArray[np.generic], light: F32, hidden: Mask, foreign: Mask | None) -> Mask | None:
    """Which pixels [row, col] of a view measured nothing; None: all did.

    Args:
        values: as stored.
        light: transmission; NaN: not finite.
        hidden: areas that are masked in all views.
        foreign: bool [row], rows in which what is dark is not the sample, see `foreign_rows`; None: none.
    """
    low = ~(light > DARK)
    return _of(values, low, light, hidden, foreign) if low.any() else None


def of_line_integrals(values: F32, foreign: Mask | None) -> Mask | None:
    """As `of_light`, of a view [row, col] of line integrals. Exact zeros are air where air has no noise."""
    low = ~(values < -np.log(DARK))
    if not _corners(values).all() and (values < 0).mean() > _NEGATIVE:
        low |= values == 0
    return _of(values, low, -values, np.zeros_like(low), foreign) if low.any() else None


def _of(values: NDArray[np.generic], low: Mask, light: F32, hidden: Mask, foreign: Mask | None) -> Mask | None:
    unknown, labels = ~np.isfinite(light) & ~hidden, _at_borders(low, hidden)
    found = np.zeros_like(low) if foreign is None else (labels > 0) & foreign[:, None]
    for label in {*_corners(labels).flat} - {0}:
        part = (labels == label) & low & ~hidden & ~unknown
        given, seen = values[part], light[part]
        if given.size and (
            np.mean(given == np.median(given)) > _ONE_VALUE or seen.mean() < -_BELOW * seen.std(dtype=np.float64)
        ):
            found |= labels == label
    if found.any():
        found = ndimage.binary_dilation(found, _RIM)
    if unknown.any():
        found |= areas(unknown)
    found &= ~hidden
    return found if found.any() and not (found | hidden).all() else None


def _corners(image: NDArray[Any]) -> NDArray[Any]:
    return image[:: max(len(image) - 1, 1), :: max(image.shape[1] - 1, 1)]


def _at_borders(low: Mask, hidden: Mask) -> NDArray[np.int32]:
    """Areas [row, col] of dark pixels that reach a border of the frame, or what is hidden there, by number; 0: none."""
    if np.count_nonzero(border_of(low)) < _FEWEST:
        return np.zeros(low.shape, np.int32)
    dark = np.pad(low | hidden, 3, mode="edge")  # the outer layer goes in closing
    dark = ndimage.binary_opening(ndimage.binary_closing(dark, _BLOCK), _BLOCK)[3:-3, 3:-3]
    labels, n = ndimage.label(dark, _BLOCK)
    reached = np.zeros(n + 1, np.bool_)
    reached[border_of(labels)] = True
    reached &= np.bincount(labels[low & ~hidden], minlength=n + 1) >= _FEWEST
    reached[0] = False
    return np.where(reached[labels], labels, 0)


def foreign_rows(light: Callable[[], F32], border: F32, angles: F64, hidden: Mask) -> Mask:
    """Rows [row] whose dark areas at borders come and go, and bring more matter than the other views show there.

    Args:
        light: transmission [view, row, col], finite, of these views; asked for where borders are dark.
        border: transmission [view, pixel] at the borders of views all around, see `border_of`.
        angles: of these views, radians.
        hidden: bool [row, col], areas that are masked in all views.
    """
    if not (np.count_nonzero(~(border > DARK) & ~border_of(hidden), axis=1) >= _FEWEST).any():
        return np.zeros(len(hidden), np.bool_)
    views = light()
    dark = np.stack([_at_borders(view <= DARK, hidden) > 0 for view in views])
    there = dark.any(axis=2)
    rows = there.any(axis=0) & ~there.all(axis=0)
    some = there[:, rows].any(axis=1)
    if not rows.any() or some.all():
        return np.zeros_like(rows)
    lines = -np.log(np.maximum(views[:, rows], np.float32(DARK)))
    mass = lines.sum(axis=(1, 2), dtype=np.float64)
    for view in np.flatnonzero(some):
        fill(lines[view], plan_fill(ndimage.binary_dilation(dark[view], _RIM)[rows]))
    free = np.flatnonzero(~some)[np.argsort(angles[~some])]
    usual = np.interp(angles[some], angles[free], mass[free])
    more, less = mass[some] - usual, lines[some].sum(axis=(1, 2), dtype=np.float64) - usual
    return rows & (more.sum() > 0 and np.abs(less).sum() < _CLEARLY * np.abs(more).sum())


def without_borders(image: NDArray[Any]) -> NDArray[Any]:
    """An image of counts whose areas of exact zeros at its corners have the value of the nearest pixel beside them."""
    if (_corners(image) != 0).all():
        return image
    labels = _at_borders(image == 0, np.zeros(image.shape, np.bool_))
    found = ndimage.binary_dilation(np.isin(labels, _corners(labels)) & (labels > 0), _RIM)
    if not 0 < found.mean() < 1:
        return image
    return image[tuple(ndimage.distance_transform_edt(found, return_distances=False, return_indices=True))]


def border_of(images: NDArray[Any]) -> NDArray[Any]:
    """The pixels [..., pixel] at the borders of images [..., row, col]."""
    return np.concatenate((images[..., 0, :], images[..., -1, :], images[..., 0], images[..., -1]), axis=-1)


def boxes_of(unmeasured: Mask) -> I64:
    """Boxes [box, 4] that make up the pixels [row, col]: first row, row after the last, first column, one after it."""
    edges = np.diff(np.pad(unmeasured, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, left), right = np.nonzero(edges > 0), np.nonzero(edges < 0)[1]
    order = np.lexsort((row, right, left))
    row, left, right = row[order], left[order], right[order]
    begins = np.diff(left, prepend=-1).astype(bool) | np.diff(right, prepend=-1).astype(bool)
    first = np.flatnonzero(begins | (np.diff(row, prepend=-2) != 1))
    last = np.append(first[1:], row.size)[: first.size] - 1
    return np.stack([row[first], row[last] + 1, left[first], right[first]], axis=1).astype(np.int64)
