"""Turns a scene, a file or a series of scans into curves of absorption over energy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from beamline.core.errors import ConfigError, DataError
from beamline.scenes.scene_file import open_scene
from simulators.frame.sensor import largest_count
from simulators.light import Beam
from simulators.samples.materials.parts import Mixture
from simulators.samples.materials.spectrum import light
from simulators.scenes.expose import Scan, expose
from splatline_spectral.contrast import (
    LEAST,
    ContrastRegions,
    Reals,
    Series,
    XafsCurve,
    contrast_of,
    curve_of,
    find_edge,
    line_integrals,
)
from splatline_spectral.measured import PixelBox, open_measured
from splatline_spectral.results import XafsResult

_FLATS = 4
"""Number of flats before the radiograph at each energy. Each energy needs its own, because the beam changes with it."""
_THICK = 0.5  # pixels with at least this fraction of the largest thickness are inside the material
_NEAR = 24  # pixels around the material that count as its surroundings


def series_of_scene(
    name: str, energies: Reals, material: str | None = None, seed: int = 0, charge: float | None = None
) -> Series:
    """The radiographs of a scene at `energies` (keV), computed lazily.

    Args:
        name: a scene file, or the name of a scene in the package.
        material: the material whose contrast is measured; None: the only one with a `state_of_charge`.
        seed: seed of all random numbers.
        charge: state of charge, 0 to 1, of the material; None: that of the scene.

    Raises:
        ConfigError: there is no such scene, its sample is grey, or the material is not visible.
    """
    own = open_scene(name).scene.beam
    # With both ends of the range, any phantom of materials becomes a mixture; its chords are used for every energy.
    ends: dict[str, Any] = {
        "photons_per_s": own.photons_per_s,
        "spectrum": [[energies.min(), 1.0], [energies.max(), 1.0]],
    }
    ends |= {key: getattr(own, key) for key in ("sod", "sdd") if getattr(own, key) is not None}
    opened = open_scene(name, [f"beam={{{', '.join(f'{key}: {_plain(value)}' for key, value in ends.items())}}}"])
    if not isinstance(opened.scene.sample, Mixture):
        raise ConfigError(
            f"{opened.path}: give the sample the key `material`: without a material, the sample looks the same at "
            "every energy."
        )
    beam = Beam(own.photons_per_s, own.sod, own.sdd, float(energies.mean()), own.bandwidth, own.harmonics)
    chosen = _chosen(opened.scene.sample, material)
    try:
        sample = opened.scene.sample if charge is None else _charged(opened.scene.sample, chosen, charge)
        scan = Scan.of(replace(opened.scene, sample=sample), seed)
        scene = _EnergyScan(scan, sample, beam)
        regions = _regions(sample, chosen, scan)
    except ValueError as error:
        raise ConfigError(
            f"{opened.path}: {chosen} cannot be compared with its surroundings: {error}. Nothing was simulated."
        ) from None
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
    """A scene that is exposed at several energies. `beam`: its beam, at any energy."""

    scan: Scan
    sample: Mixture
    beam: Beam

    def frames(self, energies: Reals) -> Iterator[tuple[float, Reals]]:
        """(keV, line integrals [row, col]) at each energy, with all effects of the scene. Darks come first, then flats
        and a radiograph for each energy, in the period of the scene. A pixel without beam is +inf."""
        number = max(self.scan.scene.scan.darks, 1)
        dark = np.mean([self._counts(n, beam=False, sample=False) for n in range(number)], axis=0)
        for energy in energies.tolist():
            here = self._at_energy(energy)
            flat = np.mean([here._counts(number + k, sample=False) for k in range(_FLATS)], axis=0) - dark
            signal = here._counts(number + _FLATS) - dark
            number += _FLATS + 1
            yield energy, line_integrals(signal, flat)

    def _at_energy(self, energy: float) -> _EnergyScan:
        """The same scan at that energy."""
        beam = replace(self.beam, energy_kev=energy)
        attenuations = [
            m.attenuation for c in self.sample.constituents for m in (c.material, c.instead_of) if m is not None
        ]
        sample = self.sample.under(light(beam, attenuations, 2 * self.sample.radius, _no_filters))
        scene = replace(self.scan.scene, sample=sample, beam=beam)
        return replace(self, scan=replace(self.scan, scene=scene), sample=sample)

    def _counts(self, number: int, beam: bool = True, sample: bool = True) -> Reals:
        """A frame with the stage at rest, as counts [row, col]. Pixels with the largest count of the sensor are NaN."""
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
    """The material to measure. Raises ConfigError if the scene does not have it, or if several are possible."""
    present = {c.material.name: c.material for c in sample.constituents if c.material is not None}
    charged = [name for name, each in present.items() if each.state_of_charge is not None]
    if wanted is None and len(charged) == 1:
        return charged[0]
    if wanted not in present:
        raise ConfigError(
            f"--material {wanted or 'is not given'}: choose one of the materials {', '.join(present)} "
            f"({len(charged)} of these materials have a state_of_charge). Nothing was simulated."
        )
    return str(wanted)


def _charged(sample: Mixture, name: str, charge: float) -> Mixture:
    """The sample with another state of charge of a material. Raises ValueError if the material has no state of
    charge."""
    constituents = [
        replace(each, material=replace(each.material, state_of_charge=charge))
        if each.material is not None and each.material.name == name
        else each
        for each in sample.constituents
    ]
    return replace(sample, constituents=tuple(constituents))


def _regions(sample: Mixture, material: str, scan: Scan) -> ContrastRegions:
    """Pixels with much of the material, and nearby pixels without it: in the sample if possible, else in air."""
    thickness = sample.thickness(0.0, scan.detector)
    mine = np.array([c.material is not None and c.material.name == material for c in sample.constituents])
    own = thickness[mine].sum(axis=0)
    if not own.max() > 0:
        raise ValueError("the material is not in the field of view")
    inside = own >= _THICK * own.max()
    near = binary_dilation(own > 0, iterations=min(_NEAR, max(own.shape))) & (own == 0)
    with_material = near & (thickness != 0).any(axis=0)
    return ContrastRegions(inside, with_material if with_material.any() else near, float(own[inside].mean()))


def _no_filters(name: str) -> Any:
    raise AssertionError(f"an energy scan has no tube, and therefore no filter {name}")


_MOST = 5000


@dataclass(frozen=True)
class Jobs:
    """The curves to compute for each source.

    Attributes:
        low, high, step: energies in keV; for a file, `low` and `high` select a part of its energies.
        material, seed, charges: used for a scene; without charges, the state of charge is that of the scene.
        regions, around, unit: used for a file; (row, end, column, end) of the material and of its surroundings.
    """

    low: float | None = None
    high: float | None = None
    step: float = 0.001
    material: str | None = None
    seed: int = 0
    charges: Sequence[float] = field(default=())
    regions: Sequence[PixelBox] = field(default=())
    around: PixelBox | None = None
    unit: str | None = None


def results_of(sources: Sequence[str], jobs: Jobs, progress: Callable[[int, int], object]) -> list[XafsResult]:
    """The curve and the edge of each source, region and state of charge.

    Args:
        progress: is called with the number of energies done, and of all energies of the curve.

    Raises:
        ConfigError, DataError: a scene or file is wrong, or has too few energies.
    """
    results = []
    for source in sources:
        is_scene = Path(source).suffix.lower() in (".yaml", ".yml", "") and not Path(source).is_dir()
        variants: Sequence[float | PixelBox | None] = (jobs.charges if is_scene else jobs.regions) or (None,)
        for variant in variants:
            with _opened(source, jobs, is_scene, variant) as series:
                curve = series if isinstance(series, XafsCurve) else _curve(series, progress)
                title = Path(source).name if isinstance(series, XafsCurve) else series.title
            if curve.energies.size < LEAST:
                raise DataError(
                    f"{source}: an edge needs {LEAST} energies, but only {curve.energies.size} can be used "
                    f"({curve.left_out.size} were too dark, too bright or without values). Nothing was written."
                )
            name = title if len(variants) == 1 else f"{title}, {variant}"
            edge = find_edge(curve.energies, curve.absorption)
            results.append(XafsResult(name, curve, edge, () if isinstance(series, XafsCurve) else series.elements))
    return results


@contextmanager
def _opened(source: str, jobs: Jobs, is_scene: bool, variant: float | PixelBox | None) -> Iterator[Series | XafsCurve]:
    if is_scene:
        charge = variant if isinstance(variant, float) else None
        yield series_of_scene(source, _grid(jobs), jobs.material, jobs.seed, charge)
    else:
        region = variant if isinstance(variant, tuple) else None
        span = jobs.low or 0.0, jobs.high or math.inf
        with open_measured(Path(source), span, region, jobs.around, jobs.unit) as opened:
            yield opened


def _grid(jobs: Jobs) -> Reals:
    """Energies from low to high, keV."""
    if jobs.low is None or jobs.high is None:
        raise ConfigError(
            "Give a range of energies for the scene, in keV, such as --from 8.30 --to 8.42. Nothing was simulated."
        )
    n = math.floor((jobs.high - jobs.low) / jobs.step * (1 + 1e-9) + 1e-9) + 1
    if not LEAST <= n <= _MOST:
        raise ConfigError(
            f"Change --from, --to or --step: from {jobs.low:g} to {jobs.high:g} keV in steps of {jobs.step:g} there "
            f"are {max(n, 0)} energies, but there must be {LEAST} to {_MOST}. Nothing was simulated."
        )
    return jobs.low + jobs.step * np.arange(n, dtype=np.float64)


def _curve(series: Series, progress: Callable[[int, int], object]) -> XafsCurve:
    energies, points = list[float](), list[tuple[float, float]]()
    for energy, frame in series.frames:
        energies.append(energy)
        points.append(contrast_of(frame, series.regions))
        progress(len(points), series.n)
    return curve_of(np.array(energies), points, series.regions)
