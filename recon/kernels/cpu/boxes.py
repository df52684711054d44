"""Boxes: the pixels that a footprint covers, the shape of arrays for rows of lanes, and where sums are accurate."""

from __future__ import annotations

import numpy as np
from numba import njit

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32
from recon.kernels.cpu.footprints import HU, HV, KV, SHEAR, K, U, V

_f = np.float32
GROUP = 4  # rows are processed four at a time, because branches on the exact count cost more than the extra rows
DEEPEST = 60.0  # largest -E of an upright enough footprint, E = -1/2 δᵀ K δ


@njit(inline="always", fastmath=True)
def box_of(table, i, rows, cols, height):
    """Pixel box of footprint i, clipped to the image: (row0, row1, col0, col1), ends excluded; empty if outside.

    The number of rows is a multiple of `GROUP`. The rows are within `height`, which is also a multiple and >= `rows`.
    """
    hu, hv = table[i, HU], table[i, HV]
    u, v = table[i, U], table[i, V]
    last_row, last_col = _f(rows - 1), _f(cols - 1)
    if not (hu >= 0 and u + hu >= 0 and u - hu <= last_col and v + hv >= 0 and v - hv <= last_row):
        return 0, 0, 0, 0
    # Clip as floats and round by conversion, because math.ceil and floor are calls here, as slow as all the rest
    # together.
    top, left = max(v - hv, _f(0)), max(u - hu, _f(0))
    row0, col0 = int(top), int(left)
    row0, col0 = row0 + (_f(row0) < top), col0 + (_f(col0) < left)
    row1, col1 = int(min(v + hv, last_row)) + 1, int(min(u + hu, last_col)) + 1
    if row1 <= row0 or col1 <= col0:
        return 0, 0, 0, 0
    count = (row1 - row0 + GROUP - 1) // GROUP * GROUP
    row0 = min(row0, height - count)
    return row0, row0 + count, col0, col1


@njit(inline="always", fastmath=True)
def is_upright(table, i, row0):
    """Whether sums over the rows of a column are accurate: -E stays below DEEPEST at all pixels of the box."""
    down = max(table[i, V] - _f(row0), table[i, HV])
    across = table[i, HU] + abs(table[i, SHEAR]) * down
    return table[i, K] * across * across + table[i, KV] * down * down < _f(2 * DEEPEST)


@njit(inline="always", fastmath=True)
def span_of(table, i, dy, col0, col1):
    """Columns of one row that lie within the footprint: (first, last + 1), inside the box of the footprint."""
    reach = table[i, HV] * np.sqrt(table[i, KV])
    half = np.sqrt(max(reach * reach - table[i, KV] * dy * dy, _f(0)) / table[i, K]) + _f(0.5)
    middle = table[i, U] + table[i, SHEAR] * dy
    low, high = max(middle - half, _f(col0)), min(middle + half, _f(col1 - 1))
    return int(min(low, _f(col1))), int(max(high, _f(-1))) + 1


def padded_shape(rows: int, cols: int) -> tuple[int, int]:
    """The smallest shape >= (rows, cols) of whole groups of rows and at least sixteen columns."""
    return -(-rows // GROUP) * GROUP, max(cols, lanes.WIDTH)


def padded(images: F32) -> F32:
    """Images [..., row, col] padded with zeros to their `padded_shape`; copied only if necessary."""
    rows, cols = images.shape[-2:]
    shape = padded_shape(rows, cols)
    if shape == (rows, cols):
        return np.ascontiguousarray(images)
    result = np.zeros((*images.shape[:-2], *shape), np.float32)
    result[..., :rows, :cols] = images
    return result
