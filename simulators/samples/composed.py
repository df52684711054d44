"""Phantoms: builds the sample that the mapping of a scene names. The module of a kind of sample is imported only if a
scene names this kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from recon.base.registry import in_folders
from recon.base.setting import setting
from simulators.frame.mapping import SceneError, build, choose, located, named
from simulators.light import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import SOLIDS, Solid, kind_of
from simulators.samples.sample import Sample

if TYPE_CHECKING:
    from simulators.samples.sample import ReadVolume

    _Builder = Callable[[str, Mapping[str, Any], Beam, ReadVolume | None], Sample]

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simulators.samples.bodies.solids import (
    Box,
    Cylinder,
    Ellipsoid,
    Millimetres,
    Polyhedron,
    octahedron,
)

# Attenuation times the can's radius: for any size of the can the largest line integral is between 1.5 and 3. At least
# 5 % of the beam is then transmitted.
WALL, ELECTROLYTE, PARTICLE = 0.9, 0.15, 1.9

CANDIDATES, ROUNDS = 256, 40


@dataclass(frozen=True)
class Battery:
    """The keys of a scene for `battery`: its arguments, and the seed of its random generator.

    With 5000 particles the work takes a minute. It grows with the square of the number of particles.
    """

    field_of_view: tuple[Millimetres, Millimetres]
    n_particles: int = setting(150, ge=0, le=5000)
    fill: float = setting(0.12, gt=0, le=1)
    seed: int = 0

    def solids(self) -> tuple[Solid, ...]:
        return battery(np.random.default_rng(self.seed), self.field_of_view, self.n_particles, self.fill)


def labels_of(solids: Sequence[Solid]) -> list[str]:
    """The label of each solid of a battery: "tube" is the wall of the can, "cylinder" is the electrolyte."""
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
    consists of two solids: a cylinder, and its bore, which is a cylinder with the negative attenuation.

    Args:
        field_of_view: (width, height) in mm.
        n_particles: number of particles.
        fill: share of the electrolyte's volume that spheres of the particles' median radius would take.

    Raises:
        ValueError: there is too little space for the particles.
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
    """A particle at the origin, and the radius of the sphere around it. `size` is about the radius of the particle in
    mm.
    """
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
    """Centres (x, y, z) [n, 3] of spheres with a distance of `gap` from each other and from the wall. The method is
    random sequential addition in the given order; with the largest spheres first, most spheres fit.

    Raises:
        ValueError: there is no space for one of the spheres.
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
                f"lower fill or n_particles: only {i} of {reach.size} particles fit into a can of "
                f"{radius:.3g} x {2 * half_height:.3g} mm (radius x height)"
            )
    return centres


def build_sample(where: str, entry: Any, beam: Beam, read: ReadVolume | None = None) -> Sample:
    """The sample of a scene.

    Args:
        where: path of the entry, for messages.
        beam: the beam, whose energies decide how materials attenuate.
        read: function that reads the file of a volume; None: the sample cannot be a volume.

    Raises:
        SceneError: the kind is unknown, a value is wrong, or the sample cannot be built.
    """
    kind, mapping = named(where, list(_KINDS), entry)
    where = f"{where} ({kind})"
    with located(where):
        return _KINDS[kind](where, mapping, beam, read)


def _battery(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:

    solids = build(Battery, where, mapping).solids()
    return Phantom.of(solids, labels_of(solids))


@dataclass(frozen=True)
class _Keys:
    """The keys of a phantom of solids. A solid's keys depend on its kind."""

    solids: tuple[Any, ...] | None
    materials: Any = None


def _solids(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:
    """The sample of the `solids` of a phantom. The sample is grey if no key needs the module of another folder."""
    keys = build(_Keys, where, mapping)
    entries = [(f"{where}.solids[{i}]", entry) for i, entry in enumerate(keys.solids or ())]
    used = {*mapping, *(key for _, entry in entries if isinstance(entry, Mapping) for key in entry)}
    modules = in_folders("simulators.samples", "SOLID_KEYS")
    if names_of_modules := [module for key, module in modules.items() if key in used]:
        sample: Sample = import_module(names_of_modules[0]).phantom(where, entries, keys.materials, beam)
        return sample
    grey = [_grey(place, entry) for place, entry in entries]
    return Phantom.of([solid for solid, _ in grey], [name for _, name in grey])


def _grey(where: str, entry: Any) -> tuple[Solid, str]:
    """A solid and its label."""
    if not isinstance(entry, Mapping):
        solid = choose(where, SOLIDS, entry)
        return solid, kind_of(solid)
    name = entry.get("name", "")
    if not isinstance(name, str):
        raise SceneError(f"{where}: name must be text, got { {'name': name} }")
    with located(where):
        solid = choose(where, SOLIDS, {key: value for key, value in entry.items() if key != "name"})
        return solid, name or kind_of(solid)


def _read(
    name: str, module: str, where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None
) -> Sample:
    """A phantom that the module reads from a file, for example with `volume_sample` of VolumeSettings."""
    module_of_sample = import_module(module)
    settings = build(getattr(module_of_sample, f"{name.title()}Settings"), where, mapping)
    if read is None:
        raise ValueError(f"{settings.file} cannot be read: no reader of such files was given")
    sample: Sample = getattr(module_of_sample, f"{name}_sample")(settings, read)
    return sample


def _built(
    name: str, module: str, where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None
) -> Sample:
    """A phantom of pieces, made with `phantom` of the module."""
    sample: Sample = import_module(module).phantom(name, where, mapping, beam)
    return sample


_KINDS: Mapping[str, _Builder] = {
    "battery": _battery,
    "solids": _solids,
    **{name: partial(_built, name, at) for name, at in in_folders("simulators.samples.builders", "PHANTOMS").items()},
    **{name: partial(_read, name, at) for name, at in in_folders("simulators.samples", "PHANTOMS").items()},
}
