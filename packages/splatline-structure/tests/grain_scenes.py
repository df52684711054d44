"""Thirty scenes with a ground truth: grains packed in a matrix, and the simulator's cathode. Twenty are for
development, ten were looked at only once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import recon
from recon import Geometry, Grid
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid, Solid
from simulators.samples.builders.packed.arrangement import arrange, bodies_of
from simulators.samples.builders.packed.cathode import Cathode

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Scene:
    """A sample and how it is measured.

    Attributes:
        kind: "packed" or "cathode".
        size: median diameter of grains in columns.
        wide: width of the sample over that of the field.
        method: of the reconstruction.
    """

    seed: int
    kind: str = "packed"
    views: int = 90
    photons: float = 1e4
    size: float = 11.0
    fill: float = 0.38
    wide: float = 0.9
    columns: int = 128
    rows: int = 32
    method: str = "fista-tv"

    @property
    def geometry(self) -> Geometry:
        angles = np.linspace(0, np.pi, self.views, endpoint=False)
        return Geometry.parallel(angles, (self.rows, self.columns), pixel_pitch=1.0)

    @property
    def grid(self) -> Grid:
        return Grid.matching(self.geometry)

    def phantom(self) -> Phantom:
        """Lengths in columns; the densest ray lets an eighth of the light through."""
        height, across, level = self.rows + 16.0, self.wide * self.columns, 2.0 / (self.wide * self.columns)
        if self.kind == "cathode":
            mu = {
                "particle": 1.6 * level,
                "electrolyte": 0.3 * level,
                "wall": level,
                "pore": 0.3 * level,
                "crack": 0.3 * level,
            }
            pieces = Cathode(
                diameter=across, height=height, wall_um=3e3, size_um=self.size * 1e3, fill=0.9 * self.fill,
                cracked=0.2, hollow=0.1, seed=self.seed,
            ).pieces()  # fmt: skip
            made = [
                replace(
                    each.solid,
                    attenuation=(mu[each.role] - mu.get(each.instead_of or "", 0.0)) * each.solid.attenuation,
                )
                for each in pieces
            ]
            return Phantom.of(made, [each.role for each in pieces])
        rng = np.random.default_rng(self.seed)
        n = round(self.fill * across**2 * height * np.pi / 4 / (np.pi / 6 * self.size**3 * np.exp(4.5 * 0.25**2)))
        axes = self.size / 2 * np.exp(0.25 * rng.normal(size=(n, 1)).clip(-2, 2)) * rng.uniform(0.85, 1.15, (n, 3))
        grains = [Ellipsoid(tuple(map(float, each)), 1.0) for each in axes]
        places = arrange(rng, bodies_of(grains), across / 2 - 1, height)
        levels = level * (1.6 + 0.08 * rng.integers(0, 2, n)) - 0.3 * level  # 5 % apart, of a grain
        solids: list[Solid] = [Cylinder(across / 2, height, 0.3 * level)]
        solids += [
            Ellipsoid(g.semi_axes, float(mu), tuple(map(float, at)))
            for g, at, mu in zip(grains, places, levels, strict=True)
        ]
        return Phantom.of(solids)

    def views_of(self, phantom: Phantom) -> F32:
        """Line integrals with the noise of photons, four rays a pixel."""
        rows, columns = self.rows, self.columns
        fine = Detector.centred((2 * rows, 2 * columns), 0.5)
        clean = np.stack([
            phantom.line_integrals(float(angle), fine).reshape(rows, 2, columns, 2).mean(axis=(1, 3))
            for angle in self.geometry.angles
        ])  # fmt: skip
        counts = np.random.default_rng(self.seed + 1000).poisson(self.photons * np.exp(-clean))
        return (-np.log(np.maximum(counts, 1) / self.photons)).astype(np.float32)

    def truth(self, phantom: Phantom) -> F32:
        return phantom.attenuation(self.grid)

    def reconstructed(self, data: F32) -> F32:
        return recon.reconstruct(data, self.geometry, self.method, grid=self.grid).volume.data


def _scenes(first: int) -> tuple[Scene, ...]:
    return (
        Scene(first, views=90), Scene(first + 1, views=45), Scene(first + 2, views=180, photons=1e3),
        Scene(first + 3, "cathode", views=90), Scene(first + 4, "cathode", views=45, photons=1e5),
        Scene(first + 5, views=90, wide=1.5), Scene(first + 6, "cathode", views=180, photons=1e3),
        Scene(first + 7, views=90, size=9, photons=1e5), Scene(first + 8, views=60, size=15),
        Scene(first + 9, "cathode", views=120, wide=1.5),
    )  # fmt: skip


BUILT_ON, BUILT_ON_TOO, LOOKED_AT_ONCE = _scenes(100), _scenes(200), _scenes(300)
