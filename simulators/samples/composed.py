"""Phantoms: the sample that a scene's mapping names; a kind's module is imported only when it is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from recon.base.registry import in_folders
from simulators.frame.mapping import SceneError, build, choose, located, named
from simulators.light.beam import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import SOLIDS, Solid, kind_of
from simulators.samples.sample import Sample

if TYPE_CHECKING:
    from simulators.samples.sample import ReadVolume

    _Builder = Callable[[str, Mapping[str, Any], Beam, ReadVolume | None], Sample]


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
    """The sample of a phantom's `solids`, grey where no key asks for the module of a folder."""
    keys = build(_Keys, where, mapping)
    entries = [(f"{where}.solids[{i}]", entry) for i, entry in enumerate(keys.solids or ())]
    used = {*mapping, *(key for _, entry in entries if isinstance(entry, Mapping) for key in entry)}
    modules = in_folders("simulators.samples", "SOLID_KEYS")
    if found := [module for key, module in modules.items() if key in used]:
        sample: Sample = import_module(found[0]).phantom(where, entries, keys.materials, beam)
        return sample
    grey = [_grey(at, entry) for at, entry in entries]
    return Phantom.of([solid for solid, _ in grey], [name for _, name in grey])


def _grey(where: str, entry: Any) -> tuple[Solid, str]:
    """A solid and its label."""
    if not isinstance(entry, Mapping):
        solid = choose(where, SOLIDS, entry)
        return solid, kind_of(solid)
    name = entry.get("name", "")
    if not isinstance(name, str):
        raise SceneError(f"{where}: name must be text, got { {'name': name} }")
    with located(where):
        solid = choose(where, SOLIDS, {key: value for key, value in entry.items() if key != "name"})
        return solid, name or kind_of(solid)


def _read(
    name: str, module: str, where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None
) -> Sample:
    """A phantom that is read from a file, such as by `volume_sample` of VolumeSettings in the module."""
    found = import_module(module)
    settings = build(getattr(found, f"{name.title()}Settings"), where, mapping)
    if read is None:
        raise ValueError(f"{settings.file} cannot be read: no reader of such files was given")
    sample: Sample = getattr(found, f"{name}_sample")(settings, read)
    return sample


def _built(
    name: str, module: str, where: str, mapping: Mapping[str, Any], beam: Beam, read: ReadVolume | None
) -> Sample:
    """A phantom out of pieces, by `phantom` of the module."""
    sample: Sample = import_module(module).phantom(name, where, mapping, beam)
    return sample


_KINDS: Mapping[str, _Builder] = {
    "battery": _battery,
    "solids": _solids,
    **{name: partial(_built, name, at) for name, at in in_folders("simulators.samples.builders", "PHANTOMS").items()},
    **{name: partial(_read, name, at) for name, at in in_folders("simulators.samples", "PHANTOMS").items()},
}
