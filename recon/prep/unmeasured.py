"""Pixels without data: finds the pixels of a projection that contain no data, and distinguishes them from a dark
sample.

There are three kinds. (1) Pixels that are not finite. (2) Pixels at the border of an image that was shifted or rotated;
they have a single value and include a corner of the frame. (3) An opaque object that is not the sample and reaches a
border, such as the post of a load frame. Metal in the sample is equally dark, but the metal stays within the field of
view: a row shows the metal in all projections, or the total absorption stays the same when the metal becomes dark. A
post comes and goes, and adds absorption.
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
DARK = 0.01  # transmission below which a pixel counts as dark
_BLOCK = np.ones((3, 3), np.bool_)
# number of pixels next to an area that interpolation or blur may change; number of pixels beyond them, for comparison
_RIM, _BEYOND = 4, 3
# a rim differs from the pixels beyond it by at least this share of the intensity, and this many standard errors
_ALTERED, _SURE = 0.02, 3.0
_FEWEST = 3  # smallest number of dark pixels, at a border and in an area
# share of the pixels of an area that must be dark; share that must have a single value, if they are not noise
_ONE_VALUE = 0.9
_BELOW = 3.0  # standard deviations below the dark; no camera gives such low values
_CLEARLY = 0.5  # share of the change of the absorption that may remain without the post


def unmeasured(values: NDArray[np.generic], intensity: F32, hidden: Mask, foreign: Mask | None) -> Mask | None:
    """Mask [row, col] of the pixels of a projection that have no data. None: no pixel, or all pixels, have no data.

    Args:
        values: pixel values as stored.
        intensity: transmission; NaN: not finite.
        hidden: areas that are masked in all projections.
        foreign: bool [row], rows in which dark pixels do not show the sample, see `foreign_rows`. None: there are no
            such rows.
    """
    if intensity.min() > DARK:  # false for NaN
        return None
    low = ~(intensity > DARK)
    unknown = low & ~np.isfinite(intensity) & ~hidden
    if not (_corners(low).any() or (foreign is not None and foreign.any()) or unknown.any()):
        return None
    labels, without_data = _dark_areas_at_borders(low, hidden), np.zeros_like(low)
    for label in {*_corners(labels).flat} - {0}:
        part = (labels == label) & low & ~hidden & ~unknown
        solid = np.mean((low | hidden)[labels == label]) > _ONE_VALUE
        stored_values, transmissions = values[part], intensity[part].astype(np.float64)
        if (
            part.any()
            and solid
            and (
                np.mean(stored_values == np.median(stored_values)) > _ONE_VALUE
                or transmissions.mean() < -_BELOW * transmissions.std()
            )
        ):
            without_data |= labels == label
    if foreign is not None:
        without_data |= (labels > 0) & foreign[:, None]
    without_data = with_rim(without_data & ~hidden, np.where(hidden, np.float32(np.nan), intensity)) | areas(unknown)
    without_data &= ~hidden
    return without_data if without_data.any() and not (without_data | hidden).all() else None


def with_rim(dark: Mask, intensity: F32) -> Mask:
    """Dark areas [row, col], extended on their four sides by the pixels whose intensity is mixed with the dark area.

    Blur, or interpolation in a shift, mixes the intensities at an edge. The median of the pixels next to the edge then
    differs from a straight line through the logarithms of the next three pixels. The test is repeated outwards. If rows
    were not read, or the shift is by whole pixels, the next pixel is not affected.

    Args:
        intensity: transmission [row, col]; NaN: unknown.
    """
    extended, distances = dark.copy(), np.arange(1, _RIM + _BEYOND + 1)
    lines = np.pad(np.where(dark, np.nan, np.log(np.maximum(intensity, DARK))), distances[-1], mode="edge")
    for quarter_turns in range(4):
        area, known = np.rot90(extended, quarter_turns), np.rot90(lines, quarter_turns)
        row, col = np.nonzero(area[:, :-1] & ~area[:, 1:])
        beside, reach = known[distances[-1] + row[:, None], distances[-1] + col[:, None] + distances], 0
        while row.size and reach < _RIM and _mixed(beside[:, reach : reach + 1 + _BEYOND]):
            reach += 1
            area[row, np.minimum(col + reach, area.shape[1] - 1)] = True
    return extended


def _mixed(lines: F64) -> bool:
    """Whether the first of adjacent pixels [edge, pixel] is darker than an extrapolation of the other pixels (in
    logarithms)."""
    lines = lines[np.isfinite(lines).all(axis=1)]
    if not len(lines):
        return True
    farther = lines[:, 1:]
    steps = (farther[:, -1] - farther[:, 0]) / (_BEYOND - 1)
    deviations = lines[:, 0] - farther.mean(axis=1) + steps * (_BEYOND + 1) / 2
    middle = np.median(deviations)
    return bool(abs(middle) > max(_ALTERED, _SURE * median_deviation(deviations - middle) / np.sqrt(len(deviations))))


def foreign_rows(intensity: F32, angles: F64) -> Mask:
    """Rows [row] whose dark areas at borders come and go, and have more absorption than the other projections show.

    Args:
        intensity: transmission [view, row, col], finite, of projections from all directions.
        angles: their angles in radians.
    """
    exposed = (intensity > DARK).any(axis=(1, 2))
    intensity, angles = intensity[exposed], angles[exposed]
    if not exposed.any():
        return np.zeros(intensity.shape[1], np.bool_)
    dark: Mask = np.stack(
        [_dark_areas_at_borders(view <= DARK, np.zeros(view.shape, np.bool_)) > 0 for view in intensity]
    )
    has_dark: Mask = np.any(dark, axis=2)
    rows = has_dark.any(axis=0) & ~has_dark.all(axis=0)
    with_dark = has_dark[:, rows].any(axis=1)
    if with_dark.all() or not with_dark.any():
        return np.zeros_like(rows)
    lines = -np.log(np.maximum(intensity[:, rows], np.float32(DARK)))
    mass = lines.sum(axis=(1, 2), dtype=np.float64)
    for view in np.flatnonzero(with_dark):
        hidden = with_rim(dark[view], intensity[view])[rows]
        if hidden.all():
            lines[view] = 0
        else:
            fill(lines[view], plan_fill(hidden))
    without_dark = np.flatnonzero(~with_dark)[np.argsort(angles[~with_dark])]
    expected_mass = np.interp(angles[with_dark], angles[without_dark], mass[without_dark])
    added_mass, remaining_mass = (
        mass[with_dark] - expected_mass,
        lines[with_dark].sum(axis=(1, 2), dtype=np.float64) - expected_mass,
    )
    return rows & (added_mass.sum() > 0 and np.abs(remaining_mass).sum() < _CLEARLY * np.abs(added_mass).sum())


def with_borders_filled(image: NDArray[Any]) -> NDArray[Any]:
    """An image of counts in which areas of exact zeros at the corners get the value of the nearest other pixel."""
    if (_corners(image) != 0).all():
        return image
    labels = _dark_areas_at_borders(image == 0, np.zeros(image.shape, np.bool_))
    blank = ndimage.binary_dilation(np.isin(labels, _corners(labels)) & (labels > 0), _BLOCK, 2)
    nearest = ndimage.distance_transform_edt(blank, return_distances=False, return_indices=True)
    return image if blank.all() else image[tuple(nearest)]


def runs_of(mask: Mask, view: int) -> I64:
    """Runs [run, 4] of masked pixels. The four numbers are the projection, the row, the first column, and the column
    after the last."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, first), end = np.nonzero(edges > 0), np.nonzero(edges < 0)[1]
    return np.stack([np.full(row.size, view), row, first, end], axis=1).astype(np.int64)


def _dark_areas_at_borders(low: Mask, hidden: Mask) -> NDArray[np.int32]:
    """Numbered areas [row, col] of dark pixels that reach a border of the frame or a hidden area there; 0: no area."""
    if sum(np.count_nonzero(side) for side in (low[0], low[-1], low[:, 0], low[:, -1])) < _FEWEST:
        return np.zeros(low.shape, np.int32)
    dark = np.pad(low | hidden, 3, mode="edge")  # closing removes the outer layer
    solid = ndimage.binary_opening(ndimage.binary_closing(dark, _BLOCK), _BLOCK)[3:-3, 3:-3]
    # single rows count, too
    labels, n = ndimage.label(solid | (low & (low.mean(axis=1) > _ONE_VALUE)[:, None]), _BLOCK)
    at_border = np.unique(np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1])))
    large = np.bincount(labels[low & ~hidden], minlength=n + 1) >= _FEWEST
    return np.where(np.isin(labels, at_border[at_border > 0]) & large[labels], labels, 0)


def _corners(image: NDArray[Any]) -> NDArray[Any]:
    return image[:: max(len(image) - 1, 1), :: max(image.shape[1] - 1, 1)]
