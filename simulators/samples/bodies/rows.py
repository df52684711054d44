"""Rows: a frame's line integrals, and its counts where nothing but Beer-Lambert is simulated, row by row in the cache.

Each row is the sum over the bodies that shadow it, in their order, so that it does not depend on threads or other rows.
Upright cylinders (in a parallel beam) come first: their sum is reused from row to row while they are the same.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import config, njit
from numpy.typing import NDArray

from simulators.samples.bodies import chords, counting, facets, packing
from simulators.samples.bodies import view as views
from simulators.samples.bodies.chords import (
    KERNEL,
    Row,
    cone_ellipsoid,
    ellipsoid,
    leaning_cylinder,
    locate,
    upright_cylinder,
)
from simulators.samples.bodies.counting import Counts, to_counts
from simulators.samples.bodies.facets import cone_polyhedron, polyhedron
from simulators.samples.bodies.packing import CYLINDER, ELLIPSOID, Packed
from simulators.samples.bodies.view import View

Reals = NDArray[np.float64]

TILE = 64  # columns: only tiles that a body shadows are converted to counts
SMALL = 2**16  # pixels that are computed faster than a thread starts
_BRIGHT = 600.0  # exp of it exceeds any converter's range and fits into float64

Kernel = Callable[..., None]


def _entries(version: int) -> tuple[Kernel, Kernel]:
    """The kernels that are called from Python, cached on disk with all that they call.

    Numba recompiles a cached kernel when its own file changes, not when those of the kernels that it calls do. It also
    compares the values of closure variables: here the version of all the files.
    """

    @njit(cache=True, **KERNEL)
    def depth_rows(p, view, scratch, rows, out):  # type: ignore[no-untyped-def]
        if version != 0:
            _depth_rows(p, view, scratch, rows, out)

    @njit(cache=True, **KERNEL)
    def count_rows(p, view, scratch, start, step, counter, out, doubtful):  # type: ignore[no-untyped-def]
        if version != 0:
            _count_rows(p, view, scratch, start, step, counter, out, doubtful)

    return depth_rows, count_rows


def _version() -> int:
    """Checksum of the kernels' files; not 0."""
    files = [__file__, *(str(module.__file__) for module in (chords, counting, facets, packing, views))]
    return zlib.crc32(b"".join(Path(file).read_bytes() for file in files)) or 1


def depths(p: Packed, view: View) -> Reals:
    """Line integrals, float64 [row, col]."""
    out = np.empty((view.v.size, view.u.size))
    _shared(
        lambda first, step: depth_rows(p, view, _scratch(p, view), np.arange(first, view.v.size, step), out), out.size
    )
    return out


def counts(p: Packed, view: View, open_beam: float, rule: Callable[[Reals], Counts]) -> Counts:
    """open_beam x exp(-line integral), rounded and clipped, uint16 [row, col]: equal to rule(line integrals).

    The exponential here is a polynomial; rows where the rounding of a count is in doubt are computed by the rule.

    Args:
        open_beam: counts without a sample, not rounded.
        rule: counts of line integrals [row, col], which it may overwrite.
    """
    out, doubtful = np.empty((view.v.size, view.u.size), np.uint16), np.zeros(view.v.size, np.bool_)
    air, top = (int(rule(np.full((1, 1), depth))[0, 0]) for depth in (0.0, -_BRIGHT))
    counter = Counter(float(open_beam), air, float(top))
    _shared(
        lambda first, step: count_rows(p, view, _scratch(p, view), first, step, counter, out, doubtful),
        out.size,
    )
    rows = np.flatnonzero(doubtful)
    if rows.size:
        again = np.empty((rows.size, view.u.size))
        depth_rows(p, view, _scratch(p, view), rows, again)
        out[rows] = rule(again)
    return out


def _shared(work: Callable[[int, int], None], pixels: int) -> None:
    """Run work(first row, step) in as many threads as numba may use.

    Python's threads, not numba's: those would start OpenMP before torch does, which slows torch down.
    """
    threads = int(config.NUMBA_NUM_THREADS) if pixels > SMALL else 1
    if threads == 1:
        work(0, 1)
        return
    with ThreadPoolExecutor(threads - 1, thread_name_prefix="rows") as pool:
        others = [pool.submit(work, k, threads) for k in range(1, threads)]
        work(0, threads)
        for other in others:
            other.result()


@njit(**KERNEL)
def _depth_rows(p: Packed, view: View, scratch: Scratch, rows: NDArray[np.int64], out: Reals) -> None:
    """Line integrals of some rows, into the rows of `out`, or into the rows of the same numbers of a whole frame."""
    place, facets, lines, touched, base = scratch.place, scratch.facets, scratch.lines, scratch.touched, scratch.base
    _locate_all(p, view, place, facets)
    whole = out.shape[0] == view.v.size
    known = np.int64(-1)  # numba compiles twice for the literal
    for r in range(rows.size):
        j = rows[r]
        row = out[j] if whole else out[r]
        known = _base(p, view, j, known, place, base)[0]
        _copy(base, row)
        _add_bodies(p, view, j, row, place, facets, lines, touched)


@njit(**KERNEL)
def _count_rows(
    p: Packed,
    view: View,
    scratch: Scratch,
    start: int,
    step: int,
    counter: Counter,
    out: Counts,
    doubtful: NDArray[np.bool_],
) -> None:
    """Counts of every step-th row; marks the rows in which the rounding of a count is in doubt."""
    place, facets, lines, touched, row, base, of_base = scratch
    open_beam, air, top = counter
    _locate_all(p, view, place, facets)
    known, base_in_doubt = np.int64(-1), False
    for j in range(start, view.v.size, step):
        before = known
        known, first, stop = _base(p, view, j, known, place, base)
        if known == j or before < 0:
            _copy(base, row)
            _fill(of_base, air)
            base_in_doubt = to_counts(base[first:stop], open_beam, top, of_base[first:stop])
        _copy(of_base, out[j])
        doubt = base_in_doubt
        _fill(touched, False)
        _add_bodies(p, view, j, row, place, facets, lines, touched)
        k = 0
        while k < touched.size:
            if touched[k]:
                begin = k * TILE
                while k < touched.size and touched[k]:
                    k += 1
                end = min(k * TILE, row.size)
                doubt = to_counts(row[begin:end], open_beam, top, out[j, begin:end]) or doubt
                _copy(base[begin:end], row[begin:end])
            k += 1
        doubtful[j] = doubt


class Counter(NamedTuple):
    """Counts without a sample before rounding, the same rounded, and the largest count."""

    open_beam: float
    air: int
    top: float


class Scratch(NamedTuple):
    """Scratch arrays of one thread; the kernels here allocate none."""

    place: Reals
    facets: Reals
    lines: Reals
    touched: NDArray[np.bool_]
    row: Reals
    base: Reals
    of_base: Counts


def _scratch(p: Packed, view: View) -> Scratch:
    return Scratch(
        np.zeros((p.kind.size, 7)),
        np.zeros((p.faces.shape[0], 4)),
        np.empty((4, max(8, int(np.diff(p.first_face).max(initial=0))))),
        np.zeros(view.u.size // TILE + 1, np.bool_),
        np.zeros(view.u.size),
        np.zeros(view.u.size),
        np.zeros(view.u.size, np.uint16),
    )


@njit(**KERNEL)
def _copy(source: NDArray[Any], out: NDArray[Any]) -> None:
    for i in range(out.size):
        out[i] = source[i]


@njit(**KERNEL)
def _fill(out: NDArray[Any], value: float) -> None:
    for i in range(out.size):
        out[i] = value


@njit(**KERNEL)
def _locate_all(p: Packed, view: View, place: Reals, facets: Reals) -> None:
    """Locate all bodies where all rows have the same pose."""
    if view.axes.shape[0] == 1:
        for b in range(p.kind.size):
            locate(p, b, view.axes[0], view.origin[0], view.sod == np.inf, place[b], facets)


@njit(**KERNEL)
def _base(p: Packed, view: View, j: int, known: int, place: Reals, base: Reals) -> tuple[int, int, int]:
    """The sum of upright cylinders in row j, reused where row `known` has the same ones. Returns the row that it was
    computed for and, where it is new, the range of columns that is not air."""
    start, stop = view.first_round[j], view.first_round[j + 1]
    alike = view.axes.shape[0] == 1 and known >= 0
    if alike:
        other = view.first_round[known]
        alike = view.first_round[known + 1] - other == stop - start
        k = 0
        while alike and k < stop - start:
            alike = view.round[start + k] == view.round[other + k]
            k += 1
    if alike:
        return known, 0, 0
    _fill(base, 0.0)
    left, right = base.size, 0
    for k in range(start, stop):
        b = view.round[k]
        if view.axes.shape[0] > 1:
            locate(p, b, view.axes[j], view.origin[j], view.sod == np.inf, place[b], place[:0])
        if abs(view.v[j] - place[b, 2]) <= p.size[b, 1] + 1e-9 * view.pitch:
            first, end = upright_cylinder(base, view.u, 1.0 / view.pitch, place[b, 0], p.size[b, 0], p.attenuation[b])
            left, right = min(left, first), max(right, end)
    return j, left, max(left, right)


@njit(**KERNEL)
def _add_bodies(
    p: Packed, view: View, j: int, row: Reals, place: Reals, facets: Reals, lines: Reals, touched: NDArray[np.bool_]
) -> None:
    """Add all bodies but upright cylinders to a row; marks the tiles of columns that they shadow."""
    v, sod = view.v[j], view.sod
    rays = Row(row, view.u, 1.0 / view.pitch, v, sod)
    one, parallel = view.axes.shape[0] == 1, view.sod == np.inf
    axes, origin = view.axes[0 if one else j], view.origin[0 if one else j]
    left, right = row.size, 0
    for k in range(view.first[j], view.first[j + 1]):
        b = view.bodies[k]
        kind, a = p.kind[b], p.attenuation[b]
        if not one:
            locate(p, b, axes, origin, parallel, place[b], facets)
        if kind == CYLINDER:
            first, stop = leaning_cylinder(rays, p.size[b, 0], p.size[b, 1], a, axes, place[b])
        elif kind == ELLIPSOID and parallel:
            first, stop = ellipsoid(rays, place[b])
        elif kind == ELLIPSOID:
            first, stop = cone_ellipsoid(rays, p.matrix[b], a, axes, place[b])
        elif parallel:
            first, stop = polyhedron(rays, p, b, place[b], facets, lines)
        else:
            first, stop = cone_polyhedron(rays, p, b, axes, place[b], lines)
        if stop > first:
            left, right = min(left, first), max(right, stop)
            for tile in range(first // TILE, (stop - 1) // TILE + 1):
                touched[tile] = True
    if not parallel and left < right:  # from t to length
        part, at = row[left:right], view.u[left:right]
        square = sod * sod + v * v
        for i in range(part.size):
            part[i] *= math.sqrt(square + at[i] * at[i])


depth_rows, count_rows = _entries(_version())
