"""Facets: chords of one row's rays in a polyhedron: the gap between the faces where they leave and where they enter.

See chords for rays, units and arguments. The t (in a cone 1/t) at which a ray crosses a face is linear in the column.
The chord is the gap between the lowest line of the faces where rays leave, `lines` [0:2] (value at the middle, slope),
and the highest of those where they enter, `lines` [2:4]: a concave function of the column. In a cone, where 1/t
reverses the order, [0:2] are the faces where rays enter.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from simulators.samples.bodies.chords import EDGE_ON, KERNEL, Reals, Row, Span, columns, in_lab
from simulators.samples.bodies.packing import Packed


@njit(**KERNEL)
def polyhedron(rays: Row, p: Packed, b: int, place: Reals, facets: Reals, lines: Reals) -> Span:
    """Parallel rays; `lines` float64 [4, faces] is scratch memory."""
    row, u, per_mm, v, _ = rays
    dv = v - place[2]
    left, right, high, low = place[3], place[4], np.int64(0), np.int64(0)  # numba compiles twice for the literal 0
    for f in range(p.first_face[b], p.first_face[b + 1]):
        a, slope = facets[f, 0] - facets[f, 1] * dv, facets[f, 2]
        if facets[f, 3] > 0:
            lines[0, high], lines[1, high] = a, slope
            high += 1
        elif facets[f, 3] < 0:
            lines[2, low], lines[3, low] = a, slope
            low += 1
        else:  # n · (u, v) <= distance, for any t
            left, right = _bounded(left, right, slope, a)
    first, stop = _opened(u, per_mm, place[0], lines, high, low, left, right)
    if max(high, low) > 8:
        return _walk(rays, place[0], p.attenuation[b], lines, high, low, (first, stop))
    _add_gap(row[first:stop], u[first:stop], place[0], p.attenuation[b], lines, high, low)
    return first, stop


@njit(**KERNEL)
def cone_polyhedron(rays: Row, p: Packed, b: int, axes: Reals, place: Reals, lines: Reals) -> Span:
    """A cone's rays. With s = 1/t a face is n · (u, sod, v) <= s x (the source's distance from it), linear in u."""
    _, u, per_mm, v, sod = rays
    middle = place[0] * sod / (sod + place[1])
    front, back = sod / (sod + place[1] + place[5]), sod / (sod + place[1] + place[6])
    left, right = place[0] + place[3], place[0] + place[4]
    left, right = min(left * front, left * back) - middle, max(right * front, right * back) - middle
    high = low = np.int64(0)
    for f in range(p.first_face[b], p.first_face[b + 1]):
        nu, nb, nv = in_lab(p.faces[f], axes)
        inside = p.faces[f, 3] + nu * place[0] + nb * (sod + place[1]) + nv * place[2]
        at_middle = nu * middle + nb * sod + nv * v
        if abs(inside) < EDGE_ON * sod:
            left, right = _bounded(left, right, nu, -at_middle)
        elif inside < 0:
            lines[0, high], lines[1, high] = at_middle / inside, nu / inside
            high += 1
        else:
            lines[2, low], lines[3, low] = at_middle / inside, nu / inside
            low += 1
    first, stop = _opened(u, per_mm, middle, lines, high, low, left, right)
    return _walk(rays, middle, p.attenuation[b], lines, high, low, (first, stop))


@njit(**KERNEL)
def _opened(
    u: Reals, per_mm: float, middle: float, lines: Reals, high: int, low: int, left: float, right: float
) -> Span:
    """Columns within left..right where the gap is positive: by Newton's steps from both ends, which never overshoot."""
    if high == 0 or low == 0:  # all faces edge-on: a sliver left by rounding
        return 0, 0
    left = _step(lines, high, low, left, right, 1.0)
    if left < right:
        right = -_step(lines, high, low, -right, -left, -1.0)
    if not left < right:
        return 0, 0
    return columns(u, per_mm, middle + left, middle + right)


@njit(**KERNEL)
def _step(lines: Reals, high: int, low: int, at: float, end: float, way: float) -> float:
    """The first position between `at` and `end` where the gap is positive, or `end`; u - middle is way x at."""
    k = m = -1
    for _ in range(high + low):
        above, below, last_k, last_m = np.inf, -np.inf, k, m
        for i in range(high):
            height = lines[0, i] + lines[1, i] * way * at
            k = i if height < above else k
            above = min(above, height)
        for i in range(low):
            height = lines[2, i] + lines[3, i] * way * at
            m = i if height > below else m
            below = max(below, height)
        if above >= below or (k == last_k and m == last_m):
            break
        opens = (lines[1, k] - lines[3, m]) * way
        if opens <= 0.0:
            return end
        at = max(at, (lines[2, m] - lines[0, k]) / opens)
        if at >= end:
            return end
    return at


@njit(**KERNEL)
def _add_gap(row: Reals, u: Reals, middle: float, attenuation: float, lines: Reals, high: int, low: int) -> None:
    """Add attenuation x the gap; four or eight lines of each kind: a fixed number, for the processor's vector lanes."""
    most = 4 if max(high, low) <= 4 else 8
    for i in range(high, most):
        lines[0, i], lines[1, i] = np.inf, 0.0
    for i in range(low, most):
        lines[2, i], lines[3, i] = -np.inf, 0.0
    a0, a1, a2, a3 = lines[0, 0], lines[0, 1], lines[0, 2], lines[0, 3]
    b0, b1, b2, b3 = lines[1, 0], lines[1, 1], lines[1, 2], lines[1, 3]
    c0, c1, c2, c3 = lines[2, 0], lines[2, 1], lines[2, 2], lines[2, 3]
    d0, d1, d2, d3 = lines[3, 0], lines[3, 1], lines[3, 2], lines[3, 3]
    if most == 4:
        for i in range(row.size):
            x = u[i] - middle
            above = min(min(a0 + b0 * x, a1 + b1 * x), min(a2 + b2 * x, a3 + b3 * x))
            below = max(max(c0 + d0 * x, c1 + d1 * x), max(c2 + d2 * x, c3 + d3 * x))
            row[i] += attenuation * max(above - below, 0.0)
        return
    a4, a5, a6, a7 = lines[0, 4], lines[0, 5], lines[0, 6], lines[0, 7]
    b4, b5, b6, b7 = lines[1, 4], lines[1, 5], lines[1, 6], lines[1, 7]
    c4, c5, c6, c7 = lines[2, 4], lines[2, 5], lines[2, 6], lines[2, 7]
    d4, d5, d6, d7 = lines[3, 4], lines[3, 5], lines[3, 6], lines[3, 7]
    for i in range(row.size):
        x = u[i] - middle
        above = min(min(a0 + b0 * x, a1 + b1 * x), min(a2 + b2 * x, a3 + b3 * x))
        above = min(above, min(min(a4 + b4 * x, a5 + b5 * x), min(a6 + b6 * x, a7 + b7 * x)))
        below = max(max(c0 + d0 * x, c1 + d1 * x), max(c2 + d2 * x, c3 + d3 * x))
        below = max(below, max(max(c4 + d4 * x, c5 + d5 * x), max(c6 + d6 * x, c7 + d7 * x)))
        row[i] += attenuation * max(above - below, 0.0)


@njit(**KERNEL)
def _walk(rays: Row, middle: float, attenuation: float, lines: Reals, high: int, low: int, span: Span) -> Span:
    """Add attenuation x the gap in a range of columns, from kink to kink; in a cone the gap is that of t."""
    row, u, per_mm, _, sod = rays
    first, stop = span
    if first >= stop:
        return 0, 0
    k, m, above, below = 0, 0, np.inf, -np.inf
    for i in range(high):
        height = lines[0, i] + lines[1, i] * (u[first] - middle)
        k = i if height < above else k
        above = min(above, height)
    for i in range(low):
        height = lines[2, i] + lines[3, i] * (u[first] - middle)
        m = i if height > below else m
        below = max(below, height)
    begin = first
    while begin < stop:
        next_k, next_m, kink = k, m, np.inf
        for i in range(high):
            closing = lines[1, k] - lines[1, i]
            meets = (lines[0, i] - lines[0, k]) / closing if closing > 0.0 else np.inf
            next_k = i if meets < kink else next_k
            kink = min(kink, meets)
        for i in range(low):
            closing = lines[3, i] - lines[3, m]
            meets = (lines[2, m] - lines[2, i]) / closing if closing > 0.0 else np.inf
            next_m, next_k = (i, k) if meets < kink else (next_m, next_k)
            kink = min(kink, meets)
        end = min(stop, max(begin, columns(u, per_mm, -np.inf, middle + kink)[1]))
        part, where = row[begin:end], u[begin:end]
        if sod < np.inf:
            a, b, c, d = lines[0, k], lines[1, k], lines[2, m], lines[3, m]
            for i in range(part.size):
                s, z = a + b * (where[i] - middle), c + d * (where[i] - middle)
                part[i] += attenuation * max(s - z, 0.0) / (s * z)
        else:
            a, b = attenuation * (lines[0, k] - lines[2, m]), attenuation * (lines[1, k] - lines[3, m])
            for i in range(part.size):
                part[i] += a + b * (where[i] - middle)
        begin, k, m = end, next_k, next_m
    return first, stop


@njit(**KERNEL)
def _bounded(left: float, right: float, slope: float, limit: float) -> tuple[float, float]:
    """left..right where slope x (u - middle) <= limit."""
    if slope > 0.0:
        return left, min(right, limit / slope)
    if slope < 0.0:
        return max(left, limit / slope), right
    return left, right if limit >= 0.0 else -np.inf
