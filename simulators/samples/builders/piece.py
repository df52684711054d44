"""Piece: a solid with the part that it plays in a phantom."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from simulators.samples.bodies.solids import Solid


@dataclass(frozen=True)
class Piece:
    """Attributes:
    solid: its attenuation is not looked at.
    role: what it is: "wall", "particle", ...; its label too.
    instead_of: the role of what it displaces.
    """

    solid: Solid
    role: str
    instead_of: str | None = None


def check_roles(what: str, legal: Mapping[str, object], said: Mapping[str, object]) -> None:
    """Raises ValueError where a scene speaks of a role that the phantom does not have."""
    if unknown := [role for role in said if role not in legal]:
        raise ValueError(f"{what}: {unknown[0]!r} is no part of this phantom; its parts are {', '.join(legal)}")
