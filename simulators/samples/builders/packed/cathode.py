"""Cathode: grains packed in electrolyte in a can, with a current collector below and optionally a separator above."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal

import numpy as np

from recon.base.setting import Setting, setting
from simulators.frame.mapping import BelowOne, NotNegative, Positive, Share
from simulators.samples.bodies.solids import (
    Cylinder,
    Ellipsoid,
    Gap,
    Micrometres,
    Polyhedron,
    Quaternion,
    Vector,
    corners,
    octahedron,
    plate,
    truncated_octahedron,
)
from simulators.samples.builders.packed.arrangement import arrange, bodies_of
from simulators.samples.builders.packed.pieces import Piece, PieceBuilder, check_roles

Grain = Ellipsoid | Polyhedron

Habit = Literal["sphere", "ellipsoid", "octahedron", "truncated_octahedron", "plate"]
TAIL = 2.5  # Number of standard deviations beyond which no size is drawn
HOLLOW, CRACK = 0.5, (0.95, 0.06)
"""Size of a pore divided by the size of its grain; radius and half width of a crack divided by the radius of the
inscribed sphere."""
MOST = 100_000  # Largest number of grains in a cell; the arrangement of this number takes minutes
ROUNDEST, FLATTEST = 0.6, 0.85  # Least and largest cut of truncated octahedra; see `truncated_octahedron`
MADE_OF: Mapping[str, str] = MappingProxyType(
    {
        "wall": "Al",
        "electrolyte": "electrolyte",
        "collector": "Al",
        "separator": "separator",
        "particle": "LiCoO2",
        "pore": "electrolyte",
        "crack": "electrolyte",
        "gas": "air",
    }
)
"""Material of each part by default."""
GREY: Mapping[str, float] = MappingProxyType(
    {
        "wall": 0.9,
        "electrolyte": 0.15,
        "collector": 0.9,
        "separator": 0.1,
        "particle": 2.2,
        "pore": 0.15,
        "crack": 0.15,
        "gas": 0.0,
    }
)
"""Attenuation of each part times the radius of the can, for a beam without energies. With these values, a cathode of
any size with a fill of 0.45 transmits about 5 % at its thickest part.
"""


@dataclass(frozen=True)
class Sizes:
    """Sizes of the grains, as diameters of spheres with the same volume. The distribution is log-normal and cut off at
    2.5 standard deviations.

    Attributes:
        median: median diameter in mm.
        spread: standard deviation of the logarithm.
    """

    median: float
    spread: float

    def draw(self, rng: np.random.Generator) -> float:
        while abs(deviation := rng.normal()) > TAIL:
            pass
        return self.median * math.exp(self.spread * deviation)


def grain(rng: np.random.Generator, habit: Habit, diameter: float, irregularity: float, aspect: float) -> Grain:
    """A grain at the origin with a random orientation. It has the volume of a sphere with this `diameter` (mm).

    Args:
        irregularity: largest relative change of each axis, before all are scaled to the volume.
        aspect: width over thickness of plates.
    """
    volume = math.pi / 6 * diameter**3
    w, x, y, z = rng.normal(size=4).tolist()
    turned: Quaternion = (w, x, y, z)
    skew = rng.uniform(1 - irregularity, 1 + irregularity, 3)
    skew /= np.prod(skew) ** (1 / 3)

    def axes(size: float) -> Vector:
        a, b, c = (size * skew).tolist()
        return a, b, c

    match habit:
        case "sphere":
            return Ellipsoid((diameter / 2,) * 3, 1.0)
        case "ellipsoid":
            return Ellipsoid(axes(diameter / 2), 1.0, quaternion=turned)
        case "octahedron":
            return Polyhedron(octahedron(axes((3 * volume / 4) ** (1 / 3))), 1.0, quaternion=turned)
        case "truncated_octahedron":
            cut = rng.uniform(ROUNDEST, FLATTEST)
            size = (volume / 4 / (1 / 3 - (1 - cut) ** 3)) ** (1 / 3)
            return Polyhedron(truncated_octahedron(axes(size), cut), 1.0, quaternion=turned)
    width = (8 * aspect * volume / 3 / math.sqrt(3)) ** (1 / 3)
    return Polyhedron(plate(width, width / aspect), 1.0, quaternion=turned)


def grains(
    rng: np.random.Generator,
    volume: float,
    sizes: Sizes,
    habits: Mapping[Habit, float],
    irregularity: float,
    aspect: float,
) -> list[Grain]:
    """Make grains until their total volume is `volume` (mm³), to within half a grain.

    Args:
        habits: shares of the number of grains; the shares may have any sum.

    Raises:
        ValueError: there would be more than MOST grains.
    """
    names = list(habits)
    shares = np.array([habits[name] for name in names])
    largest = math.pi / 6 * (sizes.median * math.exp(TAIL * sizes.spread)) ** 3
    drawn: list[Grain] = []
    taken = 0.0
    while True:
        diameter = sizes.draw(rng)
        own = math.pi / 6 * diameter**3
        if taken + own / 2 > volume:
            return drawn
        if len(drawn) == MOST or volume > MOST * largest:
            raise ValueError(
                f"{volume:.3g} mm3 of grains of {1e3 * sizes.median:g} um are more than {MOST} grains; make the cell "
                "smaller, the grains larger or the fill lower"
            )
        habit: Habit = str(rng.choice(names, p=shares / shares.sum()))  # type: ignore[assignment]
        drawn.append(grain(rng, habit, diameter, irregularity, aspect))
        taken += own


def core(grain: Grain) -> Grain:
    """The pore of a hollow grain: the shape of the grain, scaled down."""
    if isinstance(grain, Ellipsoid):
        a, b, c = grain.semi_axes
        return replace(grain, semi_axes=(HOLLOW * a, HOLLOW * b, HOLLOW * c))
    return replace(grain, vertices=corners(HOLLOW * np.array(grain.vertices)))


def crack(rng: np.random.Generator, grain: Grain) -> Ellipsoid:
    """A crack through the middle of a grain: a flat ellipsoid within the inscribed sphere of the grain."""
    radius = inner_radius(grain)
    w, x, y, z = rng.normal(size=4).tolist()
    wide, thin = CRACK[0] * radius, CRACK[1] * radius
    return Ellipsoid((wide, wide, thin), 1.0, grain.centre, (w, x, y, z))


def inner_radius(grain: Grain) -> float:
    """Radius in mm of the largest sphere around a grain's centre that lies inside it."""
    return min(grain.semi_axes) if isinstance(grain, Ellipsoid) else float(grain.hull().distances.min())


@dataclass(frozen=True)
class Cathode(PieceBuilder):
    """A cell around the rotation axis.

    The largest fill depends on the grains: 0.55 for spheres, 0.45 for the default habits, 0.35 for octahedra or plates
    alone.

    Attributes:
        diameter, height: outer diameter and height of the can in mm. The can has neither lid nor bottom.
        wall_um: thickness of the wall of the can.
        size_um: median size of the grains, as the diameter of a sphere with the same volume.
        spread: standard deviation of the logarithm of the diameter. The distribution is cut off at 2.5 standard
            deviations. With a spread of 2, the largest grains are 20 000 times as large as the smallest.
        fill: share of the volume between collector and separator that the grains fill, including their pores and
            cracks. Random packings of balls jam at 0.64.
        habits: shares of the number of grains with each shape: sphere, ellipsoid, octahedron, truncated_octahedron and
            plate.
        irregularity: largest relative change of a grain's axes.
        aspect: width over thickness of plates.
        hollow, cracked: shares of the grains that have a hole of half their size, and that have a crack.
        gap_um: smallest gap between two grains.
        collector_um, separator_um: thickness of the foil below and of the film above; 0: none.
        seed: seed of all random numbers.
    """

    diameter: Positive = 0.6
    height: Positive = 0.5
    wall_um: Positive = 20.0
    size_um: Micrometres = 25.0
    spread: float = setting(0.25, ge=0, le=2)
    fill: float = setting(0.4, ge=0, lt=0.64)
    habits: Mapping[Habit, Annotated[float, Setting(ge=0, le=1e9)]] = field(
        default_factory=lambda: MappingProxyType(
            {"octahedron": 0.4, "truncated_octahedron": 0.25, "ellipsoid": 0.2, "plate": 0.15}
        )
    )
    irregularity: BelowOne = 0.1
    aspect: Positive = 3.0
    hollow: Share = 0.0
    cracked: Share = 0.0
    gap_um: Gap = 0.0
    collector_um: NotNegative = 0.0
    separator_um: NotNegative = 0.0
    seed: int = 0

    default_materials: ClassVar[Mapping[str, str]] = MADE_OF

    def __post_init__(self) -> None:
        if self.hollow + self.cracked > 1:
            raise ValueError(
                f"hollow and cracked are shares whose sum must be at most 1, got {self.hollow} and {self.cracked}"
            )
        if not sum(self.habits.values()) > 0:
            raise ValueError(f"habits are shares, not all 0, got {dict(self.habits)}")
        if not (self.inner_radius > 0 and self.bed_height > 0):
            raise ValueError(f"there is no room for the cathode inside {self.diameter} x {self.height} mm")
        check_roles(self)

    @property
    def inner_radius(self) -> float:
        """Inner radius of the can in mm."""
        return self.diameter / 2 - self.wall_um * 1e-3

    @property
    def bed_height(self) -> float:
        """Height of the space for the grains in mm."""
        return self.height - (self.collector_um + self.separator_um) * 1e-3

    @property
    def default_attenuation(self) -> Mapping[str, float]:
        return {role: value * 2 / self.diameter for role, value in GREY.items()}

    def pieces(self) -> tuple[Piece, ...]:
        """The can, its contents and the grains.

        Raises:
            ValueError: a grain is larger than the cell, or there is no room for all grains; see `arrange`.
        """
        rng = np.random.default_rng(self.seed)
        radius, bed = self.inner_radius, self.bed_height
        below, above = self.collector_um * 1e-3, self.separator_um * 1e-3
        cell = [
            Piece(Cylinder(self.diameter / 2, self.height, 1.0), "wall"),
            Piece(Cylinder(radius, self.height, -1.0), "wall"),
            Piece(Cylinder(radius, self.height, 1.0), "electrolyte"),
        ]
        if below:
            foil = Cylinder(radius, below, 1.0, (0.0, 0.0, (below - self.height) / 2))
            cell.append(Piece(foil, "collector", "electrolyte"))
        if above:
            film = Cylinder(radius, above, 1.0, (0.0, 0.0, (self.height - above) / 2))
            cell.append(Piece(film, "separator", "electrolyte"))
        sizes = Sizes(self.size_um * 1e-3, self.spread)
        wanted = self.fill * math.pi * radius**2 * bed
        loose = grains(rng, wanted, sizes, self.habits, self.irregularity, self.aspect)
        if not loose and self.fill:
            raise ValueError(
                f"a grain of {self.size_um:g} um is larger than the whole fill of {self.fill:g}; make the cell larger "
                "or the grains smaller"
            )
        if not loose:
            return tuple(cell)
        centres = arrange(rng, bodies_of(loose), radius, bed, self.gap_um * 1e-3)
        centres[:, 2] += (below - above) / 2
        for grain, (x, y, z) in zip(loose, centres.tolist(), strict=True):
            placed = replace(grain, centre=(x, y, z))
            cell.append(Piece(placed, "particle", "electrolyte"))
            fate = rng.uniform()
            if fate < self.hollow:
                cell.append(Piece(core(placed), "pore", "particle"))
            elif fate < self.hollow + self.cracked:
                cell.append(Piece(crack(rng, placed), "crack", "particle"))
        return tuple(cell)
