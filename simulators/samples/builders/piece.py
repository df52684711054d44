"""Piece: a solid with its role in a phantom, and the settings that give a material or an attenuation to each role."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, ClassVar, Protocol

from pydantic import Field

from recon.base.registry import unknown
from simulators.samples.bodies.solids import LEAST, MOST, Solid

Millimetres = Annotated[float, Field(ge=LEAST, le=MOST)]
Micrometres = Annotated[float, Field(ge=1e3 * LEAST, le=1e3 * MOST)]
Gap = Annotated[float, Field(ge=0, le=1e3 * MOST)]  # um


@dataclass(frozen=True)
class Piece:
    """Attributes:
    solid: its attenuation is the share of its volume that the role fills: 1, or -1 for a hole in the same role.
    role: "wall", "particle", ...; also its label.
    instead_of: the role of the displaced piece.
    """

    solid: Solid
    role: str
    instead_of: str | None = None


@dataclass(frozen=True, kw_only=True)
class PieceBuilder(Protocol):
    """Settings of a phantom made of pieces.

    Attributes:
        made_of: other materials for parts: {particle: NMC622, wall: steel}; for a beam with energies.
        attenuation: 1/mm of parts, for a beam without energies, or in place of all materials. If the scene gives any,
            no part has a material.
        default_materials: of each role, in a beam with energies.
    """

    made_of: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    attenuation: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    default_materials: ClassVar[Mapping[str, str]]

    @property
    def default_attenuation(self) -> Mapping[str, float]:
        """1/mm of each role, in a beam without energies."""

    def pieces(self) -> tuple[Piece, ...]:
        """All pieces. Raises ValueError where they cannot be placed."""


def check_roles(settings: PieceBuilder) -> None:
    """Raises ValueError if the scene names a role that the phantom lacks."""
    roles = settings.default_materials
    for key, named in (("made_of", settings.made_of), ("attenuation", settings.attenuation)):
        if others := [role for role in named if role not in roles]:
            raise ValueError(f"{key}: {unknown('part of this phantom', others[0], roles)}")
