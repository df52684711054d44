"""render and moments: footprints to an image, and an image gradient to six moments a footprint (numba, threaded).

    pixel = Σ_i W_i G_i,   G = exp(E),   E = -1/2 δᵀ K δ = k τ² + l δv²,   τ = δu - r δv
    M₀ = Σ g G,   M₁ = Σ g D ε,   M₂ = Σ g D εεᵀ,   ε = (τ, δv),   D = ∂G / ∂E, which is G itself for a Gaussian

with δ the offset in pixels and g the gradient of the image. Every Gaussian gathers its own gradient, without atomics. τ
is the offset along a row from the axis of a slanted footprint. With moments of δ itself, the moment of the thin side of
a needle would be a small difference of large sums.

E is a parabola along a column, so G follows from the row above by two products, with factors that are the exponentials
of E's first and second difference:

    G(δv + 1) = G(δv) Q(δv),   ln Q = k r (r - 2 (δu - r δv)) + l (2 δv + 1)
    Q(δv + 1) = Q(δv) q,       ln q = 2 (k r² + l)

Errors grow with the rows, so G is computed directly after every `ANCHOR` rows. In the first row of a long slanted
footprint, G may be so small that float32 underflows. If the first row would begin below exp(-DEEPEST), the exponential
is computed for every pixel of the footprint.

A compact kernel (`recon.base.kernel`) has G = t^p with t = (1 + 2 E / R²)₊ and D = 2 p / R² t^(p - 1): p = 2 in an
image, p = 3/2 in a slice of voxels. It needs no exponential: t follows from the row above by two sums.

Images are summed over threads in a fixed order, so that the result is bit-identical for the same number of threads, and
equal up to rounding for another number. Each thread sums in two levels: first `MANY` footprints, then these sums.
(Adding equal float32 numbers one by one loses a part that grows with their number, half a percent for a million.)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import get_num_threads, njit, prange

from recon.base.kernel import Kernel
from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.boxes import GROUP, box_of, is_upright, padded, padded_shape, span_of
from recon.kernels.cpu.footprints import KV, SHEAR, K, U, V, W

_f = np.float32
ANCHOR = 16  # rows of one recurrence; the error stays below 1e-5 of the footprint's weight
MANY = 512  # footprints in one sum
# The profile of a footprint, a constant of each compiled kernel: exp(-q/2); for a compact kernel its image, t², or the
# kernel itself, t^(3/2). One value is None, because numba removes branches that `is None` excludes before it compiles
# the others.
GAUSSIAN, SHADOW, COMPACT = None, 1, 2
_PER = np.float32(1 / Kernel.COMPACT.radius**2)
_SHADOW_SLOPE = np.float32(2 * (Kernel.COMPACT.exponent + 0.5) / Kernel.COMPACT.radius**2)  # 2 p / R²
_COMPACT_SLOPE = np.float32(2 * Kernel.COMPACT.exponent / Kernel.COMPACT.radius**2)


@njit(inline="always", fastmath=True)
def _start_gaussian(table, i, dx, dy):
    """G, Q and q of a row, for the lanes at column offsets dx."""
    k, shear, kv = _f(-0.5) * table[i, K], table[i, SHEAR], _f(-0.5) * table[i, KV]
    across = dx - shear * dy
    value = lanes.exp(across * across * k + kv * dy * dy)
    factor = lanes.exp((across * _f(-2) + shear) * (k * shear) + kv * (_f(2) * dy + _f(1)))
    return value, factor, lanes.exp(lanes.zero() + _f(2) * (k * shear * shear + kv))


@njit(inline="always", fastmath=True)
def _compact(t, profile):
    """Two factors of G of a compact kernel, for t before it is cut off at 0; the second is D without 2 p / R²."""
    t = lanes.positive(t)
    return t, t if profile == SHADOW else lanes.root(t)


@njit(inline="always", fastmath=True)
def _start_compact(table, i, dx, dy):
    """t of a row, its first and its second difference along the column, for the lanes at column offsets dx."""
    k, shear, kv = -_PER * table[i, K], table[i, SHEAR], -_PER * table[i, KV]
    across = dx - shear * dy
    value = across * across * k + (kv * dy * dy + _f(1))
    step = (across * _f(-2) + shear) * (k * shear) + kv * (_f(2) * dy + _f(1))
    return value, step, _f(2) * (k * shear * shear + kv)


@njit(inline="always", fastmath=True)
def _values_at(table, i, first, dy, profile):
    """τ of the lanes from `first` on, and G and D there (D of a compact kernel without its factor)."""
    dx = lanes.iota() + (_f(first) - table[i, U])
    across = dx - table[i, SHEAR] * dy
    square = across * across * table[i, K] + table[i, KV] * dy * dy
    if profile is None:
        value = lanes.exp(square * _f(-0.5))
        return across, value, value
    value, slope = _compact(square * -_PER + _f(1), profile)
    return across, value * slope, slope


@njit(fastmath=True, error_model="numpy")
def _add_by_pixels(table, i, row0, row1, col0, col1, image, profile):
    """Add footprint i to the image, computing each pixel separately."""
    for row in range(row0, row1):
        dy = _f(row) - table[i, V]
        low, high = span_of(table, i, dy, col0, col1)
        for start in range(low, high, lanes.WIDTH):
            first = min(start, image.shape[1] - lanes.WIDTH)
            _, value, _ = _values_at(table, i, first, dy, profile)
            value = lanes.between(value * table[i, W], start - first, high - first)
            lanes.store(image, row, first, lanes.load(image, row, first) + value)


@njit(inline="always", fastmath=True)
def _store(moments, i, m0, d0, mt, mv, mtt, mtv, mvv, profile):
    """Fill moments [i] from the sums of the lanes; a compact kernel in a slice has Σ g D as a seventh moment."""
    if profile is None:
        lanes.store_first(moments, i, 0, lanes.totals((m0, mt, mv, mtt, mtv, mvv)), 6)
    elif profile == SHADOW:
        s = _SHADOW_SLOPE
        lanes.store_first(moments, i, 0, lanes.totals((m0, mt * s, mv * s, mtt * s, mtv * s, mvv * s)), 6)
    else:
        s = _COMPACT_SLOPE
        lanes.store_first(moments, i, 0, lanes.totals((m0, mt * s, mv * s, mtt * s, mtv * s, mvv * s, d0 * s)), 7)


@njit(fastmath=True, error_model="numpy")
def _gather_by_pixels(table, i, row0, row1, col0, col1, gradient, moments, profile):
    """Moments of the gradient under footprint i, computing each pixel separately."""
    m0, d0, mt, mv = lanes.zero(), lanes.zero(), lanes.zero(), lanes.zero()
    mtt, mtv, mvv = lanes.zero(), lanes.zero(), lanes.zero()
    for row in range(row0, row1):
        dy = _f(row) - table[i, V]
        low, high = span_of(table, i, dy, col0, col1)
        for start in range(low, high, lanes.WIDTH):
            first = min(start, gradient.shape[1] - lanes.WIDTH)
            across, value, slope = _values_at(table, i, first, dy, profile)
            pixel_gradient = lanes.between(lanes.load(gradient, row, first), start - first, high - first)
            weighted = pixel_gradient * slope
            weighted_across, weighted_down = weighted * across, weighted * dy
            m0, d0, mt, mv = m0 + pixel_gradient * value, d0 + weighted, mt + weighted_across, mv + weighted_down
            mtt, mtv, mvv = mtt + weighted_across * across, mtv + weighted_across * dy, mvv + weighted_down * dy
    _store(moments, i, m0, d0, mt, mv, mtt, mtv, mvv, profile)


@njit(inline="always", fastmath=True)
def _add_gaussian(table, i, first, low, high, row0, row1, image):
    """Add the lanes low, ..., high - 1 from column `first` on, by the recurrence."""
    dx = lanes.iota() + (_f(first) - table[i, U])
    for anchor in range(row0, row1, ANCHOR):
        value, factor, change = _start_gaussian(table, i, dx, _f(anchor) - table[i, V])
        value = lanes.between(value * table[i, W], low, high)
        for group in range(anchor, min(row1, anchor + ANCHOR), GROUP):
            for step in range(GROUP):
                row = group + step
                lanes.store(image, row, first, lanes.load(image, row, first) + value)
                value = value * factor
                factor = factor * change


@njit(inline="always", fastmath=True)
def _add_compact(table, i, first, low, high, row0, row1, image, profile):
    """Add the lanes low, ..., high - 1 from column `first` on, of a compact kernel."""
    dx = lanes.iota() + (_f(first) - table[i, U])
    weight = lanes.between(lanes.zero() + table[i, W], low, high)
    for anchor in range(row0, row1, ANCHOR):
        t, change, bend = _start_compact(table, i, dx, _f(anchor) - table[i, V])
        for group in range(anchor, min(row1, anchor + ANCHOR), GROUP):
            for step in range(GROUP):
                row = group + step
                value, slope = _compact(t, profile)
                lanes.store(image, row, first, lanes.load(image, row, first) + value * weight * slope)
                t = t + change
                change = change + bend


@njit(inline="always", fastmath=True)
def add_footprint(table, i, rows, cols, image, profile):
    """Add footprint i to an image of rows x cols in an array of its `padded_shape`; returns the rows of its box."""
    height, width = image.shape
    row0, row1, col0, col1 = box_of(table, i, rows, cols, height)
    if is_upright(table, i, row0):
        for start in range(col0, col1, lanes.WIDTH):
            first = min(start, width - lanes.WIDTH)
            if profile is None:
                _add_gaussian(table, i, first, start - first, col1 - first, row0, row1, image)
            else:
                _add_compact(table, i, first, start - first, col1 - first, row0, row1, image, profile)
    else:
        _add_by_pixels(table, i, row0, row1, col0, col1, image, profile)
    return row0, row1


@njit(inline="always", fastmath=True)
def _column_gaussian(table, i, dx, first, low, high, row0, row1, gradient):
    """Σ g G, and Σ g D times 1, δv, δv² over the rows, for the lanes low, ..., high - 1, by the recurrence."""
    s0, s1, s2 = lanes.zero(), lanes.zero(), lanes.zero()
    for anchor in range(row0, row1, ANCHOR):
        value, factor, change = _start_gaussian(table, i, dx, _f(anchor) - table[i, V])
        value = lanes.between(value, low, high)
        for group in range(anchor, min(row1, anchor + ANCHOR), GROUP):
            dy = _f(group) - table[i, V]
            for step in range(GROUP):
                weighted = lanes.load(gradient, group + step, first) * value
                weighted_down = weighted * (dy + _f(step))
                s0, s1, s2 = s0 + weighted, s1 + weighted_down, s2 + weighted_down * (dy + _f(step))
                value = value * factor
                factor = factor * change
    return s0, s0, s1, s2


@njit(inline="always", fastmath=True)
def _column_compact(table, i, dx, first, low, high, row0, row1, gradient, profile):
    """The same as `_column_gaussian` for a compact kernel, with D without its factor."""
    m0, s0, s1, s2 = lanes.zero(), lanes.zero(), lanes.zero(), lanes.zero()
    for anchor in range(row0, row1, ANCHOR):
        t, change, bend = _start_compact(table, i, dx, _f(anchor) - table[i, V])
        for group in range(anchor, min(row1, anchor + ANCHOR), GROUP):
            dy = _f(group) - table[i, V]
            for step in range(GROUP):
                value, slope = _compact(t, profile)
                weighted = lanes.load(gradient, group + step, first) * slope
                weighted_down = weighted * (dy + _f(step))
                m0, s0, s1 = m0 + weighted * value, s0 + weighted, s1 + weighted_down
                s2 = s2 + weighted_down * (dy + _f(step))
                t = t + change
                change = change + bend
    return (
        lanes.between(m0, low, high), lanes.between(s0, low, high),
        lanes.between(s1, low, high), lanes.between(s2, low, high),
    )  # fmt: skip


@njit(inline="always", fastmath=True)
def gather_footprint(table, i, rows, cols, gradient, moments, profile):
    """Fill moments [i] of a gradient of rows x cols in an array of its `padded_shape`, with G of weight 1."""
    height, width = gradient.shape
    row0, row1, col0, col1 = box_of(table, i, rows, cols, height)
    if is_upright(table, i, row0):
        m0, d0, mt, mv = lanes.zero(), lanes.zero(), lanes.zero(), lanes.zero()
        mtt, mtv, mvv = lanes.zero(), lanes.zero(), lanes.zero()
        shear = table[i, SHEAR]
        for start in range(col0, col1, lanes.WIDTH):
            first = min(start, width - lanes.WIDTH)
            low, high = start - first, col1 - first
            dx = lanes.iota() + (_f(first) - table[i, U])
            if profile is None:
                g0, s0, s1, s2 = _column_gaussian(table, i, dx, first, low, high, row0, row1, gradient)
            else:
                g0, s0, s1, s2 = _column_compact(table, i, dx, first, low, high, row0, row1, gradient, profile)
            # `is_upright` limits the slant, so that these differences lose at most three digits.
            t0, t1 = dx * s0 - shear * s1, dx * s1 - shear * s2
            m0, d0, mt, mv = m0 + g0, d0 + s0, mt + t0, mv + s1
            mtt, mtv, mvv = mtt + (dx * t0 - shear * t1), mtv + t1, mvv + s2
        _store(moments, i, m0, d0, mt, mv, mtt, mtv, mvv, profile)
    else:
        # One type for the number, independent of the loop, because each type would be compiled separately.
        _gather_by_pixels(table, np.int64(i), row0, row1, col0, col1, gradient, moments, profile)


@njit(inline="always", fastmath=True)
def _add_and_clear(partial_sum, image, row0, row1):
    """Add rows of `partial_sum` to the image and set them to zero."""
    for row in range(row0, row1):
        for col in range(image.shape[1]):
            image[row, col] += partial_sum[row, col]
            partial_sum[row, col] = _f(0)


# The profile is a constant of the compiled kernels, so that the other profiles cost a Gaussian nothing.
def _renderer(profile: int | None) -> Any:
    @njit(**OPTIONS)
    def kernel(table: F32, rows: int, cols: int, layers: F32) -> None:
        n, threads = table.shape[0], layers.shape[0] // 2
        n_of_thread = (n + threads - 1) // threads
        for thread in prange(threads):
            image, partial_sum = layers[thread], layers[threads + thread]
            image[:] = _f(0)
            partial_sum[:] = _f(0)
            end = min(n, (thread + 1) * n_of_thread)
            for start in range(thread * n_of_thread, end, MANY):
                row0, row1 = layers.shape[1], 0
                for i in range(start, min(end, start + MANY)):
                    first, last = add_footprint(table, i, rows, cols, partial_sum, profile)
                    if last > first:
                        row0, row1 = min(row0, first), max(row1, last)
                _add_and_clear(partial_sum, image, row0, row1)

    return kernel


def _gatherer(profile: int | None) -> Any:
    @njit(**OPTIONS)
    def kernel(table: F32, gradient: F32, rows: int, cols: int, moments: F32) -> None:
        for i in prange(table.shape[0]):
            gather_footprint(table, i, rows, cols, gradient, moments, profile)

    return kernel


_PROFILES = {Kernel.GAUSSIAN: GAUSSIAN, Kernel.COMPACT: SHADOW}
_RENDER = {kernel: _renderer(profile) for kernel, profile in _PROFILES.items()}
_MOMENTS = {kernel: _gatherer(profile) for kernel, profile in _PROFILES.items()}


@njit(**OPTIONS)
def _sum_layers(layers: F32, image: F32) -> None:
    for row in prange(image.shape[0]):
        for col in range(image.shape[1]):
            value = layers[0, row, col]
            for t in range(1, layers.shape[0] // 2):
                value += layers[t, row, col]
            image[row, col] = value


def render_layers(rows: int, cols: int) -> F32:
    """Scratch memory of two images per thread, [2 thread, row, col]; it can be reused for any number of renderings."""
    return np.empty((2 * get_num_threads(), *padded_shape(rows, cols)), np.float32)


def render(table: F32, image: F32, layers: F32 | None = None, kernel: Kernel = Kernel.GAUSSIAN) -> None:
    """Sum the footprints of `table` into image [row, col] (overwritten); `layers`: scratch, see `render_layers`."""
    rows, cols = image.shape
    scratch = render_layers(rows, cols) if layers is None else layers
    _RENDER[kernel](table, rows, cols, scratch)
    _sum_layers(scratch, image)


def moments(table: F32, gradient: F32, result: F32 | None = None, kernel: Kernel = Kernel.GAUSSIAN) -> F32:
    """Moments [n, 6] (1, τ, v, ττ, τv, vv) of the image gradient [row, col] under each footprint, in `result` if given.

    The gradient is copied unless it is C-contiguous and has its `padded_shape`.
    """
    rows, cols = gradient.shape
    filled = np.empty((table.shape[0], 6), np.float32) if result is None else result
    _MOMENTS[kernel](table, padded(gradient), rows, cols, filled)
    return filled
