"""Phantoms: the sample that a scene's mapping names; a kind's module is imported only when it is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

from simulators.frame.mapping import SceneError, build, choose, located, named
from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import SOLIDS
from simulators.samples.builders.piece import Piece, PieceBuilder
from simulators.samples.composed.parts import Part, sample_of
from simulators.samples.sample import Changing, Sample

if TYPE_CHECKING:
    from simulators.light.palette import Palette
    from simulators.samples.voxels.volume import ReadVolume

    _Builder = Callable[[str, Mapping[str, Any], Beam, ReadVolume | None], Sample]


_OWN_KEYS = ("material", "instead_of", "name")


def build_sample(where: str, entry: Any, beam: Beam, read: ReadVolume | None = None) -> Sample:
    """The sample of a scene.

    Args:
        where: path of the entry, for messages.
        beam: its energies decide how materials attenuate.
        read: reads the file of a volume; None: the sample cannot be a volume.

    Raises:
        SceneError: an unknown kind, a wrong value, or a sample that cannot be built.
    """
    kind, mapping = named(where, list(_KINDS), entry)
    where = f"{where} ({kind})"
    with located(where):
        return _KINDS[kind](where, mapping, beam, read)


def _battery(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:
    from simulators.samples.builders.battery import Battery, labels_of

    solids = build(Battery, where, mapping).solids()
    return Phantom.of(solids, labels_of(solids))


@dataclass(frozen=True)
class _Keys:
    """The keys of a phantom of solids. A solid's keys depend on its kind."""

    solids: tuple[Any, ...] | None
    materials: Any = None


def _solids(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:
    """The sample of a phantom's `solids` and `materials`; see simulators.light.palette for the latter."""
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


def _volume(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:
    from simulators.samples.voxels.volume import VolumeSettings, voxels_of

    settings = build(VolumeSettings, where, mapping)
    if read is None:
        raise ValueError(f"{settings.file} cannot be read: no reader of volume files was given")
    return voxels_of(settings, read)


def _mesh(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:
    from simulators.samples.voxels.mesh import MeshSettings, mesh_of

    settings = build(MeshSettings, where, mapping)
    if read is None:
        raise ValueError(f"{settings.file} cannot be read: no reader of meshes was given")
    return mesh_of(settings, read)


def _pieces(cls: str) -> _Builder:
    """The builder of a phantom of pieces, which are materials if the beam has energies and the scene no attenuation."""

    def sample(where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None) -> Sample:
        kind = getattr(import_module(f"simulators.samples.builders.{cls.lower()}"), cls)
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
        from simulators.samples.builders.change import CHANGES

        change = choose(f"{where}.change", CHANGES, mapping["change"])

        def at(seconds: float) -> Sample:
            with located(f"{where}.change"):
                return made_of(change.at(first, seconds))

        return Changing(at, at(0.0))

    return sample


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
    """The pieces with a material for each role; `materials` are the scene's own, see simulators.light.palette."""
    from simulators.light.palette import palette_of
    from simulators.samples.composed.parts import Part, sample_of

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


_KINDS: Mapping[str, _Builder] = {
    "battery": _battery,
    "solids": _solids,
    "cathode": _pieces("Cathode"),
    "foam": _pieces("Foam"),
    "resolution": _pieces("Resolution"),
    "volume": _volume,
    "mesh": _mesh,
}
