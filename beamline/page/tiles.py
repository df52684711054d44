"""Tiles: parts of a picture, binned to the resolution of the screen and packed as 16-bit numbers; and the web responses
that contain tiles.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import Response

from beamline.core.errors import DataError
from beamline.core.events import json_of
from beamline.monitor.view import BRIGHT, UNLIT

MOST = 1024
"""Largest number of pixels of a tile along an axis."""
_GREATEST = 65535


@dataclass(frozen=True)
class TileRegion:
    """Half-open rows and columns of a picture."""

    first_row: int
    last_row: int
    first_col: int
    last_col: int

    def inside(self, shape: tuple[int, int]) -> TileRegion:
        """The part of the region that is inside a picture of this shape, but at least one pixel."""
        rows, cols = shape
        first_row, first_col = min(max(self.first_row, 0), rows - 1), min(max(self.first_col, 0), cols - 1)
        last_row, last_col = min(max(self.last_row, first_row + 1), rows), min(max(self.last_col, first_col + 1), cols)
        return TileRegion(first_row, last_row, first_col, last_col)

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.first_row, self.last_row), slice(self.first_col, self.last_col)

    def binning(self) -> int:
        """The smallest binning that leaves at most MOST pixels along each axis."""
        return max(1, -(-max(self.last_row - self.first_row, self.last_col - self.first_col) // MOST))


def bin_mean(pixels: NDArray[Any], factors: tuple[int, int]) -> NDArray[np.float32]:
    """Means of blocks of pixels, rows x columns. At the last row and column, the remaining pixels make smaller
    blocks."""
    if factors == (1, 1):
        return pixels.astype(np.float32)
    (rows, cols), (down, across) = pixels.shape, factors
    if rows % down == cols % across == 0:  # this takes a third of the time
        blocks = pixels.reshape(rows // down, down, cols // across, across)
        return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
    starts = [np.arange(0, n, factor) for n, factor in zip(pixels.shape, factors, strict=True)]
    sums = np.add.reduceat(np.add.reduceat(pixels.astype(np.float32), starts[0], 0), starts[1], 1)
    counts = [np.minimum(factor, n - first) for n, factor, first in zip(pixels.shape, factors, starts, strict=True)]
    return np.asarray(sums / np.outer(*counts), np.float32)


def lit(flat: NDArray[np.float32], dark: NDArray[np.float32] | float) -> NDArray[np.float32]:
    """The flat with NaN in pixels without intensity, for example behind slits, because ratios there are noise."""
    intensity = flat - dark
    return np.where(intensity > UNLIT * np.nanpercentile(intensity, BRIGHT), flat, np.float32(np.nan))


@dataclass(frozen=True, eq=False)
class PackedValues:
    """Values as 16-bit unsigned numbers [row, col]. A value is offset + scale * number; 65535 stands for a value that
    is not finite."""

    numbers: NDArray[np.uint16]
    offset: float
    scale: float


def pack(values: NDArray[np.float32]) -> PackedValues:
    """Pack values in 65534 steps from the smallest to the largest value."""
    finite = np.isfinite(values)
    low, high = (float(values[finite].min()), float(values[finite].max())) if finite.any() else (0.0, 0.0)
    scale = (high - low) / (_GREATEST - 1) or 1.0
    numbers = np.rint((np.where(finite, values, low) - np.float32(low)) / np.float32(scale))
    return PackedValues(np.where(finite, np.clip(numbers, 0, _GREATEST - 1), _GREATEST).astype("<u2"), low, scale)


def tile_of(values: Any, facts: dict[str, Any]) -> Response:
    """The length of the header as a 32-bit number, the header in JSON, and the numbers of `pack`."""
    packed = pack(values)
    head = json_of({**facts, "shape": packed.numbers.shape, "offset": packed.offset, "scale": packed.scale})
    padded = head.encode() + b" " * (-len(head.encode()) % 4)
    body = len(padded).to_bytes(4, "little") + padded + packed.numbers.tobytes()
    return Response(body, media_type="application/octet-stream")


class _Number(IntegerConvertor):
    """Pattern of an integer in a path. A number with more digits cannot exist here."""

    regex = "[0-9]{1,9}"


register_url_convertor("number", _Number())


def number_of(request: Request, name: str) -> int:
    """Parse an integer of a query; 0 for any other text."""
    given = request.query_params.get(name, "0")
    return int(given) if given.isdecimal() and len(given) < 10 else 0


def numbers_of(request: Request, name: str, n: int, what: str) -> list[float]:
    """Parse `n` real numbers of a query. Raises DataError, naming the expected `what`, for any other text."""
    with suppress(ValueError):
        numbers = [float(word) for word in request.query_params.get(name, "").split(",")]
        if len(numbers) == n and all(abs(each) < 1e6 for each in numbers):
            return numbers
    raise DataError(f"{name}={what} is missing in the query.")


def region_of(request: Request) -> TileRegion:
    """Parse `region=first_row,last_row,first_col,last_col`; the whole picture for any other text."""
    edges = request.query_params.get("region", "").split(",")
    if len(edges) == 4 and all(edge.isdecimal() and len(edge) < 10 for edge in edges):
        return TileRegion(*map(int, edges))
    return TileRegion(0, 10**9, 0, 10**9)
