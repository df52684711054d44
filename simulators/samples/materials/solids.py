"""Solids with materials: the sample that a scene's entries describe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from simulators.frame.mapping import SceneError, choose, located
from simulators.light.beam import Beam
from simulators.samples.bodies.solids import SOLIDS
from simulators.samples.materials.palette import Palette, palette_of
from simulators.samples.materials.parts import Part, sample_of
from simulators.samples.sample import Sample

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
    return sample_of([_part(at, entry, palette) for at, entry in entries], beam, palette.filters)


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
