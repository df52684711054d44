"""Back-projection of filtered projections of a parallel beam, sixteen slices at a time: ray by ray, or by gridding.

f(x, y) = Σ_view q_view(x cos θ + y sin θ), where q interpolates the columns of a projection linearly. Ray by ray, the
work grows as views x voxels. The work of gridding grows as views x columns, plus a few FFTs. By the projection-slice
theorem a projection is a line through the middle of the volume's Fourier plane (O'Sullivan 1985, IEEE Trans. Med.
Imaging 4, 200). The plane is periodic, because the volume is sampled. So it also contains the frequencies above the
sampling frequency that linear interpolation adds. Both ways give the same volume where all projections see it.
Elsewhere they differ at the end of a projection: ray by ray adds half a pixel, gridding adds a ramp to 0 within one
pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray
from scipy import fft

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS

C64 = NDArray[np.complex64]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

SLICES = lanes.WIDTH
"""Number of slices that are back-projected together."""

_f = np.float32
_ACROSS, _DOWN = 16, 8  # voxels along each edge of one job of 16 slices: 8 KiB
_TILE = 32  # cells of the Fourier plane along each edge of one job
_FINER = 1.25  # least number of cells of the Fourier plane per voxel
_REACH = 6  # cells across the kernel
_STEPS = 2048  # steps of the kernel's table within a cell
_LEAST = 7e-5  # 1/pixel; frequencies with a smaller gain of filter and linear interpolation are ignored
_MOST = 30  # highest frequency in cycles per column

# Times in ns for sixteen slices (sum over two cores, AVX-512 in halves): for a voxel in a projection, for adding a
# point to the Fourier plane, for a cell of that plane, for a point in the plan.
_NS_A_RAY, _NS_A_POINT, _NS_A_CELL, _NS_OF_PLAN = 5, 85, 150, 20


@njit(inline="always")
def _line_of_lanes(n):
    """Zeros [n, 16] that begin at a cache line, so that sixteen lanes are always in a single one."""
    buffer = np.zeros((n + 1) * lanes.WIDTH, np.float32)
    begin = (-(buffer.ctypes.data // 4)) % lanes.WIDTH
    return buffer[begin : begin + n * lanes.WIDTH].reshape(n, lanes.WIDTH)


@njit(**OPTIONS)
def _ray_by_ray(columns: F32, cosines: F64, sines: F64, axis_cols: F64, x: F64, y: F64, out: F32) -> None:
    """out[z, y, x] = Σ_view columns[view, 1 + x cos + y sin + axis, z]; x and y in pixels.

    The first and the last column of each projection are stored twice. The projection ends half a pixel beyond them.
    """
    views, cols = columns.shape[0], columns.shape[1] - 2
    nz, ny, nx = out.shape
    across, down = (nx + _ACROSS - 1) // _ACROSS, (ny + _DOWN - 1) // _DOWN
    for job in prange(across * down):
        j0, i0 = (job // across) * _DOWN, (job % across) * _ACROSS
        j1, i1 = min(j0 + _DOWN, ny), min(i0 + _ACROSS, nx)
        sums = _line_of_lanes(_DOWN * _ACROSS)
        for v in range(views):
            view, c = columns[v], cosines[v]
            for j in range(j0, j1):
                offset = y[j] * sines[v] + axis_cols[v] + 1.0
                place = (j - j0) * _ACROSS
                for i in range(i0, i1):
                    t = x[i] * c + offset
                    if t >= 0.5 and t <= cols + 0.5:
                        col = int(t)
                        upper = _f(t - col)
                        low, high = lanes.load(view, col, 0), lanes.load(view, col + 1, 0)
                        lanes.store(sums, place, 0, lanes.load(sums, place, 0) + (low * (_f(1) - upper) + high * upper))
                    place += 1
        for k in range(nz):
            for j in range(j0, j1):
                for i in range(i0, i1):
                    out[k, j, i] = sums[(j - j0) * _ACROSS + i - i0, k]


@njit(inline="always")
def _cell(frequency, n):
    """Position in a period of n cells, 0 <= position < n, of a frequency in cycles per voxel."""
    place = (frequency - math.floor(frequency)) * n
    return place if place < n else 0.0


@njit(cache=True, boundscheck=False, error_model="numpy")
def _runs(k: I32, n: int, fx: F64, fy: F64, shape: tuple[int, int], tiles: I32, runs: I32) -> int:
    """Divide the line of points of each projection where it enters another tile of the plane, or another period.

    Fills tiles [run], and runs [run, (view, first point, end)], up to their lengths; returns the number of runs.
    """
    across, n_runs, last = shape[1] // _TILE, 0, -1
    for v in range(fx.size):
        period = 0
        for sample in range(k.size):
            row, col = int(_cell(fy[v] * k[sample], shape[0])), int(_cell(fx[v] * k[sample], shape[1]))
            tile, turn = (row // _TILE) * across + col // _TILE, math.floor(k[sample] / n)
            if sample == 0 or tile != last or turn != period:
                if n_runs < len(runs):
                    tiles[n_runs], runs[n_runs, 0], runs[n_runs, 1] = tile, v, sample
                n_runs += 1
                last, period = tile, turn
            if n_runs <= len(runs):
                runs[n_runs - 1, 2] = sample + 1
    return n_runs


@njit(**OPTIONS)
def _spread(
    spectra: F32, turns: F32, k: I32, gain: F32, table: F32, fx: F64, fy: F64, runs: I32, ends: I32, plane: F32,
    colour: int,
) -> None:  # fmt: skip
    """plane[row, col, 2 pair] += each point's value times the kernel's weights around it, for a quarter of the tiles.

    Tiles of the same colour, 0 to 3, do not touch, so that threads can fill them at the same time.

    spectra [view, k, 16] contains one period of the spectra of the projections, turns [view, period, 2] the phase of
    each later period. gain [point] is the transfer function of linear interpolation at the frequencies k [point].
    """
    n, used = spectra.shape[1], plane.shape[2]
    rows, cols = plane.shape[0], plane.shape[1]
    across, down = cols // _TILE, rows // _TILE
    edge = _TILE + _REACH
    for job in prange((across // 2) * (down // 2)):
        ty, tx = 2 * (job // (across // 2)) + colour // 2, 2 * (job % (across // 2)) + colour % 2
        tile = ty * across + tx
        if ends[tile] == ends[tile + 1]:
            continue
        cells = _line_of_lanes(edge * edge)
        for run in range(ends[tile], ends[tile + 1]):
            v, first = runs[run, 0], runs[run, 1]
            period = math.floor(k[first] / n)
            source, turn = spectra[v], turns[v, period + _MOST]
            step_row, step_col = fy[v] * rows, fx[v] * cols
            row0 = _cell(fy[v] * k[first], rows) - ty * _TILE - step_row * k[first]
            col0 = _cell(fx[v] * k[first], cols) - tx * _TILE - step_col * k[first]
            for sample in range(first, runs[run, 2]):
                re, im = turn[0] * gain[sample], turn[1] * gain[sample]
                value = lanes.load(source, k[sample] - period * n, 0)
                value = value * re + lanes.quarter_turn(value) * im
                row, col = row0 + step_row * k[sample], col0 + step_col * k[sample]
                r, c = int(row), int(col)
                wr, wc = table[int((row - r) * _STEPS)], table[int((col - c) * _STEPS)]
                for i in range(_REACH):
                    weighed, cell = value * wr[i], (r + i) * edge + c
                    for j in range(_REACH):
                        lanes.store(cells, cell + j, 0, lanes.load(cells, cell + j, 0) + weighed * wc[j])
        for i in range(edge):
            row = (ty * _TILE + i - _REACH // 2 + 1) % rows
            for j in range(edge):
                target = plane[row, (tx * _TILE + j - _REACH // 2 + 1) % cols]
                for lane in range(used):
                    target[lane] += cells[i * edge + j, lane]


@njit(**OPTIONS)
def _crop(plane: F32, down: F32, across: F32, out: F32) -> None:
    """out[z, y, x] = the plane [row, col, z] around the start of its period, divided by the transform of the kernel."""
    nz, ny, nx = out.shape
    for j in prange(ny):
        row = plane[(j - ny // 2) % plane.shape[0]]
        for i in range(nx):
            values, weight = row[(i - nx // 2) % plane.shape[1]], down[j] * across[i]
            for k in range(nz):
                out[k, j, i] = values[k] * weight


@dataclass(frozen=True, eq=False)
class Gridding:
    """The plan of gridding for a set of projections and a plane of voxels; it is the same for all slices.

    Attributes:
        fx, fy: [view], the first frequency in cycles per voxel.
        phase: complex64 [view, k], phase of one period, from the positions of the axis and of the middle voxel.
        turns: float32 [view, period, 2], the phase of each period.
        k, gain: [point], frequencies in cycles per period, and the transfer function of linear interpolation there.
        runs: [run, (view, first point, end)], the points of all projections, ordered by tiles of the Fourier plane.
        ends: [tile + 1], the first run of each tile; the last entry is the number of runs.
        plane: number of cells of the Fourier plane (rows, cols).
        table: float32 [step, cell], the kernel.
        down, across: float32 [y], [x], 1 / transform of the kernel.
    """

    fx: F64
    fy: F64
    phase: C64
    turns: F32
    k: I32
    gain: F32
    runs: I32
    ends: I32
    plane: tuple[int, int]
    table: F32
    down: F32
    across: F32


def gridding(angles: F64, axis_cols: F64, cols: int, x: F64, y: F64, response: Callable[[int], F32]) -> Gridding:
    """The plan of gridding for voxels at x and y (pixels, evenly spaced).

    Args:
        response: transfer function [n // 2 + 1] of the filter of the projections, for a transform of n samples.
    """
    cosines, sines = np.cos(angles), np.sin(angles)
    step = x[1] - x[0] if x.size > 1 else y[1] - y[0] if y.size > 1 else 1.0
    middle = x[x.size // 2] * cosines + y[y.size // 2] * sines + axis_cols
    n = _period(cosines, sines, axis_cols, cols, x, y)
    k, gain = _frequencies(n, response)
    phase = np.exp(2j * np.pi * (np.arange(n) / n * middle[:, None])) / n
    periods = np.arange(-_MOST, _MOST + 1)
    turns = np.exp(2j * np.pi * (periods * np.mod(middle, 1)[:, None]))
    plane = (_cells(y.size), _cells(x.size))
    fx, fy = cosines * step / n, sines * step / n
    room = angles.size * k.size // 8 + 1024
    tiles, runs = np.empty(room, np.int32), np.empty((room, 3), np.int32)
    if (n_runs := _runs(k, n, fx, fy, plane, tiles, runs)) > room:
        tiles, runs = np.empty(n_runs, np.int32), np.empty((n_runs, 3), np.int32)
        _runs(k, n, fx, fy, plane, tiles, runs)
    tiles, runs = tiles[:n_runs], runs[:n_runs]
    ends = np.searchsorted(np.sort(tiles), np.arange(plane[0] * plane[1] // _TILE**2 + 1)).astype(np.int32)
    runs = runs[np.argsort(tiles, kind="stable")]
    return Gridding(
        fx, fy, phase.astype(np.complex64), np.stack((turns.real, turns.imag), 2).astype(np.float32), k, gain, runs,
        ends, plane, _kernel_table(), _deapodisation(y.size, plane[0]), _deapodisation(x.size, plane[1]),
    )  # fmt: skip


def _frequencies(n: int, response: Callable[[int], F32]) -> tuple[I32, F32]:
    """Frequencies of filtered, linearly interpolated projections in cycles per n columns, and the gain there."""
    k = np.arange(-_MOST * n, _MOST * n, dtype=np.int32)
    gain = np.sinc(k / n) ** 2
    within = np.mod(k, n)
    weight = gain * response(n)[np.minimum(within, n - within)]
    wanted = (weight > _LEAST) | (2 * np.abs(k) <= n)
    return k[wanted], gain[wanted].astype(np.float32)


def _period(cosines: F64, sines: F64, axis_cols: F64, cols: int, x: F64, y: F64) -> int:
    """Length in samples to which a projection is padded, so that no voxel sees its next period."""
    ends = np.array([(a, b) for a in (x[0], x[-1]) for b in (y[0], y[-1])])
    t = ends[:, 0] * cosines[:, None] + ends[:, 1] * sines[:, None] + axis_cols[:, None]
    return int(fft.next_fast_len(math.ceil(max(cols - t.min(), t.max(), cols)) + 2))


def _cells(n: int) -> int:
    """Number of cells of the Fourier plane for n voxels: whole tiles of four colours, and a length with a fast FFT."""
    return 2 * _TILE * int(fft.next_fast_len(math.ceil(_FINER * n / (2 * _TILE))))


# Kaiser-Bessel kernel with the shape of Beatty, Nishimura & Pauly 2005 (IEEE Trans. Med. Imaging 24, 799, eq. 5).
_SHAPE = math.pi * math.sqrt((_REACH / _FINER * (_FINER - 0.5)) ** 2 - 0.8)


def _kernel_table() -> F32:
    """Weights [step, cell] of the cells around a point, for its distance in steps from the cell on its left."""
    beyond = (np.arange(_STEPS) + 0.5) / _STEPS
    distance = beyond[:, None] - np.arange(1 - _REACH // 2, _REACH // 2 + 1)
    return np.i0(_SHAPE * np.sqrt(np.maximum(1 - (2 * distance / _REACH) ** 2, 0))).astype(np.float32) / np.float32(
        np.i0(_SHAPE)
    )


def _deapodisation(n: int, cells: int) -> F32:
    """1 / Fourier transform of the kernel, [voxel]."""
    root = np.sqrt(_SHAPE**2 - (np.pi * _REACH * (np.arange(n) - n // 2) / cells) ** 2)
    return (root / (_REACH * np.sinh(root)) * np.i0(_SHAPE)).astype(np.float32)


def by_gridding(plan: Gridding, columns: F32, out: F32) -> None:
    """out[z, y, x] of at most 16 slices from columns [view, 1 + col + 1, 16]."""
    workers, pairs = get_num_threads(), (len(out) + 1) // 2
    spectra = fft.fft(columns.view(np.complex64)[:, 1:-1], plan.phase.shape[1], axis=1, workers=workers)
    spectra *= plan.phase[:, :, None]
    plane = np.zeros((*plan.plane, 2 * pairs), np.float32)
    for colour in range(4):
        _spread(
            spectra.view(np.float32), plan.turns, plan.k, plan.gain, plan.table, plan.fx, plan.fy, plan.runs, plan.ends,
            plane, colour,
        )  # fmt: skip
    del spectra
    image = fft.ifft2(plane.view(np.complex64), axes=(0, 1), norm="forward", overwrite_x=True, workers=workers)
    _crop(image.view(np.float32), plan.down, plan.across, out)


def ray_by_ray(angles: F64, axis_cols: F64, x: F64, y: F64, columns: F32, out: F32) -> None:
    """As `by_gridding`, by interpolation at every voxel; x and y in pixels, with any spacing."""
    _ray_by_ray(columns, np.cos(angles), np.sin(angles), axis_cols, x, y, out)


def compile_gridding() -> None:
    """Grid an empty slice, so that the kernels are compiled."""
    angles, x = np.arange(2.0), np.arange(4.0)
    plan = gridding(angles, np.full(2, 2.0), 4, x, x, lambda n: np.ones(n // 2 + 1, np.float32))
    by_gridding(plan, columns_of(2, 4), np.empty((1, 4, 4), np.float32))


def gridding_pays(views: int, cols: int, voxels: tuple[int, int], slices: int, response: Callable[[int], F32]) -> bool:
    """Whether gridding is faster than ray by ray, according to measured times."""
    rays, gridded = nanoseconds(views, cols, voxels, slices, response)
    return rays > gridded


def nanoseconds(
    views: int, cols: int, voxels: tuple[int, int], slices: int, response: Callable[[int], F32]
) -> tuple[float, float]:
    """Times of sixteen slices, ray by ray and by gridding, in ns."""
    points = views * _frequencies(max(cols, *voxels), response)[0].size
    blocks = -(-slices // SLICES)
    plane = _cells(voxels[0]) * _cells(voxels[1])
    rays = _NS_A_RAY * views * voxels[0] * voxels[1]
    return rays, _NS_A_POINT * points + _NS_A_CELL * plane + _NS_OF_PLAN * points / blocks


def columns_of(views: int, cols: int) -> F32:
    """Zeros [view, 1 + col + 1, 16] for filtered projections (edge columns stored twice), aligned to cache lines."""
    return _line_of_lanes.py_func(views * (cols + 2)).reshape(views, cols + 2, SLICES)
