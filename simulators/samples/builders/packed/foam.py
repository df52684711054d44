"""Foam: a cylinder or box of material with many round holes that do not touch, placed from large to small.

Of many random points, each hole takes the one with most room. The idea is by Pelt, Hendriksen and Batenburg
("Foam-like phantoms for comparing tomography algorithms", J. Synchrotron Rad. 29, 2022).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from recon.base.setting import setting
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Gap, Micrometres, Millimetres
from simulators.samples.builders.packed.pieces import Piece, PieceBuilder, check_roles

Reals = NDArray[np.float64]

MADE_OF: Mapping[str, str] = MappingProxyType({"matter": "polypropylene", "hole": "air"})
POINTS_A_CELL = 8
GREY = 2.0
"""Attenuation of the material times half its width, in a beam without energies."""


@dataclass(frozen=True)
class Foam(PieceBuilder):
    """A foam around the rotation axis.

    Attributes:
        diameter, height: mm, of a cylinder.
        edges: mm (x, y, z), of a box instead.
        n_holes: largest number; fewer if no further hole of `smallest_um` fits.
        largest_um, smallest_um: diameters of holes.
        gap_um: least thickness of matter between holes and to the outside.
        candidates: number of random points; more of them make a denser foam. The largest number takes minutes and 2 GB.
        seed: of all random numbers.
    """

    diameter: Millimetres = 0.6
    height: Millimetres = 0.5
    edges: tuple[Millimetres, Millimetres, Millimetres] | None = None
    n_holes: int = setting(1000, ge=0, le=200_000)
    largest_um: Micrometres = 60.0
    smallest_um: Micrometres = 5.0
    gap_um: Gap = 1.0
    candidates: int = setting(200_000, ge=1, le=10_000_000)
    seed: int = 0

    default_materials: ClassVar[Mapping[str, str]] = MADE_OF

    def __post_init__(self) -> None:
        if not self.largest_um >= self.smallest_um:
            raise ValueError(f"largest_um must be at least smallest_um, got {self.largest_um}, {self.smallest_um}")
        check_roles(self)

    @property
    def default_attenuation(self) -> Mapping[str, float]:
        width = self.diameter if self.edges is None else max(self.edges[:2])
        return {"matter": GREY * 2 / width, "hole": 0.0}

    def pieces(self) -> tuple[Piece, ...]:
        """The material and its holes, the largest hole first."""
        rng = np.random.default_rng(self.seed)
        x, y, z = self.edges or (self.diameter, self.diameter, self.height)
        points = rng.uniform(-0.5, 0.5, (self.candidates, 3)) * (x, y, z)
        if self.edges is None:
            points = points[np.hypot(points[:, 0], points[:, 1]) < self.diameter / 2]
            wall = self.diameter / 2 - np.hypot(points[:, 0], points[:, 1])
            room = np.minimum(wall, z / 2 - np.abs(points[:, 2]))
            solid: Cylinder | Box = Cylinder(self.diameter / 2, self.height, 1.0)
        else:
            room = (np.array([x, y, z]) / 2 - np.abs(points)).min(axis=1)
            solid = Box(self.edges, 1.0)
        gap, largest = self.gap_um * 1e-3, self.largest_um * 0.5e-3
        radii = np.minimum(room - gap, largest)
        centres = holes(points, radii, self.smallest_um * 0.5e-3, gap, self.n_holes)
        return (
            Piece(solid, "matter"),
            *(
                Piece(Ellipsoid((radius,) * 3, 1.0, (px, py, pz)), "hole", "matter")
                for px, py, pz, radius in centres.tolist()
            ),
        )


def holes(points: Reals, radii: Reals, smallest: float, gap: float, n: int) -> Reals:
    """Non-touching balls (x, y, z, radius), float64 [ball, 4] in mm, from the largest to the smallest; n at most.

    Args:
        points: float64 [point, 3], candidates for centres.
        radii: float64 [point], largest radius at each without other balls.
        gap: between two balls, at least.
    """
    low = points.min(axis=0)
    span = np.maximum(points.max(axis=0) - low, 1e-12)
    edge = float((span.prod() * POINTS_A_CELL / len(points)) ** (1 / 3))
    while np.maximum(1, span / edge).prod() > len(points):  # thin or flat boxes would have too many cells
        edge *= 1.5
    cells = np.maximum(1, np.floor(span / edge)).astype(np.int64)
    size = span / cells * (1 + 1e-9)
    at = np.floor((points - low) / size).astype(np.int64)
    at = (at[:, 0] * cells[1] + at[:, 1]) * cells[2] + at[:, 2]
    order = np.argsort(at, kind="stable")
    first = np.searchsorted(at[order], np.arange(cells.prod() + 1))
    return _holes(points[order], radii[order].copy(), Cells(low, size, cells, first), smallest, gap, n)


class Cells(NamedTuple):
    """Boxes into which points are sorted.

    Attributes:
        low, size: float64 [3], mm, corner of the first cell and edges of a cell.
        number: int64 [3], number of cells along each axis.
        first: int64 [cell + 1], index of each cell's first point.
    """

    low: Reals
    size: Reals
    number: NDArray[np.int64]
    first: NDArray[np.int64]


@njit(cache=True, nogil=True)
def _holes(points: Reals, radii: Reals, grid: Cells, smallest: float, gap: float, n: int) -> Reals:
    """Points are sorted by cell. A new ball is at least as large as all later ones, so that it affects only points
    within two of its radii (and the gap)."""
    low, size, cells, first = grid
    queue = [(-radii[i], i) for i in range(radii.size) if radii[i] >= smallest]
    heapq.heapify(queue)
    out = np.empty((n, 4))
    found = 0
    start, stop = np.empty(3, np.int64), np.empty(3, np.int64)
    while found < n and len(queue) > 0:
        listed, i = heapq.heappop(queue)
        radius = radii[i]
        if radius < -listed:  # a ball has been placed nearby since
            if radius >= smallest:
                heapq.heappush(queue, (-radius, i))
            continue
        for a in range(3):
            out[found, a] = points[i, a]
            reach = 2 * radius + gap
            start[a] = max(math.floor((points[i, a] - reach - low[a]) / size[a]), 0)
            stop[a] = min(math.floor((points[i, a] + reach - low[a]) / size[a]) + 1, cells[a])
        out[found, 3] = radius
        found += 1
        for a in range(start[0], stop[0]):
            for b in range(start[1], stop[1]):
                row = (a * cells[1] + b) * cells[2]
                for j in range(first[row + start[2]], first[row + stop[2]]):
                    d2 = 0.0
                    for k in range(3):
                        d2 += (points[j, k] - points[i, k]) ** 2
                    radii[j] = min(radii[j], math.sqrt(d2) - radius - gap)
    return out[:found].copy()
