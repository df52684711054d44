"""Made of: solids of a scene that name materials, read into parts and seen in the scene's beam."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from simulators.frame.mapping import SceneError, choose
from simulators.light.beam import Beam
from simulators.light.palette import Palette, palette
from simulators.samples.bodies.solids import SOLIDS
from simulators.samples.composed.parts import Part, sample_of
from simulators.samples.sample import Sample

_OWN_KEYS = ("material", "instead_of", "name")


def sample_made_of(where: str, entries: Sequence[tuple[str, Any]], materials: Any, beam: Beam) -> Sample:
    """The sample of a scene's solids.

    Args:
        where: path of the phantom, for messages.
        entries: (path, entry) of each solid.
        materials: the scene's own; see simulators.light.palette.
        beam: what they are seen in.

    Raises:
        SceneError: a wrong solid, an unknown material, or a beam without energies.
    """
    colours = palette(f"{where}.materials", materials)
    parts = [_part(at, entry, colours) for at, entry in entries]
    try:
        return sample_of(parts, beam, colours.filters)
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def _part(where: str, entry: Any, colours: Palette) -> Part:
    if not isinstance(entry, Mapping):
        return Part(choose(where, SOLIDS, entry))  # which says what is wrong with it
    said = {key: entry[key] for key in _OWN_KEYS if key in entry}
    rest = {key: value for key, value in entry.items() if key not in _OWN_KEYS}
    if bad := {key: value for key, value in said.items() if not isinstance(value, str)}:
        raise SceneError(f"{where}: {', '.join(bad)} must be text, got {bad}")
    if "material" in said and "attenuation" in rest:
        raise SceneError(f"{where}: attenuation and material say the same thing twice; name one of them")
    try:
        made = {key: colours(said[key]) for key in ("material", "instead_of") if key in said}
        shape = rest | ({"attenuation": 1.0} if made else {})
        return Part(choose(where, SOLIDS, shape), **made, name=said.get("name"))
    except SceneError as error:
        raise SceneError(str(error) if str(error).startswith(where) else f"{where}: {error}") from None
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None
