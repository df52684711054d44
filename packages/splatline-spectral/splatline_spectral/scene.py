"""Scene: radiographs of a simulated sample at several energies, and the regions with and without a material."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from beamline.core.errors import ConfigError
from beamline.scenes.scene_file import open_scene
from simulators.frame.sensor import largest_count
from simulators.light.beam import Beam
from simulators.samples.materials.parts import Mixture
from simulators.samples.materials.spectrum import light
from simulators.scenes.expose import Scan, expose
from splatline_spectral.contrast import ContrastRegions, Reals, Series, line_integrals

_FLATS = 4
"""Frames without the sample before each energy's radiograph, as at a beamline: the beam changes with the energy."""
_THICK = 0.5  # of the largest thickness: pixels with at least this much are inside the material
_NEAR = 24  # pixels around the material that count as its surroundings


def series_of_scene(
    name: str, energies: Reals, material: str | None = None, seed: int = 0, charge: float | None = None
) -> Series:
    """The radiographs of a scene at `energies` (keV), computed lazily.

    Args:
        name: a scene file, or the name of a shipped scene.
        material: whose contrast is measured; None: the one with a state of charge.
        seed: of all random numbers.
        charge: the state of charge, 0 to 1, that the material has instead of its own; None: its own.

    Raises:
        ConfigError: there is no such scene, its sample is grey, or the material is not visible.
    """
    own = open_scene(name).scene.beam
    # With both ends of the range any phantom of materials is a mixture, whose chords are used for every energy.
    ends: dict[str, Any] = {
        "photons_per_s": own.photons_per_s,
        "spectrum": [[energies.min(), 1.0], [energies.max(), 1.0]],
    }
    ends |= {key: getattr(own, key) for key in ("sod", "sdd") if getattr(own, key) is not None}
    opened = open_scene(name, [f"beam={{{', '.join(f'{key}: {_plain(value)}' for key, value in ends.items())}}}"])
    if not isinstance(opened.scene.sample, Mixture):
        raise ConfigError(f"{opened.path}: the sample has no material:, so that it is the same at every energy.")
    beam = Beam(own.photons_per_s, own.sod, own.sdd, float(energies.mean()), own.bandwidth, own.harmonics)
    chosen = _chosen(opened.scene.sample, material)
    try:
        sample = opened.scene.sample if charge is None else _charged(opened.scene.sample, chosen, charge)
        scan = Scan.of(replace(opened.scene, sample=sample), seed)
        scene = _EnergyScan(scan, sample, beam)
        regions = _regions(sample, chosen, scan)
    except ValueError as error:
        raise ConfigError(f"{opened.path}: {chosen} cannot be compared: {error}. Nothing was simulated.") from None
    fractions = [
        c.material.fractions for c in sample.constituents if c.material is not None and c.material.name == chosen
    ]
    elements = tuple(sorted({z for own_fractions in fractions for z, _ in own_fractions}))
    title = f"{chosen} in {opened.path.stem}, simulated"
    return Series(title, energies.size, scene.frames(energies), regions, elements)


def _plain(value: Any) -> str:
    return str(np.asarray(value, float).tolist())


@dataclass(frozen=True, eq=False)
class _EnergyScan:
    """A scene that is exposed at several energies; `beam`: its light, of any energy."""

    scan: Scan
    sample: Mixture
    beam: Beam

    def frames(self, energies: Reals) -> Iterator[tuple[float, Reals]]:
        """(keV, line integrals [row, col]) of each energy, with all the effects of the scene. First comes a dark level,
        then flats and a radiograph for each energy, in the scene's period. A pixel without light is +inf."""
        number = max(self.scan.scene.scan.darks, 1)
        dark = np.mean([self._counts(n, beam=False, sample=False) for n in range(number)], axis=0)
        for energy in energies.tolist():
            here = self._at(energy)
            flat = np.mean([here._counts(number + k, sample=False) for k in range(_FLATS)], axis=0) - dark
            signal = here._counts(number + _FLATS) - dark
            number += _FLATS + 1
            yield energy, line_integrals(signal, flat)

    def _at(self, energy: float) -> _EnergyScan:
        """The same scan at that energy."""
        beam = replace(self.beam, energy_kev=energy)
        matter = [m.attenuation for c in self.sample.constituents for m in (c.material, c.instead_of) if m is not None]
        sample = self.sample.under(light(beam, matter, 2 * self.sample.radius, _no_filters))
        scene = replace(self.scan.scene, sample=sample, beam=beam)
        return replace(self, scan=replace(self.scan, scene=scene), sample=sample)

    def _counts(self, number: int, beam: bool = True, sample: bool = True) -> Reals:
        """A frame of the standing stage, counts [row, col], NaN where they are the largest of the sensor."""
        time = number * self.scan.scene.scan.period_s
        first = self.scan.frame(len(self.scan) - self.scan.views).shot
        shot = replace(
            first, angle=0.0, angle_at=lambda at: 0.0, time=self.scan.start + time, elapsed=time, beam=beam,
            sample=sample, frame=number, view=0,
        )  # fmt: skip
        counts = expose(self.scan.scene, shot).astype(np.float64)
        counts[counts >= largest_count(shot.readout, shot.binning)] = np.nan
        return counts


def _chosen(sample: Mixture, wanted: str | None) -> str:
    """The material to measure. Raises ConfigError: the scene lacks it, or several are possible."""
    present = {c.material.name: c.material for c in sample.constituents if c.material is not None}
    charged = [name for name, each in present.items() if each.state_of_charge is not None]
    if wanted is None and len(charged) == 1:
        return charged[0]
    if wanted not in present:
        raise ConfigError(
            f"--material {wanted or 'is not given'}: the scene has {', '.join(present)}, {len(charged)} of them with a "
            "state_of_charge. Nothing was simulated."
        )
    return str(wanted)


def _charged(sample: Mixture, name: str, charge: float) -> Mixture:
    """The same with another state of charge of a material. ValueError: it has none."""
    constituents = [
        replace(each, material=replace(each.material, state_of_charge=charge))
        if each.material is not None and each.material.name == name
        else each
        for each in sample.constituents
    ]
    return replace(sample, constituents=tuple(constituents))


def _regions(sample: Mixture, material: str, scan: Scan) -> ContrastRegions:
    """Pixels with much of the material, and those near it without it, in the sample if possible, else in air."""
    thickness = sample.thickness(0.0, scan.detector)
    mine = np.array([c.material is not None and c.material.name == material for c in sample.constituents])
    own = thickness[mine].sum(axis=0)
    if not own.max() > 0:
        raise ValueError("it is not in the field of view")
    inside = own >= _THICK * own.max()
    near = binary_dilation(own > 0, iterations=min(_NEAR, max(own.shape))) & (own == 0)
    matter = near & (thickness != 0).any(axis=0)
    return ContrastRegions(inside, matter if matter.any() else near, float(own[inside].mean()))


def _no_filters(name: str) -> Any:
    raise AssertionError(f"an energy scan has no tube, and so no filter {name}")
