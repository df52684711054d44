"""Pieces: solids by the part that they play in a phantom, and what that part is made of: a material or a grey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.builders.piece import Piece
from simulators.samples.sample import Sample


def grey(pieces: Sequence[Piece], attenuation: Mapping[str, float]) -> Sample:
    """The pieces with one attenuation (1/mm) a role, whatever the beam."""
    solids = [
        replace(piece.solid, attenuation=attenuation[piece.role] - attenuation.get(piece.instead_of or "", 0.0))
        for piece in pieces
    ]
    return Phantom.of(solids, [piece.role for piece in pieces])


def of_materials(
    where: str, pieces: Sequence[Piece], made_of: Mapping[str, str], materials: object, beam: Beam
) -> Sample:
    """The pieces as their materials look in the beam.

    Args:
        where: path of the phantom, for messages.
        made_of: the name of a material for each role.
        materials: the scene's own; see simulators.light.palette.

    Raises:
        SceneError: an unknown material.
        ValueError: a beam whose energies are not tabulated.
    """
    from simulators.light.palette import palette
    from simulators.samples.composed.parts import Part, sample_of

    colours = palette(f"{where}.materials", materials)
    used = {role for piece in pieces for role in (piece.role, piece.instead_of) if role is not None}
    found = {role: colours(made_of[role]) for role in sorted(used)}
    parts = [
        Part(
            replace(piece.solid, attenuation=1.0),
            found[piece.role],
            found[piece.instead_of] if piece.instead_of else None,
            piece.role,
        )
        for piece in pieces
    ]
    return sample_of(parts, beam, colours.filters)
