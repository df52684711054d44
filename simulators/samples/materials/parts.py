"""Parts: solids with materials, and the sample that they form in a given beam.

The attenuations of overlapping solids add up. So a part that displaces another material counts with the difference of
both attenuations. Grey parts have the same attenuation at every energy.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.volume import Grid
from simulators.frame.mapping import SceneError, choose, located
from simulators.frame.shot import Detector, Pose
from simulators.light import Beam
from simulators.pixels.bands import share_rows
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import SOLIDS, Solid, kind_of
from simulators.samples.materials.materials import Material, Palette, palette_of
from simulators.samples.materials.spectrum import Attenuation, Spectrum, light
from simulators.samples.sample import Sample

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """A solid and its material.

    Attributes:
        solid: without a material its attenuation is in 1/mm. With a material its attenuation is the share of its volume
            that the material fills, 1 for the whole volume. material: the material; None: the part is grey. instead_of:
            the material that the part displaces; None: it displaces no material. name: name of its label; None: the
            name of the material, or the kind of the solid.
    """

    solid: Solid
    material: Material | None = None
    instead_of: Material | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if self.material is None and self.instead_of is not None:
            raise ValueError(f"instead_of {self.instead_of.name!r} needs a material that displaces it")

    @property
    def label(self) -> str:
        return self.name or (self.material.name if self.material else kind_of(self.solid))


@dataclass(frozen=True, eq=False)
class Constituent:
    """One material in a sample.

    Attributes:
        chords: thickness of the material along a ray in mm; for a grey material, its optical depth.
        material: the material; None: it is grey.
        instead_of: the material that this material displaces.
    """

    chords: Sample
    material: Material | None = None
    instead_of: Material | None = None

    def attenuation(self, energies: ArrayLike) -> Reals:
        """Attenuation in 1/mm, minus the attenuation of the displaced material, at energies in keV; same shape as the
        energies."""
        if self.material is None:
            return np.ones(np.shape(energies))
        own = self.material.attenuation(energies)
        return own if self.instead_of is None else own - self.instead_of.attenuation(energies)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Constituents in a beam with a spectrum. The chords of each constituent are computed once for all energies.

    The ground truth is the attenuation of a thin layer: the mean over the photons detected in the open beam, which is
    the initial slope of the effective depth. Thicker material appears to attenuate less (beam hardening).

    Attributes:
        constituents: constituents of the sample.
        spectrum: energies and weights of the beam.
        whole: the sample with the attenuation of a thin layer.
    """

    constituents: tuple[Constituent, ...]
    spectrum: Spectrum
    whole: Sample

    @property
    def radius(self) -> float:
        return self.whole.radius

    @property
    def names(self) -> tuple[str, ...]:
        return self.whole.names

    def thickness(self, angle: ArrayLike | Pose, detector: Detector) -> Reals:
        """Thickness in mm of each constituent along each ray, float64 [constituent, row, col]."""
        return np.stack([c.chords.line_integrals(angle, detector) for c in self.constituents])

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> Reals:
        """The effective depth; see `effective_depth` and Sample.line_integrals."""
        attenuation = np.stack([c.attenuation(self.spectrum.energies) for c in self.constituents], axis=1)
        return effective_depth(self.thickness(angle, detector), attenuation, self.spectrum.weights)

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        return self.whole.attenuation(grid, supersample)

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        return self.whole.labels(grid)

    def under(self, spectrum: Spectrum) -> Mixture:
        """The same sample in another spectrum; its true attenuation remains that of the original spectrum."""
        return replace(self, spectrum=spectrum)


def sample_of(parts: Sequence[Part], beam: Beam, filters: Callable[[str], Attenuation] | None = None) -> Sample:
    """The sample that the parts form in the beam: a phantom for one energy, a mixture for more.

    Args:
        filters: the attenuation of a material by its name, for a tube; None: known materials only.

    Raises:
        ValueError: the sample has materials, but the beam does not state its energies, or states energies outside the
            tables.
    """
    names = [part.label for part in parts]
    kinds = dict.fromkeys((part.material, part.instead_of) for part in parts)
    if all(material is None for material, _ in kinds):
        return Phantom.of([part.solid for part in parts], names)
    groups = tuple(
        Constituent(Phantom.of([part.solid for part in parts if (part.material, part.instead_of) == kind]), *kind)
        for kind in kinds
    )
    reach = 2 * Phantom.of([part.solid for part in parts]).radius
    materials = dict.fromkeys(material for kind in kinds for material in kind if material is not None)
    spectrum = light(beam, [material.attenuation for material in materials], reach, filters or Palette().filters)
    thin = {kind: spectrum.mean(group.attenuation) for kind, group in zip(kinds, groups, strict=True)}
    solids = [
        replace(part.solid, attenuation=part.solid.attenuation * thin[part.material, part.instead_of]) for part in parts
    ]
    whole = Phantom.of(solids, names)
    return whole if spectrum.energies.size == 1 else Mixture(groups, spectrum, whole)


ROUNDING = 1e-14  # a smaller depth counts as air


def effective_depth(thickness: Reals, attenuation: Reals, weights: Reals) -> Reals:
    """The optical depth, float64 [row, col], that a detector measures if it integrates over all energies.

    It is -log(sum_e w_e exp(-sum_m attenuation[e, m] thickness[m])).

    Args:
        thickness: mm, float64 [constituent, row, col].
        attenuation: 1/mm, float64 [energy, constituent].
        weights: float64 [energy], of sum 1.
    """
    out = np.zeros(thickness.shape[1:])

    def work(first: int, end: int) -> None:
        chords = thickness[:, first:end]
        hit = (chords != 0.0).any(axis=0)  # air is exactly 0
        lengths = chords[:, hit]
        least = functools.reduce(np.minimum, (_through(lengths, mu) for mu in attenuation))
        intensity = np.zeros_like(least)  # the highest energy is factored out, so that the sum does not underflow
        for weight, mu in zip(weights, attenuation, strict=True):
            intensity += weight * np.exp(least - _through(lengths, mu))
        depth = least - np.log(intensity)
        out[first:end][hit] = np.where(np.abs(depth) < ROUNDING, 0.0, depth)

    share_rows(work, (thickness.shape[1], thickness.shape[2]))
    return out


def _through(lengths: Reals, attenuation: Reals) -> Reals:
    """Optical depth at one energy. BLAS is not used, because its sums depend on the position of a ray in the array."""
    return functools.reduce(np.add, (mu * thickness for mu, thickness in zip(attenuation, lengths, strict=True)))


_OWN_KEYS = ("material", "instead_of", "name")


def phantom(where: str, entries: Sequence[tuple[str, Any]], materials: Any, beam: Beam) -> Sample:
    """The sample of a phantom's solids.

    Args:
        where: path of the phantom, for messages.
        entries: path and mapping of each solid.
        materials: the scene's own, see `palette_of`.

    Raises:
        SceneError: a wrong entry. ValueError: the beam's energies do not suit the materials.
    """
    palette = palette_of(f"{where}.materials", materials)
    return sample_of([_part(place, entry, palette) for place, entry in entries], beam, palette.filters)


def _part(where: str, entry: Any, palette: Palette) -> Part:
    if not isinstance(entry, Mapping):
        return Part(choose(where, SOLIDS, entry))
    own = {key: entry[key] for key in _OWN_KEYS if key in entry}
    rest = {key: value for key, value in entry.items() if key not in _OWN_KEYS}
    if wrong := {key: value for key, value in own.items() if not isinstance(value, str)}:
        raise SceneError(f"{where}: {', '.join(wrong)} must be text, got {wrong}")
    if "material" in own and "attenuation" in rest:
        raise SceneError(f"{where}: attenuation and material exclude each other; give one of them")
    with located(where):
        named = {key: palette(own[key]) for key in ("material", "instead_of") if key in own}
        solid = choose(where, SOLIDS, rest | ({"attenuation": 1.0} if named else {}))
        return Part(solid, **named, name=own.get("name"))
