"""Phantoms: the sample that a scene's mapping names; a kind's module is imported when it is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from simulators.frame.mapping import SceneError, build, choose, items, keys, named
from simulators.light.beam import Beam
from simulators.samples.sample import Sample
from simulators.samples.voxels.stored import ReadVolume

Builder = Callable[[str, Mapping[str, Any], Beam], Sample]


def build_sample(where: str, entry: Any, beam: Beam, read: ReadVolume | None = None) -> Sample:
    """The sample of a scene.

    Args:
        where: path of the entry, for messages.
        beam: what decides how materials attenuate.
        read: reads a volume that the sample names; None: none can be named.

    Raises:
        SceneError: an unknown kind, a wrong value, or a sample that cannot be built.
    """
    kind, rest = named(where, [*_BUILDERS, "volume"], entry)
    if kind == "volume":
        return _volume(f"{where} ({kind})", rest, read)
    return _BUILDERS[kind](f"{where} ({kind})", rest, beam)


def _battery(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    from simulators.samples.bodies.phantom import Phantom
    from simulators.samples.builders.battery import Battery

    settings = build(Battery, where, mapping)
    try:
        return Phantom.of(settings.solids())
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def _solids(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    """Solids, each grey (`attenuation` in 1/mm) or of a `material`, and then perhaps `instead_of` another."""
    mapping = keys(where, mapping, legal=("solids", "materials"), needed=("solids",))
    entries = [(f"{where}.solids[{i}]", entry) for i, entry in items(where, "solids", mapping)]
    said = {key for _, entry in entries if isinstance(entry, Mapping) for key in entry}
    if "materials" in mapping or said & {"material", "instead_of"}:
        from simulators.samples.composed.made_of import sample_made_of

        return sample_made_of(where, entries, mapping.get("materials"), beam)
    from simulators.samples.bodies.phantom import Phantom
    from simulators.samples.bodies.solids import SOLIDS, kind_of

    solids, names = [], []
    for at, entry in entries:
        own = {"name": str(entry["name"])} if isinstance(entry, Mapping) and "name" in entry else {}
        solids.append(choose(at, SOLIDS, {key: entry[key] for key in entry if key != "name"} if own else entry))
        names.append(own.get("name", kind_of(solids[-1])))
    return Phantom.of(solids, names)


def _volume(where: str, mapping: Mapping[str, Any], read: ReadVolume | None) -> Sample:
    from simulators.samples.voxels.scene import VolumeSettings, voxels_of

    settings = build(VolumeSettings, where, mapping)
    if read is None:
        raise SceneError(f"{where}: {settings.file} cannot be read: whoever opened the scene reads no volumes")
    try:
        return voxels_of(settings, read)
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def _cathode(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    from simulators.samples.builders.cathode import Cathode

    return _pieces(Cathode, where, mapping, beam)


def _foam(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    from simulators.samples.builders.foam import Foam

    return _pieces(Foam, where, mapping, beam)


def _resolution(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    from simulators.samples.builders.resolution import Resolution

    return _pieces(Resolution, where, mapping, beam)


def _pieces(kind: Any, where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    """A phantom of parts that are materials in a beam with energies, unless it says how its parts attenuate."""
    from simulators.samples.composed.pieces import grey, of_materials

    settings = build(kind, where, {key: value for key, value in mapping.items() if key != "materials"})
    try:
        pieces = settings.pieces()
        if beam.has_energy and not settings.attenuation:
            return of_materials(where, pieces, settings.materials, mapping.get("materials"), beam)
        if settings.made_of or "materials" in mapping:
            raise SceneError(
                f"{where}: materials need a beam with energies (energy_kev), and no attenuation beside them"
            )
        return grey(pieces, settings.greys)
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


_BUILDERS: Mapping[str, Builder] = {
    "battery": _battery,
    "solids": _solids,
    "cathode": _cathode,
    "foam": _foam,
    "resolution": _resolution,
}
