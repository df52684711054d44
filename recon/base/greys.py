"""Grey windows that separate the classes of a volume (air, matrix, dense material), and pictures for notebooks."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64, some_values

_SAMPLE = 200_000  # number of values in the sample
# share of the variance that two classes must explain; the two halves of one normal distribution explain 0.64
_SPLIT = 0.7
_LEAST_CLASS_SHARE = 2e-4  # smallest share of the values in a class
_MOST_CLASSES = 8  # classes
_FREQUENT = 0.03  # share of all voxels that are not air
# A class that is this many times as dense as the class below it, and this many times rarer, is shown white. Otherwise
# the class below would appear black.
_METAL, _RARER = 4.0, 0.75
_WEAK_SHARE = 0.6  # share of the upper end of the material window
_BEYOND = 0.1  # share of the window, added below air and above the densest class shown
_DARKER, _BRIGHTER = 2.0, 98.0  # percentiles of a class that still belong to the window
_ALL = (0.05, 99.95)


def class_levels(values: NDArray[np.floating]) -> list[NDArray[np.floating]]:
    """An ascending sample of the finite values, split into classes by thresholds.

    A class is divided if two parts explain most of its variance (Otsu 1979, IEEE Trans. Syst. Man Cybern. 9, 62). Each
    part is divided in the same way.
    """
    flat = np.sort(some_values(np.asarray(values), _SAMPLE))
    flat = flat[np.isfinite(flat)].astype(np.float64)
    least = max(4, round(_LEAST_CLASS_SHARE * flat.size))
    classes, splits = [flat], [_split(flat, least)]
    while len(classes) < _MOST_CLASSES and max(gain for gain, _ in splits) > 0:
        best = max(range(len(splits)), key=lambda k: splits[k][0])
        split_index = splits[best][1]
        parts = [classes[best][:split_index], classes[best][split_index:]]
        classes[best : best + 1], splits[best : best + 1] = parts, [_split(part, least) for part in parts]
    return classes


def _split(ascending: NDArray[np.float64], least: int) -> tuple[float, int]:
    """The sum of squares that a division into two classes explains, and the number of values in the lower class (0: no
    division)."""
    n = ascending.size
    candidates = least + np.flatnonzero(ascending[least : n - least + 1] > ascending[least - 1 : n - least])
    if n < 2 * least or not candidates.size:
        return 0.0, 0
    centred = ascending - ascending.mean()
    lower = np.cumsum(centred)[candidates - 1]
    squares_between = lower**2 / candidates + lower**2 / (n - candidates)  # the sum of all is 0
    best = int(squares_between.argmax())
    gain = float(squares_between[best])
    return (gain, int(candidates[best])) if gain > _SPLIT * float(centred @ centred) else (0.0, 0)


def grey_windows(values: NDArray[np.floating]) -> dict[str, tuple[float, float]]:
    """Grey windows (low, high) of a volume by name, the preferred one first.

    "matter" reaches from air to the densest class that leaves the class below it bright enough to be seen. "weak"
    reaches from air to the least dense class, or, if that class is only a metal pin, to the rest of the values. "weak"
    is left out if it equals "matter". "all" contains all values except half a per mille at each end.
    """
    classes = [each for each in class_levels(values) if each.size]
    if not classes:
        return {"matter": (0.0, 1.0), "all": (0.0, 1.0)}
    frequent = _FREQUENT * sum(each.size for each in classes[1:])  # rarer classes are edges between materials
    materials = [each for number, each in enumerate(classes) if number == 0 or each.size >= frequent]
    levels, sizes = [float(np.median(each)) for each in materials], [each.size for each in materials]
    has_metal = len(levels) > 2 and levels[-1] - levels[0] > _METAL * (levels[-2] - levels[0])
    top = len(levels) - 1 - (has_metal and sizes[-1] < _RARER * sum(sizes[1:-1]))

    def window(top: int) -> tuple[float, float]:
        low, high = float(np.percentile(materials[0], _DARKER)), float(np.percentile(materials[top], _BRIGHTER))
        if top > 0:
            low = max(low, levels[0] - _BEYOND * (high - levels[0]))
        return apart(low, high + _BEYOND * (high - levels[top]))

    windows, rare = {"matter": window(top)}, sum(map(len, classes[1:])) < _FREQUENT * sum(map(len, classes))
    if (top > 1 or rare) and (weak := window(0 if rare else 1))[1] < _WEAK_SHARE * windows["matter"][1]:
        windows["weak"] = weak
    low, high = np.percentile(np.concatenate(classes), _ALL).tolist()
    return windows | {"all": apart(low, high)}


def material_window(*arrays: NDArray[np.floating]) -> tuple[float, float]:
    """The window "matter" of all these values together, see `grey_windows`."""
    return grey_windows(np.concatenate([np.ravel(array) for array in arrays]))["matter"]


def apart(low: float, high: float) -> tuple[float, float]:
    """The two ends of a range. If all values are equal, the ends are moved apart."""
    return low, max(high, low + 1e-6 * max(abs(low), 1e-3))


U8 = NDArray[np.uint8]
_SIDE = 256  # pixels of a slice's longer side, at most
_GAP = 4  # pixels between slices


def html(title: str, pixels: U8, facts: Mapping[str, str]) -> str:
    """A title, a grey picture [row, col], and facts by name."""
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts.items())
    image = base64.b64encode(png(pixels)).decode()
    return (
        f'<div><b>{escape(title)}</b><br><img alt="{escape(title)}" src="data:image/png;base64,{image}"/>'
        f"<table>{rows}</table></div>"
    )


def png(pixels: U8) -> bytes:
    """A grey picture [row, col] as PNG."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def middle_slices(data: NDArray[np.float32]) -> tuple[U8, tuple[float, float]]:
    """The middle slices across z, y and x of a volume [z, y, x], side by side, and the values of black and white.

    y and z point downwards. Long sides are thinned out to 256 voxels; values that are not finite are black.
    """
    nz, ny, nx = data.shape
    step = -(-max(data.shape) // _SIDE)
    slices = [data[nz // 2, ::step, ::step], data[::step, ny // 2, ::step], data[::step, ::step, nx // 2]]
    parts = [np.asarray(part, np.float64) for part in slices]
    low, high = material_window(np.concatenate([part[np.isfinite(part)] for part in parts]))
    sheet = np.full((max(len(part) for part in parts), sum(part.shape[1] for part in parts) + 2 * _GAP), 255, np.uint8)
    first_column = 0
    for part in parts:
        sheet[: len(part), first_column : first_column + part.shape[1]] = _within(part, low, high)
        first_column += part.shape[1] + _GAP
    return sheet, (low, high)


def grey(image: NDArray[Any]) -> tuple[U8, tuple[float, float]]:
    """An image [row, col] thinned out to at most 256 pixels a side, and its values of black and white. Half a per mille
    of the pixels is below black, and half a per mille above white. Values that are not finite are black.
    """
    step = -(-max(image.shape) // _SIDE)
    thin = np.asarray(image[::step, ::step], np.float64)
    finite = thin[np.isfinite(thin)]
    low, high = apart(*np.percentile(finite, _ALL).tolist()) if finite.size else (0.0, 1.0)
    return _within(thin, low, high), (low, high)


def _within(values: F64, low: float, high: float) -> U8:
    """Greys of values between black and white; values that are not finite are black."""
    with np.errstate(invalid="ignore"):
        grey = 255 * np.clip((values - low) / (high - low), 0, 1)
    return np.nan_to_num(grey).astype(np.uint8)


def fan(angles: NDArray[np.float64], centre: float) -> U8:
    """Directions of the projections, drawn as dark lines through the rotation axis; x to the right, y downwards.

    Args:
        angles: [view] radians.
        centre: position of the axis on the detector, 0 at its left edge, 1 at its right edge; drawn below.
    """
    radius, side = _SIDE // 4, _SIDE // 2
    sheet = np.full((side + 12, side), 255, np.uint8)
    distances = np.linspace(0.25, 0.95, side) * (radius - 1)
    rows = np.rint(radius + np.cos(angles)[:, None] * distances).astype(int)
    cols = np.rint(radius - np.sin(angles)[:, None] * distances).astype(int)
    sheet[rows, cols] = 60
    sheet[side + 4 : side + 8] = 190
    if 0 <= centre <= 1:
        sheet[side + 1 : side + 11, round(centre * (side - 1))] = 0
    return sheet
