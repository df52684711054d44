"""Solids: reads the solids that a scene lists; each has an attenuation, or a material and the beam's energies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from simulators.frame.mapping import SceneError, build, choose, located
from simulators.light.beam import Beam
from simulators.samples.bodies.solids import SOLIDS
from simulators.samples.composed.parts import Part, sample_of
from simulators.samples.sample import Sample

if TYPE_CHECKING:
    from simulators.light.palette import Palette

_OWN_KEYS = ("material", "instead_of", "name")


@dataclass(frozen=True)
class _Keys:
    """The keys of the phantom. A solid's keys depend on its kind."""

    solids: tuple[Any, ...] | None
    materials: Any = None


def sample_of_solids(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    """The sample of a phantom's `solids` and `materials`; see simulators.light.palette for the latter.

    Args:
        where: path of the phantom, for messages.

    Raises:
        SceneError: a wrong solid or an unknown material.
        ValueError: a material in a beam that does not state its energies, or states some that are not tabulated.
    """
    keys = build(_Keys, where, mapping)
    entries = [(f"{where}.solids[{i}]", entry) for i, entry in enumerate(keys.solids or ())]
    used = {key for _, entry in entries if isinstance(entry, Mapping) for key in entry}
    palette = None
    if "materials" in mapping or used & {"material", "instead_of"}:
        from simulators.light.palette import palette_of

        palette = palette_of(f"{where}.materials", keys.materials)
    parts = [_part(at, entry, palette) for at, entry in entries]
    return sample_of(parts, beam, None if palette is None else palette.filters)


def _part(where: str, entry: Any, palette: Palette | None) -> Part:
    """`palette`: None where the scene names no material."""
    if not isinstance(entry, Mapping):
        return Part(choose(where, SOLIDS, entry))
    own = {key: entry[key] for key in _OWN_KEYS if key in entry}
    rest = {key: value for key, value in entry.items() if key not in _OWN_KEYS}
    if wrong := {key: value for key, value in own.items() if not isinstance(value, str)}:
        raise SceneError(f"{where}: {', '.join(wrong)} must be text, got {wrong}")
    if "material" in own and "attenuation" in rest:
        raise SceneError(f"{where}: attenuation and material exclude each other; give one of them")
    with located(where):
        materials = {key: palette(own[key]) for key in ("material", "instead_of") if palette and key in own}
        solid = choose(where, SOLIDS, rest | ({"attenuation": 1.0} if materials else {}))
        return Part(solid, **materials, name=own.get("name"))
