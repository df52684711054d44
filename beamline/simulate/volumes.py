"""Volumes and meshes that scenes name, read where the scenes stand."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from beamline.storage.volumes.files import whole_volume
from recon.base.registry import in_folders

if TYPE_CHECKING:
    from simulators.samples.sample import ReadVolume


def volumes_beside(folder: Path) -> ReadVolume:
    """A reader of the volumes that a scene in `folder` names, by full or relative paths. It raises DataError."""

    from simulators.samples.sample import Stored

    meshes = in_folders("beamline.storage", "MESHES")

    def read_beside(file: str, dataset: str | None) -> Stored:
        if module := meshes.get((folder / file).suffix.lower()):
            return Stored(import_module(module).read_mesh(folder / file))
        return Stored(*whole_volume(folder / file, dataset))  # a full path stays itself

    return read_beside
