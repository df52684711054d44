"""Pictures of values in a notebook: three slices of a volume, the views of a geometry, as a PNG within HTML."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

from recon.base.greys import matter_window

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
    values = np.concatenate([part[np.isfinite(part)] for part in parts])
    low, high = matter_window(values)
    sheet = np.full((max(len(part) for part in parts), sum(part.shape[1] for part in parts) + 2 * _GAP), 255, np.uint8)
    left = 0
    for part in parts:
        with np.errstate(invalid="ignore"):
            grey = 255 * np.clip((part - low) / (high - low), 0, 1)
        sheet[: len(part), left : left + part.shape[1]] = np.nan_to_num(grey).astype(np.uint8)
        left += part.shape[1] + _GAP
    return sheet, (low, high)


def fan(angles: NDArray[np.float64], centre: float) -> U8:
    """Directions of the rays of views, as dark lines through the rotation axis; x to the right, y downwards.

    Args:
        angles: [view] radians.
        centre: where the axis falls on the detector, from 0 at its left to 1 at its right edge; drawn below.
    """
    half, side = _SIDE // 4, _SIDE // 2
    sheet = np.full((side + 12, side), 255, np.uint8)
    away = np.linspace(0.25, 0.95, side) * (half - 1)
    rows = np.rint(half + np.cos(angles)[:, None] * away).astype(int)
    cols = np.rint(half - np.sin(angles)[:, None] * away).astype(int)
    sheet[rows, cols] = 60
    sheet[side + 4 : side + 8] = 190
    if 0 <= centre <= 1:
        sheet[side + 1 : side + 11, round(centre * (side - 1))] = 0
    return sheet
