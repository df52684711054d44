"""render and moments: footprints to an image, and an image gradient to six moments a footprint (numba, threaded).

    pixel = Σ_i W_i G_i,   G = exp(E),   E = -1/2 δᵀ K δ = k τ² + l δv²,   τ = δu - r δv
    M₀ = Σ g G,   M₁ = Σ g G ε,   M₂ = Σ g G εεᵀ,   ε = (τ, δv)

with δ the offset in pixels and g the gradient of the image: every Gaussian gathers its own gradient, without atomics. τ
is the offset along a row from the axis of a slanted footprint; in moments of δ itself the thin side of a needle would
be a small difference of large sums.

E is a parabola along a column, so G follows from the row above by two products, with factors that are the exponentials
of E's first and second difference:

    G(δv + 1) = G(δv) Q(δv),   ln Q = k r (r - 2 (δu - r δv)) + l (2 δv + 1)
    Q(δv + 1) = Q(δv) q,       ln q = 2 (k r² + l)

Errors grow with the rows, so G is computed directly after every `ANCHOR` rows. A long slanted footprint may start so
far down its flank that float32 underflows: where the first row would begin below exp(-DEEPEST), every pixel gets an
exponential of its own, in the few columns of each row that lie within the footprint.

Images are summed over threads in a fixed order: the result is equal to the bit for the same number of threads, and
equal up to rounding for another. Each thread sums in two levels, `MANY` footprints and then these sums: adding equal
float32 numbers one by one loses a part that grows with their number (half a percent for a million).
"""

from __future__ import annotations

import numpy as np
from numba import get_num_threads, njit, prange

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.footprints import HU, HV, KV, SHEAR, K, U, V, W

_f = np.float32
GROUP = 4  # rows are processed four at a time: branches on the exact count cost more than the extra rows
ANCHOR = 16  # rows of one recurrence; its error stays below 1e-5 of the footprint's weight
MANY = 512  # footprints in one sum
DEEPEST = 60.0  # largest -E at which the recurrence may start


@njit(inline="always", fastmath=True)
def _box(table, i, rows, cols, height):  # type: ignore[no-untyped-def]
    """Pixel box of footprint i, clipped to the image: (row0, row1, col0, col1), ends excluded; empty if outside.

    The number of rows is a multiple of `GROUP`; they stay within `height`, which is such a multiple and >= `rows`.
    """
    hu, hv = table[i, HU], table[i, HV]
    u, v = table[i, U], table[i, V]
    last_row, last_col = _f(rows - 1), _f(cols - 1)
    if not (hu >= 0 and u + hu >= 0 and u - hu <= last_col and v + hv >= 0 and v - hv <= last_row):
        return 0, 0, 0, 0
    # Clip as floats and round by conversion: math.ceil and floor are calls here, as slow as everything else together.
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
def _is_smooth(table, i, row0):  # type: ignore[no-untyped-def]
    """Whether the recurrence over rows is accurate: -E stays below DEEPEST at all pixels of the box."""
    down = max(table[i, V] - _f(row0), table[i, HV])
    across = table[i, HU] + abs(table[i, SHEAR]) * down
    return table[i, K] * across * across + table[i, KV] * down * down < _f(2 * DEEPEST)


@njit(inline="always", fastmath=True)
def _start(table, i, dx, dy):  # type: ignore[no-untyped-def]
    """G, Q and q of a row, for the lanes at column offsets dx."""
    k, shear, kv = _f(-0.5) * table[i, K], table[i, SHEAR], _f(-0.5) * table[i, KV]
    across = dx - shear * dy
    value = lanes.exp(across * across * k + kv * dy * dy)
    factor = lanes.exp((across * _f(-2) + shear) * (k * shear) + kv * (_f(2) * dy + _f(1)))
    return value, factor, lanes.exp(lanes.zero() + _f(2) * (k * shear * shear + kv))


@njit(inline="always", fastmath=True)
def _span(table, i, dy, col0, col1):  # type: ignore[no-untyped-def]
    """Columns of one row that lie within the footprint: (first, last + 1), inside its box."""
    reach = table[i, HV] * np.sqrt(table[i, KV])
    half = np.sqrt(max(reach * reach - table[i, KV] * dy * dy, _f(0)) / table[i, K]) + _f(0.5)
    middle = table[i, U] + table[i, SHEAR] * dy
    low, high = max(middle - half, _f(col0)), min(middle + half, _f(col1 - 1))
    return int(min(low, _f(col1))), int(max(high, _f(-1))) + 1


@njit(inline="always", fastmath=True)
def _at(table, i, first, dy):  # type: ignore[no-untyped-def]
    """τ of the lanes from `first` on, and G there."""
    dx = lanes.iota() + (_f(first) - table[i, U])
    across = dx - table[i, SHEAR] * dy
    return across, lanes.exp(across * across * (_f(-0.5) * table[i, K]) + _f(-0.5) * table[i, KV] * dy * dy)


@njit(fastmath=True, error_model="numpy")
def _add_by_pixels(table, i, row0, row1, col0, col1, image):  # type: ignore[no-untyped-def]
    """Add footprint i to the image, with an exponential for each pixel."""
    for row in range(row0, row1):
        dy = _f(row) - table[i, V]
        low, high = _span(table, i, dy, col0, col1)
        for start in range(low, high, lanes.WIDTH):
            first = min(start, image.shape[1] - lanes.WIDTH)
            _, value = _at(table, i, first, dy)
            value = lanes.between(value * table[i, W], start - first, high - first)
            lanes.store(image, row, first, lanes.load(image, row, first) + value)


@njit(fastmath=True, error_model="numpy")
def _gather_by_pixels(table, i, row0, row1, col0, col1, gradient, moments):  # type: ignore[no-untyped-def]
    """Moments of the gradient under footprint i, with an exponential for each pixel."""
    m0, mt, mv = lanes.zero(), lanes.zero(), lanes.zero()
    mtt, mtv, mvv = lanes.zero(), lanes.zero(), lanes.zero()
    for row in range(row0, row1):
        dy = _f(row) - table[i, V]
        low, high = _span(table, i, dy, col0, col1)
        for start in range(low, high, lanes.WIDTH):
            first = min(start, gradient.shape[1] - lanes.WIDTH)
            across, value = _at(table, i, first, dy)
            value = lanes.between(value, start - first, high - first)
            here = lanes.load(gradient, row, first) * value
            aside, rise = here * across, here * dy
            m0, mt, mv = m0 + here, mt + aside, mv + rise
            mtt, mtv, mvv = mtt + aside * across, mtv + aside * dy, mvv + rise * dy
    lanes.store_first(moments, i, 0, lanes.totals((m0, mt, mv, mtt, mtv, mvv)), 6)


@njit(inline="always", fastmath=True)
def add_footprint(table, i, rows, cols, image):  # type: ignore[no-untyped-def]
    """Add footprint i to an image of rows x cols in an array of its `padded_shape`; returns the rows of its box."""
    height, width = image.shape
    row0, row1, col0, col1 = _box(table, i, rows, cols, height)
    weight = table[i, W]
    if _is_smooth(table, i, row0):
        for start in range(col0, col1, lanes.WIDTH):
            first = min(start, width - lanes.WIDTH)
            dx = lanes.iota() + (_f(first) - table[i, U])
            for anchor in range(row0, row1, ANCHOR):
                value, factor, change = _start(table, i, dx, _f(anchor) - table[i, V])
                value = lanes.between(value * weight, start - first, col1 - first)
                for group in range(anchor, min(row1, anchor + ANCHOR), GROUP):
                    for step in range(GROUP):
                        row = group + step
                        lanes.store(image, row, first, lanes.load(image, row, first) + value)
                        value = value * factor
                        factor = factor * change
    else:
        _add_by_pixels(table, i, row0, row1, col0, col1, image)
    return row0, row1


@njit(inline="always", fastmath=True)
def gather_footprint(table, i, rows, cols, gradient, moments):  # type: ignore[no-untyped-def]
    """Fill moments [i] of a gradient of rows x cols in an array of its `padded_shape`, with G of weight 1."""
    height, width = gradient.shape
    row0, row1, col0, col1 = _box(table, i, rows, cols, height)
    if _is_smooth(table, i, row0):
        m0, mt, mv = lanes.zero(), lanes.zero(), lanes.zero()
        mtt, mtv, mvv = lanes.zero(), lanes.zero(), lanes.zero()
        shear = table[i, SHEAR]
        for start in range(col0, col1, lanes.WIDTH):
            first = min(start, width - lanes.WIDTH)
            dx = lanes.iota() + (_f(first) - table[i, U])
            s0, s1, s2 = lanes.zero(), lanes.zero(), lanes.zero()
            for anchor in range(row0, row1, ANCHOR):
                value, factor, change = _start(table, i, dx, _f(anchor) - table[i, V])
                value = lanes.between(value, start - first, col1 - first)
                for group in range(anchor, min(row1, anchor + ANCHOR), GROUP):
                    dy = _f(group) - table[i, V]
                    for step in range(GROUP):
                        here = lanes.load(gradient, group + step, first) * value
                        rise = here * (dy + _f(step))
                        s0, s1, s2 = s0 + here, s1 + rise, s2 + rise * (dy + _f(step))
                        value = value * factor
                        factor = factor * change
            # `_is_smooth` limits the slant, so that these differences lose three digits at most.
            t0, t1 = dx * s0 - shear * s1, dx * s1 - shear * s2
            m0, mt, mv = m0 + s0, mt + t0, mv + s1
            mtt, mtv, mvv = mtt + (dx * t0 - shear * t1), mtv + t1, mvv + s2
        lanes.store_first(moments, i, 0, lanes.totals((m0, mt, mv, mtt, mtv, mvv)), 6)
    else:
        _gather_by_pixels(table, i, row0, row1, col0, col1, gradient, moments)


@njit(inline="always", fastmath=True)
def _join(fresh, image, row0, row1):  # type: ignore[no-untyped-def]
    """Add rows of `fresh` to the image and set them to zero."""
    for row in range(row0, row1):
        for col in range(image.shape[1]):
            image[row, col] += fresh[row, col]
            fresh[row, col] = _f(0)


@njit(**OPTIONS)
def _render(table: F32, rows: int, cols: int, layers: F32) -> None:
    n, threads = table.shape[0], layers.shape[0] // 2
    share = (n + threads - 1) // threads
    for t in prange(threads):
        image, fresh = layers[t], layers[threads + t]
        image[:] = _f(0)
        fresh[:] = _f(0)
        end = min(n, (t + 1) * share)
        for start in range(t * share, end, MANY):
            row0, row1 = layers.shape[1], 0
            for i in range(start, min(end, start + MANY)):
                first, last = add_footprint(table, i, rows, cols, fresh)
                if last > first:
                    row0, row1 = min(row0, first), max(row1, last)
            _join(fresh, image, row0, row1)


@njit(**OPTIONS)
def _sum_layers(layers: F32, image: F32) -> None:
    for row in prange(image.shape[0]):
        for col in range(image.shape[1]):
            value = layers[0, row, col]
            for t in range(1, layers.shape[0] // 2):
                value += layers[t, row, col]
            image[row, col] = value


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


def render_layers(rows: int, cols: int) -> F32:
    """Scratch of two images a thread, [2 thread, row, col]; it can be reused for any number of renderings."""
    return np.empty((2 * get_num_threads(), *padded_shape(rows, cols)), np.float32)


def render(table: F32, image: F32, layers: F32 | None = None) -> None:
    """Sum the footprints of `table` into image [row, col] (overwritten); `layers`: scratch, see `render_layers`."""
    rows, cols = image.shape
    scratch = render_layers(rows, cols) if layers is None else layers
    _render(table, rows, cols, scratch)
    _sum_layers(scratch, image)


@njit(**OPTIONS)
def _moments(table: F32, gradient: F32, rows: int, cols: int, moments: F32) -> None:
    for i in prange(table.shape[0]):
        gather_footprint(table, i, rows, cols, gradient, moments)


def moments(table: F32, gradient: F32, result: F32 | None = None) -> F32:
    """Moments [n, 6] (1, τ, v, ττ, τv, vv) of the image gradient [row, col] under each footprint, in `result` if given.

    The gradient is copied unless it is C-contiguous and has its `padded_shape`.
    """
    rows, cols = gradient.shape
    found = np.empty((table.shape[0], 6), np.float32) if result is None else result
    _moments(table, padded(gradient), rows, cols, found)
    return found
