"""Formats of volume files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from recon.base.registry import Registry, in_folders

if TYPE_CHECKING:
    from beamline.storage.volumes.base import VolumeFormat


@dataclass(frozen=True)
class FormatEntry:
    """An entry in the registry of formats of volume files.

    Attributes:
        suffixes: suffixes of the file names, the usual one first; "" for a folder.
        note: description of the format in help texts.
    """

    module: str
    cls: str
    suffixes: tuple[str, ...]
    note: str = ""


_HERE = "beamline.storage.volumes."
REGISTRY = {
    "hdf5": FormatEntry(_HERE + "files", "NXtomoproc", (".h5", ".hdf5", ".nxs"), "with all settings"),
    **in_folders("beamline.storage.volumes", "FORMATS"),
    "npy": FormatEntry(_HERE + "files", "Npy", (".npy",)),
    "nrrd": FormatEntry(_HERE + "files", "Nrrd", (".nrrd",)),
}


@cache
def entries() -> Registry[FormatEntry]:
    """The formats of this package and of add-ons, by name."""
    taken = {suffix for entry in REGISTRY.values() for suffix in entry.suffixes}

    def entry_of(name: str, kind: type[Any]) -> FormatEntry:
        suffixes = tuple(kind().suffixes)
        if not suffixes or taken & set(suffixes) or any(suffix[:1] != "." for suffix in suffixes):
            raise ValueError(
                f"the suffixes of the format are {suffixes}; expected one or more suffixes, each with a dot at its "
                f"start ('.xyz'). Other formats already use {', '.join(sorted(taken))}"
            )
        if getattr(import_module(kind.__module__), kind.__name__, None) is not kind:
            raise ValueError(
                f"the class {kind.__qualname__} is not defined at the top level of the module {kind.__module__}"
            )
        taken.update(suffixes)
        return FormatEntry(kind.__module__, kind.__name__, suffixes)

    return Registry("volume_format", REGISTRY, entry_of)


@cache
def formats() -> tuple[VolumeFormat, ...]:
    """Every format in which volumes are written."""
    return tuple(getattr(import_module(entry.module), entry.cls)() for entry in entries().values())


def suffixes_text() -> str:
    """The usual suffixes, for help texts."""
    named = [entry for entry in entries().values() if entry.suffixes[0]]
    folders = [f"or no suffix: {entry.note}" for entry in entries().values() if not entry.suffixes[0]]
    return ", ".join([e.suffixes[0] + (f" ({e.note})" if e.note else "") for e in named] + folders)
