"""Arrangement: places convex bodies at random in a cylinder and moves them apart until no two overlap.

A force-biased packing (Mościński, Bargieł, Rycerz and Jacobs, Mol. Simul. 3, 1989): all bodies have their full size
from the beginning. Each overlapping pair is pushed apart along the direction in which it overlaps least. The bodies can
fill more than 0.5 of the volume; random sequential addition stops at 0.38. Bodies keep their orientation. Two bodies
count as apart only if a separating plane is known, so that no overlap is missed.

Each sweep enlarges a small difference between two starts, and numerical libraries round differently on other
processors. So bodies and starts are rounded first, and a seed gives the same places everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from simulators.samples.bodies.packing import ELLIPSOID, POLYHEDRON, pack
from simulators.samples.bodies.solids import Solid

Reals = NDArray[np.float64]
Wholes = NDArray[np.int64]

SWEEPS = 600
SPARE = 0.03
"""Extra distance by which bodies are moved apart, divided by the median reach."""
SKIN = 0.3
"""Margin within which the neighbours of a body are listed, divided by the median reach. One list is used for several
sweeps."""
TRIALS, DECAY = 12, 0.8
"""Number of directions that are tried for a separating plane until two bodies count as overlapping, and the ratio of
successive turns."""
FINEST = 2.0**-26
"""Bodies and starts are rounded to this part of the median reach, which is much larger than the rounding of a
double."""


class Bodies(NamedTuple):
    """Convex bodies, each symmetric about its centre, as flat arrays.

    Attributes:
        reach: float64 [n], mm, radius of the sphere around each body. across, up: float64 [n], mm, largest distance of
            a body from its own vertical axis, and half its height.
        spread: float64 [n, 3, 3], mm: an ellipsoid is this matrix times the unit ball; not used for others.
        first: int64 [n + 1]; body i has corners first[i] to first[i + 1] of `corners`; an ellipsoid has no corners.
        corners: float64 [corner, 3], mm from the centre.
    """

    reach: Reals
    across: Reals
    up: Reals
    spread: Reals
    first: Wholes
    corners: Reals


def bodies_of(solids: Sequence[Solid]) -> Bodies:
    """Ellipsoids and polyhedra without centres. Raises ValueError for other solids, and for bodies without point
    symmetry."""
    p = pack(solids)
    n = len(solids)
    if not np.isin(p.kind, (ELLIPSOID, POLYHEDRON)).all():
        raise ValueError("only ellipsoids and polyhedra can be moved apart")
    spread, reach, across = np.zeros((n, 3, 3)), np.zeros(n), np.zeros(n)
    for i in range(n):
        corners = p.vertices[p.first_vertex[i] : p.first_vertex[i + 1]]
        if p.kind[i] == ELLIPSOID:
            spread[i] = np.linalg.inv(p.matrix[i])
            reach[i] = np.linalg.norm(spread[i], 2)
            across[i] = np.linalg.norm(spread[i, :2], 2)
        else:
            reach[i] = np.linalg.norm(corners, axis=1).max()
            across[i] = np.hypot(corners[:, 0], corners[:, 1]).max()
            mirrored = np.abs(corners[:, None] + corners[None]).max(axis=2).min(axis=1)
            if mirrored.max() > 1e-9 * reach[i]:
                raise ValueError("a body must be symmetric about its centre to be moved apart from others")
    return Bodies(reach, across, p.extent[:, 2].copy(), spread, p.first_vertex, p.vertices)


def arrange(
    rng: np.random.Generator, bodies: Bodies, radius: float, height: float, gap: float = 0.0, sweeps: int = SWEEPS
) -> Reals:
    """Centres (x, y, z), float64 [n, 3] in mm, in an upright cylinder around the origin; wholly inside it.

    Args:
        gap: mm between two bodies, at least.
        sweeps: largest number of passes over all bodies.

    Raises:
        ValueError: a body or the sum of gaps is larger than the cylinder, or bodies still overlap at the end.
    """
    room, tall = radius - bodies.across, height / 2 - bodies.up
    if min(room.min(), tall.min()) < 0:
        raise ValueError(
            f"make the cell larger or the particles smaller: a particle of {2e3 * bodies.reach.max():.3g} "
            f"um does not fit into {2 * radius:.3g} x {height:.3g} mm (diameter x height)"
        )
    n = room.size
    # Balls of the gap's width around the centres must not overlap, either. This is checked first: if all bodies
    # were neighbours, the search would take hours.
    if n * gap**3 / 6 > (radius + gap / 2) ** 2 * (height + gap):
        raise ValueError(
            f"make the gap or the fill smaller: with a gap of {1e3 * gap:.3g} um, {n} particles do not "
            f"fit into {2 * radius:.3g} x {height:.3g} mm (diameter x height)"
        )
    turn, out = rng.uniform(0, 2 * math.pi, n), room * np.sqrt(rng.uniform(0, 1, n))
    centres = np.stack([out * np.cos(turn), out * np.sin(turn), tall * rng.uniform(-1, 1, n)], axis=1)
    middling = float(np.median(bodies.reach))
    step = FINEST * 2.0 ** math.floor(math.log2(middling))
    reach, across, up, spread, corners, room, tall, centres = (
        np.round(lengths / step) * step
        for lengths in (bodies.reach, bodies.across, bodies.up, bodies.spread, bodies.corners, room, tall, centres)
    )
    bodies = Bodies(reach, across, up, spread, bodies.first, corners)
    gap = max(gap, 1e-6 * middling)
    left = _part(centres, bodies, room, tall, gap, gap + SPARE * middling, SKIN * middling, sweeps)
    if left:
        raise ValueError(
            f"lower the fill, or use rounder particles: {left} of {n} particles still overlap in "
            f"{2 * radius:.3g} x {height:.3g} mm (diameter x height) after {sweeps} moves of all of them"
        )
    return centres


@njit(cache=True, nogil=True)
def _part(
    centres: Reals, bodies: Bodies, room: Reals, tall: Reals, gap: float, wanted: float, skin: float, sweeps: int
) -> int:
    """Moves the bodies apart, in place; returns the number of bodies that are still closer than `gap`.

    Pairs are moved to a distance of `wanted`, so that rounding leaves the gap."""
    n = centres.shape[0]
    room_for = wanted + skin
    pairs = _near(centres, bodies.reach, room_for)
    ways = np.zeros((pairs.shape[0], 3))
    work = np.empty((3, 3))
    listed = centres.copy()
    close = np.zeros(n, np.bool_)
    for _ in range(sweeps):
        close[:] = False
        for p in range(pairs.shape[0]):
            i, j = pairs[p]
            apart = _apart(centres, bodies, i, j, wanted, ways[p], work)
            if apart >= wanted:
                continue
            if apart < gap:
                close[i] = close[j] = True
            for k in range(3):
                step = 0.5 * (wanted - apart) * ways[p, k]
                centres[i, k] -= step
                centres[j, k] += step
            _keep_in(centres, bodies, i, room, tall)
            _keep_in(centres, bodies, j, room, tall)
        farthest = 0.0
        for i in range(n):
            went = 0.0
            for k in range(3):
                went += (centres[i, k] - listed[i, k]) ** 2
            farthest = max(farthest, went)
        if 4.0 * farthest > skin * skin:
            pairs = _near(centres, bodies.reach, room_for)
            ways = np.zeros((pairs.shape[0], 3))
            listed[:] = centres
        elif not close.any() and _all_apart(centres, bodies, pairs, ways, gap, work):
            return 0
    return max(close.sum(), 2)


@njit(cache=True, nogil=True)
def _all_apart(centres: Reals, bodies: Bodies, pairs: Wholes, ways: Reals, gap: float, work: Reals) -> bool:
    """True if all pairs are known to be apart at their present places."""
    for p in range(pairs.shape[0]):
        if _apart(centres, bodies, pairs[p, 0], pairs[p, 1], gap, ways[p], work) < gap:
            return False
    return True


@njit(cache=True, nogil=True)
def _near(centres: Reals, reach: Reals, room: float) -> Wholes:
    """Pairs of bodies [pair, 2] whose bounding spheres are closer than `room`, in order; the search uses cells."""
    n = centres.shape[0]
    edge = 2 * reach.max() + room
    low, cells, size = np.empty(3), np.empty(3, np.int64), np.empty(3)
    while True:
        for a in range(3):
            low[a] = centres[:, a].min()
            span = centres[:, a].max() - low[a]
            cells[a] = max(1, math.floor(min(span / edge, 512.0)))
            size[a] = max(span / cells[a], 1e-300)
        if cells[0] * cells[1] * cells[2] <= 8 * n + 64:
            break
        edge *= 1.25  # for few bodies most cells would be empty
    head, follow = np.full(cells[0] * cells[1] * cells[2], -1), np.empty(n, np.int64)
    home = np.empty((n, 3), np.int64)
    pairs, found = np.empty((32 * n, 2), np.int64), 0
    for i in range(n):
        for a in range(3):
            home[i, a] = min(max(math.floor((centres[i, a] - low[a]) / size[a]), 0), cells[a] - 1)
        for a in range(max(home[i, 0] - 1, 0), min(home[i, 0] + 2, cells[0])):
            for b in range(max(home[i, 1] - 1, 0), min(home[i, 1] + 2, cells[1])):
                for c in range(max(home[i, 2] - 1, 0), min(home[i, 2] + 2, cells[2])):
                    j = head[(a * cells[1] + b) * cells[2] + c]
                    while j >= 0:
                        d2 = 0.0
                        for k in range(3):
                            d2 += (centres[i, k] - centres[j, k]) ** 2
                        if d2 < (reach[i] + reach[j] + room) ** 2:
                            if found == pairs.shape[0]:
                                pairs = np.concatenate((pairs, np.empty_like(pairs)))
                            pairs[found, 0], pairs[found, 1] = j, i
                            found += 1
                        j = follow[j]
        at = (home[i, 0] * cells[1] + home[i, 1]) * cells[2] + home[i, 2]
        follow[i], head[at] = head[at], i
    return pairs[:found].copy()


@njit(cache=True, nogil=True)
def _keep_in(centres: Reals, bodies: Bodies, i: int, room: Reals, tall: Reals) -> None:
    """Moves a body back into the cylinder by its corners, or else by its largest radius."""
    c = centres[i]
    c[2] = min(max(c[2], -tall[i]), tall[i])
    first, last = bodies.first[i], bodies.first[i + 1]
    radius = room[i] + bodies.across[i]
    for turn in range(4):
        out = math.hypot(c[0], c[1])
        if out <= room[i]:
            return
        if first == last or turn == 3:
            c[0] *= room[i] / out
            c[1] *= room[i] / out
            return
        farthest = 0.0
        for q in range(first, last):
            farthest = max(farthest, math.hypot(c[0] + bodies.corners[q, 0], c[1] + bodies.corners[q, 1]))
        if farthest <= radius:
            return
        c[0] *= 1.0 - 1.001 * (farthest - radius) / out
        c[1] *= 1.0 - 1.001 * (farthest - radius) / out


@njit(cache=True, nogil=True)
def _apart(centres: Reals, bodies: Bodies, i: int, j: int, enough: float, way: Reals, work: Reals) -> float:
    """Largest known gap in mm between i and j along a direction, negative if they overlap.

    The search ends at `enough`. It begins at `way` (unit, from i to j, or zero), which becomes the best direction.

    The gap along a direction n is n · w, where w joins the support points of the two bodies along n; it grows where n
    turns towards w. This is subgradient ascent on the sphere with decreasing steps.
    """
    d, w, n = work[0], work[1], work[2]
    distance = 0.0
    for k in range(3):
        d[k] = centres[j, k] - centres[i, k]
        distance += d[k] * d[k]
    distance = math.sqrt(distance)
    if distance >= bodies.reach[i] + bodies.reach[j] + enough:
        return enough
    turn = 0.1
    if way[0] == 0.0 and way[1] == 0.0 and way[2] == 0.0:
        turn = 0.5
        for k in range(3):
            way[k] = d[k] / distance if distance > 0.0 else 1.0 if k == 2 else 0.0
    best = -np.inf
    n[:] = way
    for _ in range(TRIALS):
        gap = _gap(bodies, i, j, d, n[0], n[1], n[2], w)
        if gap > best:
            best = gap
            way[:] = n
            if best >= enough:
                break
        across = 0.0
        for k in range(3):
            w[k] -= gap * n[k]
            across += w[k] * w[k]
        if across < 1e-12 * distance * distance:
            break
        norm = 0.0
        for k in range(3):
            n[k] += turn / math.sqrt(across) * w[k]
            norm += n[k] * n[k]
        for k in range(3):
            n[k] /= math.sqrt(norm)
        turn *= DECAY
    return best


@njit(cache=True, nogil=True)
def _gap(bodies: Bodies, i: int, j: int, d: Reals, x: float, y: float, z: float, w: Reals) -> float:
    """Gap in mm along a direction between i and j, centres `d` apart; `w` becomes the difference of support points."""
    w[0], w[1], w[2] = d[0], d[1], d[2]
    for body in (i, j):  # symmetric bodies: the support point backwards is the negative of that forwards
        first, last = bodies.first[body], bodies.first[body + 1]
        if first == last:
            m = bodies.spread[body]
            a = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
            b = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
            c = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
            norm = math.sqrt(a * a + b * b + c * c)
            for k in range(3):
                w[k] -= (m[k, 0] * a + m[k, 1] * b + m[k, 2] * c) / norm
        else:
            farthest, corner = -np.inf, first
            for q in range(first, last):
                along = bodies.corners[q, 0] * x + bodies.corners[q, 1] * y + bodies.corners[q, 2] * z
                if along > farthest:
                    farthest, corner = along, q
            for k in range(3):
                w[k] -= bodies.corners[corner, k]
    return x * w[0] + y * w[1] + z * w[2]
