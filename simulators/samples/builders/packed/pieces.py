"""Phantoms out of pieces, which a change in time may move or charge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

from simulators.frame.mapping import SceneError, build, choose, located
from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.builders.packed.change import CHANGES
from simulators.samples.builders.piece import Piece, PieceBuilder
from simulators.samples.sample import Changing, Sample


def phantom(name: str, where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    """The sample of a scene's mapping: of materials if the beam has energies and the scene no attenuation.

    Args:
        name: of the kind.
        where: path of the phantom, for messages.

    Raises:
        SceneError: a wrong value. ValueError: pieces that cannot be placed.
    """
    kind = getattr(import_module(f"{__package__}.{name}"), name.capitalize())
    rest = {key: mapping[key] for key in mapping if key not in ("materials", "change")}
    settings: PieceBuilder = build(kind, where, rest)
    first = settings.pieces()
    of_materials = beam.has_energy and not settings.attenuation
    if not of_materials and (settings.made_of or "materials" in mapping):
        raise SceneError(f"{where}: materials need a beam with energies (energy_kev) and no attenuation")

    def made_of(pieces: Sequence[Piece]) -> Sample:
        if of_materials:
            material_of = {**settings.default_materials, **settings.made_of}
            return _of_materials(where, pieces, material_of, mapping.get("materials"), beam)
        return _grey(pieces, {**settings.default_attenuation, **settings.attenuation})

    if "change" not in mapping:
        return made_of(first)
    change = choose(f"{where}.change", CHANGES, mapping["change"])

    def at(seconds: float) -> Sample:
        with located(f"{where}.change"):
            return made_of(change.at(first, seconds))

    return Changing(at, at(0.0))


def _grey(pieces: Sequence[Piece], attenuation: Mapping[str, float]) -> Sample:
    """The pieces with an attenuation (1/mm) for each role, for any beam."""
    solids = []
    for piece in pieces:
        contrast = attenuation[piece.role] - attenuation.get(piece.instead_of or "", 0.0)
        solids.append(replace(piece.solid, attenuation=contrast * piece.solid.attenuation))
    return Phantom.of(solids, [piece.role for piece in pieces])


def _of_materials(
    where: str, pieces: Sequence[Piece], material_of: Mapping[str, str], materials: Any, beam: Beam
) -> Sample:
    """The pieces with a material for each role; `materials` are the scene's own, see `palette_of`."""
    from simulators.samples.materials.palette import palette_of
    from simulators.samples.materials.parts import Part, sample_of

    palette = palette_of(f"{where}.materials", materials)
    used = {role for piece in pieces for role in (piece.role, piece.instead_of) if role is not None}
    material_by_role = {role: palette(material_of[role]) for role in sorted(used)}
    parts = [
        Part(
            piece.solid,
            material_by_role[piece.role],
            material_by_role[piece.instead_of] if piece.instead_of else None,
            piece.role,
        )
        for piece in pieces
    ]
    return sample_of(parts, beam, palette.filters)
