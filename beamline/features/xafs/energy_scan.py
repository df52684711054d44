"""Energy scan: radiographs of a scene at several energies, and the regions with and without a material."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from beamline.config.tree import read
from beamline.core.errors import ConfigError
from beamline.features.xafs.contrast import ContrastRegions
from beamline.features.xafs.series import Series, line_integrals
from beamline.scenes.scene_file import open_scene
from beamline.simulate import volumes_beside
from simulators.frame.mapping import SceneError
from simulators.frame.sensor import largest_count
from simulators.light.beam import Beam
from simulators.samples.materials.parts import Mixture
from simulators.samples.materials.spectrum import Attenuation, light
from simulators.scenes.expose import Scan, expose
from simulators.scenes.scene import load_scene

Reals = NDArray[np.float64]

FLATS = 4
"""Frames without the sample before each energy's radiograph, as at a beamline: the beam changes with the energy."""
THICK = 0.5  # of the largest thickness: pixels with at least this much are inside the material
NEAR = 24  # pixels around the material that count as its surroundings


@dataclass(frozen=True, eq=False)
class EnergyScan:
    """A scene that is exposed at several energies. Created by `open_energy_scan`."""

    name: str  # of the scene
    scan: Scan
    sample: Mixture
    beam: Beam  # its light, of any energy
    energies: Reals  # keV, [n]
    angle: float  # of the stage, radians
    material: str  # whose contrast is measured
    regions: ContrastRegions  # of the material and its surroundings

    def series(self) -> Series:
        """Its radiographs, computed lazily."""
        title = f"{self.material} in {self.name}, simulated"
        own = [
            c.material for c in self.sample.constituents if c.material is not None and c.material.name == self.material
        ]
        elements = tuple(sorted({z for material in own for z, _ in material.fractions}))
        frames = self.frames(self.energies)
        return Series(title, self.energies.size, frames, self.regions, self.material, elements)

    def frames(self, energies: Reals) -> Iterator[tuple[float, Reals]]:
        """(keV, line integrals [row, col]) of each energy, with all the effects of the scene. First comes a dark level,
        then flats and a radiograph for each energy, in the scene's period. A pixel without light is +inf."""
        n_darks = max(self.scan.scene.scan.darks, 1)
        dark = np.mean([self._counts(n, beam=False, sample=False) for n in range(n_darks)], axis=0)
        number = n_darks
        for energy in energies.tolist():
            here = self._at(energy)
            flat = np.mean([here._counts(number + k, sample=False) for k in range(FLATS)], axis=0) - dark
            signal = here._counts(number + FLATS) - dark
            number += FLATS + 1
            yield energy, line_integrals(signal, flat)

    def _at(self, energy: float) -> EnergyScan:
        """The same scan at that energy."""
        beam = replace(self.beam, energy_kev=energy)
        matter = [m.attenuation for c in self.sample.constituents for m in (c.material, c.instead_of) if m is not None]
        spectrum = light(beam, matter, 2 * self.sample.radius, _no_filters)
        sample = self.sample.under(spectrum)
        scene = replace(self.scan.scene, sample=sample, beam=beam)
        return replace(self, scan=replace(self.scan, scene=scene), sample=sample)

    def _counts(self, number: int, beam: bool = True, sample: bool = True) -> Reals:
        """A frame of the standing stage, counts [row, col], NaN where they are the largest of the sensor."""
        time = number * self.scan.scene.scan.period_s
        shot = replace(
            self.scan.frame(len(self.scan) - self.scan.views).shot,
            angle=self.angle,
            angle_at=lambda at: self.angle,
            time=self.scan.start + time,
            elapsed=time,
            beam=beam,
            sample=sample,
            frame=number,
            view=0,
        )
        counts = expose(self.scan.scene, shot).astype(np.float64)
        counts[counts >= largest_count(shot.readout, shot.binning)] = np.nan
        return counts


def open_energy_scan(
    name: str,
    energies: Reals,
    material: str | None = None,
    angle: float = 0.0,
    seed: int = 0,
    charge: float | None = None,
) -> EnergyScan:
    """A scene, prepared for `energies` (keV).

    Args:
        name: a scene file, or the name of a shipped scene.
        material: whose contrast is measured; None: the one with a state of charge.
        angle: of the stage, radians.
        seed: of all random numbers.
        charge: the state of charge, 0 to 1, that the material has instead of its own; None: its own.

    Raises:
        ConfigError: there is no such scene, its sample is grey, or the material is not visible.
    """
    opened = open_scene(name)
    mapping = dict(read(opened.text, str(opened.path)).data)
    own = opened.scene.beam
    # With both ends of the range any phantom of materials is a mixture, whose chords are used for every energy.
    ends: dict[str, Any] = {"spectrum": [[float(energies.min()), 1.0], [float(energies.max()), 1.0]]}
    kept = {key: value for key, value in mapping["beam"].items() if key in ("photons_per_s", "sod", "sdd")}
    try:
        scene = load_scene(mapping | {"beam": kept | ends}, volumes_beside(opened.path.parent))
    except SceneError as error:
        raise ConfigError(f"{opened.path}: {error}. Nothing was simulated.") from None
    if not isinstance(scene.sample, Mixture):
        raise ConfigError(
            f"{opened.path}: no solid of the sample has a material, so that it is the same at every energy; give them "
            "material: instead of attenuation:. Nothing was simulated."
        )
    beam = Beam(own.photons_per_s, own.sod, own.sdd, float(energies.mean()), own.bandwidth, own.harmonics)
    chosen = _chosen(scene.sample, material)
    try:
        sample = scene.sample if charge is None else _charged(scene.sample, chosen, charge)
        scan = Scan.of(replace(scene, sample=sample), seed)
        regions = _regions(sample, chosen, scan, angle)
    except ValueError as error:
        raise ConfigError(f"{opened.path}: {chosen} cannot be compared: {error}. Nothing was simulated.") from None
    energy_scan = EnergyScan(opened.path.stem, scan, sample, beam, energies, angle, chosen, regions)
    try:
        for end in (float(energies.min()), float(energies.max())):
            sample = energy_scan._at(end).sample  # with bandwidth and harmonics, which may be outside the tables
            for constituent in sample.constituents:
                constituent.attenuation(sample.spectrum.energies)
    except ValueError as error:
        raise ConfigError(f"{opened.path}: {error}. Nothing was simulated.") from None
    return energy_scan


def _chosen(sample: Mixture, wanted: str | None) -> str:
    """The material to measure. Raises ConfigError: the scene lacks it, or several are possible."""
    present = {c.material.name: c.material for c in sample.constituents if c.material is not None}
    if wanted is None:
        charged = [name for name, material in present.items() if material.state_of_charge is not None]
        if len(charged) == 1:
            return charged[0]
        raise ConfigError(
            f"{len(charged)} materials of the scene have a state_of_charge; choose one with --material, "
            f"of {', '.join(present)}. Nothing was simulated."
        )
    if wanted not in present:
        raise ConfigError(f"The scene has no material {wanted!r}; it has {', '.join(present)}. Nothing was simulated.")
    return wanted


def _charged(sample: Mixture, name: str, charge: float) -> Mixture:
    """The same with another state of charge of a material. ValueError: it has none."""
    constituents = [
        replace(each, material=replace(each.material, state_of_charge=charge))
        if each.material is not None and each.material.name == name
        else each
        for each in sample.constituents
    ]
    return replace(sample, constituents=tuple(constituents))


def _regions(sample: Mixture, material: str, scan: Scan, angle: float) -> ContrastRegions:
    """Pixels with much of the material, and those near it without it, in the sample if possible, else in air."""
    thickness = sample.thickness(angle, scan.detector)
    mine = np.array([c.material is not None and c.material.name == material for c in sample.constituents])
    own = thickness[mine].sum(axis=0)
    if not own.max() > 0:
        raise ValueError("it is not in the field of view")
    inside = own >= THICK * own.max()
    near = binary_dilation(own > 0, iterations=min(NEAR, max(own.shape))) & (own == 0)
    matter = near & (thickness != 0).any(axis=0)
    return ContrastRegions(inside, matter if matter.any() else near, float(own[inside].mean()))


def _no_filters(name: str) -> Attenuation:
    raise AssertionError(f"an energy scan has no tube, and so no filter {name}")
