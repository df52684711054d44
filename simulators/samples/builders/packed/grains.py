"""Grains: crystals and secondary particles of a battery's cathode: sizes, habits, orientations, pores and cracks.

The habits are those of layered oxides by the synthesis (Ariyoshi et al.): octahedra, truncated octahedra, plates,
and the nearly spherical secondary particles of NMC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from simulators.samples.bodies.polyhedra import corners, octahedron, plate, truncated_octahedron
from simulators.samples.bodies.solids import Ellipsoid, Polyhedron, Quaternion, Vector

Grain = Ellipsoid | Polyhedron

Habit = Literal["sphere", "ellipsoid", "octahedron", "truncated_octahedron", "plate"]
TAIL = 2.5  # Standard deviations beyond which no size is drawn
HOLLOW, CRACK = 0.5, (0.95, 0.06)
"""Size of a pore over the grain's; radius and half width of a crack over the inscribed sphere's radius."""
MOST = 100_000  # Largest number of grains in a cell: this many take minutes to arrange
ROUNDEST, FLATTEST = 0.6, 0.85  # Least and largest cut of truncated octahedra; see `truncated_octahedron`


@dataclass(frozen=True)
class Sizes:
    """Diameters of spheres of the grains' volumes: log-normal, cut off at 2.5 standard deviations.

    Attributes:
        median: mm.
        spread: standard deviation of the logarithm.
    """

    median: float
    spread: float

    def draw(self, rng: np.random.Generator) -> float:
        while abs(deviation := rng.normal()) > TAIL:
            pass
        return self.median * math.exp(self.spread * deviation)


def grain(rng: np.random.Generator, habit: Habit, diameter: float, irregularity: float, aspect: float) -> Grain:
    """A grain at the origin, of the volume of a sphere of `diameter` (mm), in any orientation.

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
    """Grains until they take `volume` (mm³), to half a grain.

    Args:
        habits: shares of the grains' number, of any sum.

    Raises:
        ValueError: they would be more than MOST.
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
    """The pore of a hollow grain: its own shape, scaled down."""
    if isinstance(grain, Ellipsoid):
        a, b, c = grain.semi_axes
        return replace(grain, semi_axes=(HOLLOW * a, HOLLOW * b, HOLLOW * c))
    return replace(grain, vertices=corners(HOLLOW * np.array(grain.vertices)))


def crack(rng: np.random.Generator, grain: Grain) -> Ellipsoid:
    """A crack through a grain's middle: a flat ellipsoid within the grain's inscribed sphere."""
    radius = inner_radius(grain)
    w, x, y, z = rng.normal(size=4).tolist()
    wide, thin = CRACK[0] * radius, CRACK[1] * radius
    return Ellipsoid((wide, wide, thin), 1.0, grain.centre, (w, x, y, z))


def inner_radius(grain: Grain) -> float:
    """mm, of the largest sphere around a grain's centre that lies inside it."""
    return min(grain.semi_axes) if isinstance(grain, Ellipsoid) else float(grain.hull().distances.min())
