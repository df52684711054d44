"""Battery: a small can with a wall, filled with electrolyte and about 150 dense particles that do not overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from simulators.samples.bodies.solids import (
    Box,
    Cylinder,
    Ellipsoid,
    Millimetres,
    Polyhedron,
    Solid,
    kind_of,
    octahedron,
)

# Attenuation times the can's radius: for any size of the can the largest line integral is between 1.5 and 3. At least
# 5 % of the beam is then transmitted.
WALL, ELECTROLYTE, PARTICLE = 0.9, 0.15, 1.9

CANDIDATES, ROUNDS = 256, 40


@dataclass(frozen=True)
class Battery:
    """Arguments of `battery` and the seed of its generator, as keys of a scene.

    5000 particles take a minute, and the work grows as their square.
    """

    field_of_view: tuple[Millimetres, Millimetres]
    n_particles: Annotated[int, Field(ge=0, le=5000)] = 150
    fill: Annotated[float, Field(gt=0, le=1)] = 0.12
    seed: int = 0

    def solids(self) -> tuple[Solid, ...]:
        return battery(np.random.default_rng(self.seed), self.field_of_view, self.n_particles, self.fill)


def labels_of(solids: Sequence[Solid]) -> list[str]:
    """The label of each solid of a battery: "tube" is the can's wall, "cylinder" the electrolyte."""
    particles = ("octahedron" if isinstance(solid, Polyhedron) else kind_of(solid) for solid in solids[2:])
    return ["tube", "tube", *particles]


def battery(
    rng: np.random.Generator,
    field_of_view: tuple[float, float] = (0.9, 0.9),
    n_particles: int = 150,
    fill: float = 0.12,
) -> tuple[Solid, ...]:
    """Solids of a cylindrical cell that fits into the field of view, with air on all sides.

    Half of the particles are ellipsoids, a third octahedra and the rest boxes (the habits of LiCoO2 crystals), in any
    orientation. Their sizes are log-normal. A particle's attenuation is its contrast to the electrolyte. The wall
    is a cylinder and, with its negative attenuation, its bore.

    Args:
        field_of_view: (width, height) in mm.
        n_particles: number of particles.
        fill: share of the electrolyte's volume that spheres of the particles' median radius would take.

    Raises:
        ValueError: too little room for the particles.
    """
    width, height = field_of_view
    radius, inside, tall = 0.44 * width, 0.95 * 0.44 * width, 0.9 * height
    wall = WALL / radius
    can = (Cylinder(radius, tall, wall), Cylinder(inside, tall, -wall), Cylinder(inside, tall, ELECTROLYTE / radius))
    if n_particles < 1:
        return can
    median = (fill * inside**2 * tall / (4 / 3 * n_particles)) ** (1 / 3)
    sizes = np.sort(median * np.exp(np.clip(rng.normal(0, 0.25, n_particles), -0.6, 0.45)))[::-1]
    shapes = [_particle(rng, size, PARTICLE / radius) for size in sizes]
    centres = _place(rng, np.array([reach for _, reach in shapes]), inside, tall / 2, gap=0.05 * median)
    return can + tuple(
        replace(body, centre=(x, y, z)) for (body, _), (x, y, z) in zip(shapes, centres.tolist(), strict=True)
    )


def _particle(rng: np.random.Generator, size: float, attenuation: float) -> tuple[Ellipsoid | Polyhedron | Box, float]:
    """A particle at the origin and the radius of the sphere around it; `size` is about the particle's radius in mm."""
    kind = rng.choice(3, p=(1 / 2, 1 / 3, 1 / 6))
    a, b, c = (size * rng.uniform(0.8, 1.2, 3)).tolist()
    w, x, y, z = rng.normal(size=4).tolist()
    if kind == 0:
        return Ellipsoid((a, b, c), attenuation, quaternion=(w, x, y, z)), max(a, b, c)
    if kind == 1:
        half = (1.2 * a, 1.2 * b, 1.2 * c)
        return Polyhedron(octahedron(half), attenuation, quaternion=(w, x, y, z)), max(half)
    edges = (1.7 * a, 1.7 * b, 0.7 * c)
    return Box(edges, attenuation, quaternion=(w, x, y, z)), float(np.linalg.norm(edges)) / 2


def _place(
    rng: np.random.Generator, reach: NDArray[np.float64], radius: float, half_height: float, gap: float
) -> NDArray[np.float64]:
    """Centres (x, y, z) [n, 3] of spheres with `gap` between each other and to the wall: random sequential addition in
    the given order (the largest first fill best).

    Raises:
        ValueError: one of them finds no room.
    """
    centres = np.empty((reach.size, 3))
    for i, own in enumerate(reach):
        for _ in range(ROUNDS):
            point = rng.uniform(-1, 1, (CANDIDATES, 3)) * (radius, radius, half_height - own - gap)
            clear = np.hypot(point[:, 0], point[:, 1]) < radius - own - gap
            dx, dy, dz = (point[clear, k, None] - centres[:i, k] for k in range(3))
            clear[clear] = (np.sqrt(dx * dx + dy * dy + dz * dz) > own + reach[:i] + gap).all(axis=1)
            if half_height - own - gap > 0 and clear.any():
                centres[i] = point[np.argmax(clear)]
                break
        else:
            raise ValueError(
                f"only {i} of {reach.size} particles find room in a can of {radius:.3g} x {2 * half_height:.3g} mm "
                f"(radius x height); lower fill or n_particles"
            )
    return centres
