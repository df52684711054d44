"""Pieces: solids with their roles in a phantom. A change in time may move them or change their charge."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import import_module
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np

from recon.base.registry import unknown
from recon.base.setting import Setting, setting
from simulators.frame.mapping import SceneError, build, choose, located
from simulators.light import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Solid
from simulators.samples.sample import Changing, Sample, TruthTable


@dataclass(frozen=True)
class Piece:
    """Attributes: solid: the solid. Its attenuation is the share of its volume that the role fills: 1, or -1 for a hole
    in the same role. role: "wall", "particle", ...; the role is also the label. instead_of: the role of the displaced
    piece.
    """

    solid: Solid
    role: str
    instead_of: str | None = None


@dataclass(frozen=True, kw_only=True)
class PieceBuilder(Protocol):
    """Settings of a phantom made of pieces.

    Attributes:
        made_of: other materials for parts: {particle: NMC622, wall: steel}; for a beam with energies. attenuation:
            attenuation of parts in 1/mm, for a beam without energies, or to replace all materials. If the scene gives
            an attenuation, no part has a material. default_materials: material of each role in a beam with energies.
    """

    made_of: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    attenuation: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    default_materials: ClassVar[Mapping[str, str]]

    @property
    def default_attenuation(self) -> Mapping[str, float]:
        """Attenuation of each role in 1/mm, in a beam without energies."""

    def pieces(self) -> tuple[Piece, ...]:
        """All pieces. Raises ValueError if there is no room for them."""


def check_roles(settings: PieceBuilder) -> None:
    """Raises ValueError if the scene names a role that the phantom lacks."""
    roles = settings.default_materials
    for key, named in (("made_of", settings.made_of), ("attenuation", settings.attenuation)):
        if others := [role for role in named if role not in roles]:
            raise ValueError(f"{key}: {unknown('part of this phantom', others[0], roles)}")


class PieceChange(Protocol):
    """A change of pieces in time."""

    def moment(self, seconds: float) -> float:
        """What `at` takes `seconds` s after the camera was connected; while it stays the same, so do the pieces."""

    def at(self, pieces: Sequence[Piece], moment: float) -> tuple[Piece, ...]:
        """The pieces at a moment. Raises ValueError if pieces of this kind cannot change."""

    def table(self, pieces: Sequence[Piece]) -> TruthTable:
        """The truth of each particle at the beginning; empty: voxels tell all."""


_Seconds = Annotated[float, Setting(ge=0, le=1e6)]
_Over = Annotated[float, Setting(gt=0, le=1e6)]


class _InTime:
    """A change whose moments are seconds."""

    def moment(self, seconds: float) -> float:
        return seconds

    def table(self, pieces: Sequence[Piece]) -> TruthTable:
        return {}


@dataclass(frozen=True)
class Settle(_InTime):
    """All matter sinks towards the lowest point, and holes shrink as much: a foam that loses gas and liquid.

    Heights above the bottom, and the widths of holes, are multiplied by 1 - share (1 - exp(-t / over_s)). So holes that
    do not touch never do. The attenuation of the matter stays.

    Attributes:
        share: of the height that is lost in the end.
        from_s: s since the camera was connected, when it begins.
        over_s: s, time constant.
    """

    share: float = setting(0.2, gt=0, lt=1)
    from_s: _Seconds = 0.0
    over_s: _Over = 10.0

    def at(self, pieces: Sequence[Piece], seconds: float) -> tuple[Piece, ...]:
        past = max(seconds - self.from_s, 0.0)
        left = 1 + self.share * math.expm1(-past / self.over_s)
        bottom = min(_bottom(piece) for piece in pieces)
        return tuple(replace(piece, solid=_sunk(piece, left, bottom)) for piece in pieces)


def _bottom(piece: Piece) -> float:
    solid = piece.solid
    if isinstance(solid, Ellipsoid):
        return solid.centre[2] - max(solid.semi_axes)
    if isinstance(solid, Cylinder):
        return solid.centre[2] - solid.height / 2
    if isinstance(solid, Box):
        return solid.centre[2] - solid.edges[2] / 2
    raise ValueError(f"a {type(solid).__name__.lower()} does not settle: cylinders, boxes and ellipsoids do")


def _sunk(piece: Piece, factor: float, bottom: float) -> Ellipsoid | Cylinder | Box:
    solid = piece.solid
    assert isinstance(solid, Ellipsoid | Cylinder | Box)  # `_bottom` refuses others
    x, y, z = solid.centre
    centre = (x, y, bottom + factor * (z - bottom))
    if isinstance(solid, Ellipsoid):
        a, b, c = solid.semi_axes
        return replace(solid, semi_axes=(factor * a, factor * b, factor * c), centre=centre)
    if isinstance(solid, Cylinder):
        return replace(solid, height=factor * solid.height, centre=centre)
    return replace(solid, edges=(*solid.edges[:2], factor * solid.edges[2]), centre=centre)


@dataclass(frozen=True)
class Charge(_InTime):
    """Pieces of one role change their attenuations, each at its own time, like particles of a battery that charge.

    The default factor is for tests of methods: the attenuation of LiCoO2 away from an edge falls by 2 to 4 % on
    charging, so that a real cathode has a factor of 0.96 to 0.98. `cycle` changes as much as a real one.

    The attenuation of a piece is multiplied by 1 + (factor - 1) s, and s rises from 0 to 1 as a logistic curve. Its
    middle is drawn between `from_s` and `from_s + over_s`; its width is `each_s`.

    Attributes:
        role: role of the pieces. factor: factor by which the attenuation is multiplied at the end. from_s: time at
            which the first piece may charge, s since the camera was connected. over_s: s from then until the last piece
            charges. each_s: s that a piece takes from 27 to 73 %. seed: seed of the times.
    """

    role: str = "particle"
    factor: float = setting(0.5, gt=0, le=100)
    from_s: _Seconds = 0.0
    over_s: _Over = 10.0
    each_s: _Over = 1.0
    seed: int = 0

    def at(self, pieces: Sequence[Piece], seconds: float) -> tuple[Piece, ...]:
        if self.role not in {piece.role for piece in pieces}:
            raise ValueError(f"role: {self.role!r} is not a part of this phantom")
        moments = self.from_s + self.over_s * np.random.default_rng(self.seed).uniform(size=len(pieces))
        done = 0.5 * (1 + np.tanh((seconds - moments) / self.each_s / 2))
        return tuple(
            replace(piece, solid=replace(piece.solid, attenuation=piece.solid.attenuation * factor))
            if piece.role == self.role
            else piece
            for piece, factor in zip(pieces, (1 + (self.factor - 1) * done).tolist(), strict=True)
        )


def _changes() -> Mapping[str, type[PieceChange]]:
    """Every change by the name that scenes use."""
    cycle: type[PieceChange] = import_module(f"{__package__}.cycle").Cycle  # its module imports this one
    return {"settle": Settle, "charge": Charge, "cycle": cycle}


def phantom(name: str, where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    """The sample of a scene's mapping: of materials if the beam has energies and the scene no attenuation.

    Args:
        name: of the kind.
        where: path of the phantom, for messages.

    Raises: SceneError: a value is wrong. ValueError: there is no room for the pieces.
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
    change: PieceChange = choose(f"{where}.change", _changes(), mapping["change"])

    @lru_cache(2)
    def at(moment: float) -> Sample:
        with located(f"{where}.change"):
            return made_of(change.at(first, moment))

    start = at(change.moment(0.0))
    return Changing(lambda seconds: at(change.moment(seconds)), start, change.table(first))


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
    from simulators.samples.materials.materials import palette_of
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
