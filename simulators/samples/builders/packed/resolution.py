"""Resolution pattern: bars of given widths, a Siemens star and balls of decreasing size, in another material.

From below: balls in a row along x, the star across the rotation axis, and groups of bars. Vertical bars (side by side
along x) lie at y > 0, horizontal ones (above each other) at y < 0. Bars and the gaps between them are equally wide: a
line pair is twice a width. All places follow from the sizes; nothing is random.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, ClassVar

from pydantic import Field

from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Gap, Micrometres, Polyhedron, Vector
from simulators.samples.builders.packed.pieces import Piece, PieceBuilder, check_roles

MADE_OF: Mapping[str, str] = MappingProxyType({"carrier": "polypropylene", "bar": "Al", "star": "Al", "ball": "Al"})
GREY: Mapping[str, float] = MappingProxyType({"carrier": 0.5, "bar": 2.0, "star": 2.0, "ball": 2.0})
"""Attenuation times the carrier's radius, in a beam without energies."""
MOST_LISTED = 100
MARGIN = 1.1  # The carrier's size over that of its contents


@dataclass(frozen=True)
class Resolution(PieceBuilder):
    """A pattern around the rotation axis.

    Attributes:
        widths_um: of the bars, one group each; empty: no bars.
        bars: in a group, which is a cube.
        star_um: diameter of the star; 0: none. At a radius r a pair of spoke and gap is 2 π r / spokes wide.
        spokes: of the star.
        star_height_um: its thickness.
        balls_um: diameters; empty: no balls.
    """

    widths_um: tuple[Micrometres, ...] = (30.0, 20.0, 14.0, 10.0, 7.0, 5.0)
    bars: Annotated[int, Field(ge=2, le=100)] = 4
    star_um: Gap = 500.0
    spokes: Annotated[int, Field(ge=3, le=1000)] = 36
    star_height_um: Micrometres = 60.0
    balls_um: tuple[Micrometres, ...] = (60.0, 40.0, 28.0, 20.0, 14.0, 10.0, 7.0, 5.0)

    default_materials: ClassVar[Mapping[str, str]] = MADE_OF

    def __post_init__(self) -> None:
        if max(len(self.widths_um), len(self.balls_um)) > MOST_LISTED:
            raise ValueError(
                f"a pattern has {MOST_LISTED} widths and balls at most, got {len(self.widths_um)} and "
                f"{len(self.balls_um)}"
            )
        if not (self.widths_um or self.balls_um or self.star_um):
            raise ValueError("a pattern needs widths_um, a star_um or balls_um")
        check_roles(self)

    @property
    def default_attenuation(self) -> Mapping[str, float]:
        radius = self._size()[0]
        return {role: value / radius for role, value in GREY.items()}

    def pieces(self) -> tuple[Piece, ...]:
        """The carrier and its contents."""
        radius, height = self._size()
        z = -height / MARGIN / 2
        pieces = [Piece(Cylinder(radius, height, 1.0), "carrier")]
        for solids, role, tall in self._layers():
            for solid in solids:
                x, y, own = solid.centre
                pieces.append(Piece(replace(solid, centre=(x, y, own + (z + tall / 2))), role, "carrier"))
            z += tall
        return tuple(pieces)

    def _size(self) -> tuple[float, float]:
        """Radius and height of the carrier, mm."""
        layers = self._layers()
        reach = max(_reach(solid) for solids, _, _ in layers for solid in solids)
        return MARGIN * reach, MARGIN * sum(tall for _, _, tall in layers)

    def _layers(self) -> list[tuple[list[Box | Ellipsoid | Polyhedron], str, float]]:
        """The layers: solids of each, centred at its middle; their role; its height with the space around, mm."""
        layers: list[tuple[list[Box | Ellipsoid | Polyhedron], str, float]] = []
        if self.balls_um:
            sizes = [um * 1e-3 for um in self.balls_um]
            places = _row(sizes, max(sizes) / 2)
            balls = [Ellipsoid((d / 2,) * 3, 1.0, (x, 0.0, 0.0)) for d, x in zip(sizes, places, strict=True)]
            layers.append(([*balls], "ball", 1.5 * max(sizes)))
        if self.star_um:
            tall = self.star_height_um * 1e-3
            layers.append(([*self._star(tall)], "star", 1.5 * tall))
        if self.widths_um:
            cubes = [(2 * self.bars - 1) * um * 1e-3 for um in self.widths_um]
            groups: list[Box | Ellipsoid | Polyhedron] = []
            for um, cube, x in zip(self.widths_um, cubes, _row(cubes, max(cubes) / 4), strict=True):
                width, y = um * 1e-3, 0.625 * max(cubes)
                for bar in range(self.bars):
                    step = (2 * bar + 1 - self.bars) * width
                    groups.append(Box((width, cube, cube), 1.0, (x + step, y, 0.0)))
                    groups.append(Box((cube, cube, width), 1.0, (x, -y, step)))
            layers.append((groups, "bar", 1.25 * max(cubes)))
        return layers

    def _star(self, tall: float) -> list[Polyhedron]:
        """Spokes as prisms over triangles with a corner in the middle, each as wide as the gap beside it."""
        radius, half = self.star_um * 0.5e-3, math.pi / self.spokes / 2
        spokes = []
        for spoke in range(self.spokes):
            turn = 2 * math.pi * spoke / self.spokes
            triangle = [(0.0, 0.0)] + [
                (radius * math.cos(turn + side), radius * math.sin(turn + side)) for side in (-half, half)
            ]
            corners: tuple[Vector, ...] = tuple((x, y, z) for z in (-tall / 2, tall / 2) for x, y in triangle)
            spokes.append(Polyhedron(corners, 1.0))
        return spokes


def _row(sizes: list[float], space: float) -> list[float]:
    """Middles of objects of these sizes side by side with a space between, centred at 0."""
    ends = [sum(sizes[: i + 1]) + i * space for i in range(len(sizes))]
    return [end - size / 2 - ends[-1] / 2 for end, size in zip(ends, sizes, strict=True)]


def _reach(solid: Box | Ellipsoid | Polyhedron) -> float:
    """mm from the axis to the farthest point of a solid (of an ellipsoid's bounding sphere)."""
    x, y, _ = solid.centre
    match solid:
        case Box():
            return math.hypot(abs(x) + solid.edges[0] / 2, abs(y) + solid.edges[1] / 2)
        case Ellipsoid():
            return math.hypot(x, y) + max(solid.semi_axes)
    return max(math.hypot(px, py) for px, py, _ in solid.vertices)
