"""Found settings: those of a stage's controller as a program found them, on disk until it has restored them.

A program that is killed restores nothing. The next one that opens the stage, or the watchdog of its scan, then finds
here what it must restore.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from zlib import crc32

from beamline.core.errors import DataError
from beamline.core.files import write_whole
from beamline.core.machine import state_folder
from drivers.base.protocols import RotationStage
from drivers.stages.kept import RestoresSettings

_IDENTITY = ("model", "serial", "device", "axis", "channel")


def keep_found_settings(stage: RotationStage, folder: Path | None = None) -> None:
    """Keep them on disk from now on; what an earlier program left there is restored in their place."""
    if isinstance(stage, RestoresSettings):
        stage.keep_found_settings(FoundOnDisk(file_of(stage.describe(), folder or state_folder() / "stages")))


def file_of(said: Mapping[str, object], folder: Path) -> Path:
    """The file of a stage that describes itself so: by its serial number, or its port if it tells none."""
    which = [str(said[key]) for key in _IDENTITY if key in said] + ([] if "serial" in said else [str(said.get("port"))])
    name = re.sub(r"\W+", "-", " ".join(which)).strip("-")[:60]
    return folder / f"{name}-{crc32(json.dumps(which).encode()):08x}.json"


class FoundOnDisk:
    """Implements `drivers.stages.kept.SettingsStore`. A disk that does not take them loses only this protection."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self) -> Mapping[str, str]:
        with suppress(OSError, ValueError):  # none, or not whole
            found = json.loads(self._path.read_text(encoding="utf-8"))
            if isinstance(found, dict):
                return {str(name): str(value) for name, value in found.items()}
        return {}

    def save(self, found: Mapping[str, str]) -> None:
        with suppress(OSError, DataError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, json.dumps(dict(found)), replace=True)

    def clear(self) -> None:
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
